"""docs/api.md, the examples and the notebooks as they stand: all of their code runs."""

import json
import re
import runpy
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib as mpl
import pytest

from lpac.analysis.statistics import VERDICT_RULE
from tests.conftest import ROOT

pytestmark = pytest.mark.slow

EXAMPLES = ROOT / "examples"
PAGE = (ROOT / "docs" / "api.md").read_text()
# What each script needs, and what it leaves; what they say is for people.
SCRIPTS: dict[str, tuple[list[str], set[str]]] = {
    "compare_policies.py": ([], {"compare_policies.png"}),
    "one_robot.py": ([], set()),
    "own_world.py": ([], {"own_world.png"}),
    "read_logs.py": (["out/flight/robots"], {"read_logs.png"}),
    "watch_a_flight.py": ([], set()),
}
NOTEBOOKS = ("evaluate_and_compare.ipynb", "first_flight.ipynb")


@pytest.fixture(scope="module")
def drawn() -> Iterator[None]:
    """Figures are drawn and not shown, and none stays."""
    mpl.use("agg")
    yield
    from matplotlib import pyplot  # noqa: PLC0415

    pyplot.close("all")


@pytest.fixture(scope="module")
def page(drawn: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder in which the page's code has run, from its top to its end."""
    folder = tmp_path_factory.mktemp("page")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        namespace: dict[str, Any] = {}
        for code in re.findall(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL):
            exec(compile(code, "docs/api.md", "exec"), namespace)
    yield folder


def test_the_page_runs(page: Path) -> None:
    made = {path.name for path in page.iterdir()}
    assert made >= {"out", "flight.png", "snapshots.pdf", "curves.png"}


def test_no_example_is_left_out() -> None:
    assert {path.name for path in EXAMPLES.glob("*.py")} == set(SCRIPTS)
    assert {path.name for path in EXAMPLES.glob("*.ipynb")} == set(NOTEBOOKS)
    assert "(../examples/README.md)" in PAGE
    listed = (EXAMPLES / "README.md").read_text()
    for name in (*SCRIPTS, *NOTEBOOKS):
        assert f"]({name})" in listed


@pytest.mark.parametrize("name", SCRIPTS)
def test_an_example_runs(
    name: str, page: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments, files = SCRIPTS[name]
    before = set(page.iterdir())
    monkeypatch.chdir(page)
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    assert {path.name for path in set(page.iterdir()) - before} == files
    said = capsys.readouterr().out
    assert said and (name != "compare_policies.py" or VERDICT_RULE in said)
    assert len((EXAMPLES / name).read_text().splitlines()) < 60


@pytest.mark.usefixtures("drawn")
@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_runs(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Cell by cell, as Jupyter does it; it is kept without what came out."""
    notebook = json.loads((EXAMPLES / name).read_text())
    assert (notebook["nbformat"], notebook["nbformat_minor"]) == (4, 5)
    monkeypatch.chdir(EXAMPLES)
    namespace: dict[str, Any] = {}
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            assert cell["outputs"] == [] and cell["execution_count"] is None
            exec(compile("".join(cell["source"]), f"{name}, {cell['id']}", "exec"), namespace)
