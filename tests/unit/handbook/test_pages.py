"""The documentation's pages: links, and a complete reference."""

import ast
import dataclasses
import re
import typing
from collections.abc import Callable, Iterator
from importlib import import_module
from itertools import chain
from pathlib import Path
from typing import Any

import pytest
import typer

from edge.core.schema import Bounded, bounds_of
from edge.messages.topics import TOPICS
from handbook import commands, configuration, interfaces, messages, pages
from lpac import api
from lpac.cli.main import app
from tests.conftest import ROOT

_HEADING = re.compile(r"^#+ (.+)$", re.M)
_CODE_BLOCK = re.compile(r"^```.*?^```", re.S | re.M)
_GUIDE = ROOT / "docs" / "extending.md"
_EXAMPLES = sorted((ROOT / "examples").rglob("*.py"))
_LINKED = [
    path.relative_to(ROOT).as_posix()
    for pattern in ("examples/*.ipynb", "examples/*/README.md", "policies/*/README.md")
    for path in sorted(ROOT.glob(pattern))
]


def anchors(page: str) -> set[str]:
    """Targets of links on a page, by GitHub's rule, which the site uses, too."""
    text = _CODE_BLOCK.sub("", pages.page_text(page))
    return {
        re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")
        for heading in _HEADING.findall(text)
    }


@pytest.mark.parametrize("page", [*pages.hand_written(), *pages.generated(), *_LINKED])
def test_links_lead_somewhere(page: str) -> None:
    for link in pages.links(pages.page_text(page)):
        path, _, anchor = link.partition("#")
        target = pages.target(link, page) or page
        if re.match(r"[a-z]+:", path):
            continue
        assert target in pages.generated() or (ROOT / target).exists(), (page, link)
        if anchor and target.endswith(".md"):
            assert anchor in anchors(target), (page, link)


def test_every_page_is_in_the_navigation() -> None:
    navigation = (ROOT / "mkdocs.yml").read_text().partition("\nnav:\n")[2]
    named = set(re.findall(r"(\S+\.md)$", navigation, re.M))
    written = [*pages.hand_written(), *pages.generated()]
    assert {pages.place(page) for page in written} <= named


def test_the_readmes_first_commands_exist_and_tests_are_among_them() -> None:
    section = (ROOT / "README.md").read_text().partition("## Try it")[2].partition("## ")[0]
    told = re.findall(r"(?:^|`)make (\w+)", section, re.M)
    assert told == ["demo", "fly", "test", "help"]
    assert set(told) <= set(re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.M))


def test_a_first_hour_needs_no_address_that_is_not_there() -> None:
    """PX4 has an address, this project has none."""
    assert "git clone REPOSITORY" not in (ROOT / "docs" / "start.md").read_text()
    steps = (ROOT / "docs" / "px4.md").read_text().partition("## A real PX4 on this machine")[2]
    for step in (
        "git clone --recursive --branch v1.17.0 https://github.com/PX4/PX4-Autopilot\n",
        "bash Tools/setup/ubuntu.sh --no-nuttx",
        "make px4_sitl\n",
    ):
        assert step in steps, step


def test_the_readme_needs_no_page_that_is_made_from_code() -> None:
    """It is read in the repository, where these pages do not exist."""
    linked = {pages.target(link, "README.md") for link in pages.links(pages.page_text("README.md"))}
    assert not linked & set(pages.generated())


def test_links_lead_to_the_same_page_on_the_site() -> None:
    assert pages.target("../README.md#why", "docs/safety.md") == "README.md"
    assert pages.target("https://arxiv.org", "README.md") is None
    assert pages.target("#states", "docs/safety.md") is None
    assert pages.place("README.md") == "index.md"
    assert pages.place("docs/safety.md") == "safety.md"
    assert pages.place("docs/demo.png") == "demo.png"
    assert pages.place("policies/field/README.md") == "policies/field/index.md"
    assert pages.place("edge/core/wire.py") == "source/edge/core/wire.py.md"
    assert pages.place("examples") == "source/examples.md"


def test_a_folder_is_a_page_of_its_files() -> None:
    assert "- [quick.toml](examples/quick.toml)" in pages.page_text("examples")
    linked = {pages.target(link, "examples") for link in pages.links(pages.page_text("examples"))}
    assert "examples/field.toml" in linked


def test_links_in_code_are_code() -> None:
    text = "[a](b.md)\n\n```toml\n[c](d.md)\n```\n\n[![e](f.png)](g.md)\n"
    assert list(pages.links(text)) == ["b.md", "g.md"]


def test_every_command_and_option_is_in_the_reference() -> None:
    page = commands.page()
    root: Any = typer.main.get_command(app)
    assert {f"lpac {name}" for name in root.list_commands(None)} <= set(commands.names())
    for name in commands.names():
        assert f"# {name}\n" in page, name
        command = root
        for part in name.split()[1:]:
            command = command.get_command(None, part)
        section = page.partition(f"# {name}\n")[2].partition("\n#")[0]
        for parameter in command.params:
            if getattr(parameter, "hidden", False) or hasattr(command, "list_commands"):
                continue
            for option in [o for o in parameter.opts if o.startswith("-")]:
                assert option in section, (name, option)
    assert str(ROOT) not in page + interfaces.python_api()


@pytest.mark.parametrize(
    ("page", "classes"),
    [
        (configuration.robot, configuration.ROBOT),
        (configuration.fleet, configuration.FLEET),
        (configuration.ground, configuration.GROUND),
        (configuration.training, configuration.TRAINING),
        (configuration.study, configuration.STUDY),
        (configuration.ablation, configuration.ABLATION),
        (configuration.manifest, configuration.MANIFEST),
    ],
)
def test_every_key_is_in_the_reference(
    page: Callable[[], str], classes: tuple[type[Any], ...]
) -> None:
    text = page()
    for cls in classes:
        for key in configuration.keys(cls):
            assert f"| `{key}` |" in text, (cls, key)


def test_keys_have_their_defaults_and_kinds() -> None:
    robot = configuration.robot()
    assert "| `policy_hz` | number (from 0.1 to 100) | `2.5` |" in robot
    assert '| `rc` | `"pilot"` or `"none"` | must be given |' in robot
    assert '| `type` | text | `"px4"` |' in robot
    assert "\n### [[data.worlds]]\n" in configuration.training()


def test_bounds_of_a_file_hold_in_python_too_and_leave_no_number_infinite() -> None:
    files = (
        configuration.ROBOT, configuration.FLEET, configuration.GROUND, configuration.TRAINING,
        configuration.STUDY, configuration.MANIFEST,
    )  # fmt: skip
    for cls in (kind for each in chain(*files) for kind in read_kinds(each)):
        bounds = bounds_of(cls)
        assert not bounds or issubclass(cls, Bounded), cls
        for name, meta in bounds.items():
            if isinstance(meta.ge, float) or isinstance(meta.gt, float):
                assert meta.le is not None or meta.lt is not None, (cls, name)


def read_kinds(cls: Any) -> Iterator[Any]:
    """A dataclass, and those within it."""
    yield cls
    for hint in typing.get_type_hints(cls).values():
        for kind in (hint, *typing.get_args(hint)):
            if dataclasses.is_dataclass(kind):
                yield from read_kinds(kind)


def test_every_topic_message_and_code_is_in_the_reference() -> None:
    text = messages.page()
    for topic in TOPICS:
        assert f"| `{topic.pattern.replace('*', 'ID')}` |" in text
    for message in messages.MESSAGES:
        for field in dataclasses.fields(message):
            assert f"| `{field.name}` |" in text, (message, field.name)
    for codes in messages.CODES:
        for code in codes:
            assert f"`{code}`" in text


def test_interfaces_tell_calls_as_the_source_has_them() -> None:
    text = interfaces.page()
    for said in (
        "view(position: F64) -> F32 | None",
        "manifest: Manifest",
        "from_mapping(cls: type[T], mapping: object, where: str) -> T",
        "@contextmanager\nworld_sensor(setting: SensorSetting) -> Iterator[SensorOver]",
        "TOLERANCE = 1e-5",
    ):
        assert f"```python\n{said}\n```" in text, said
    assert "# Importance of unseen cells.\nunknown_importance: NonNegative" in text
    for name in re.findall(r"`([A-Z]\w+(?:Driver|Family))`", _GUIDE.read_text()):
        assert f"### {name}\n" in text, name
    for module, name in interfaces.names():
        assert f"### {name}\n\n`from {module} import {name}`\n" in text, name


def imported(source: str) -> Iterator[tuple[str, str]]:
    """Imported modules of the product with each imported name; "" for a whole module."""
    for node in ast.walk(ast.parse(source)):
        names = []
        if isinstance(node, ast.ImportFrom):
            names = [(node.module or "", alias.name) for alias in node.names]
        elif isinstance(node, ast.Import):
            names = [(alias.name, "") for alias in node.names]
        yield from (each for each in names if each[0].split(".")[0] in ("edge", "export", "lpac"))


@pytest.mark.parametrize("path", [_GUIDE, *_EXAMPLES], ids=lambda path: path.stem)
def test_packages_import_what_the_reference_has(path: Path) -> None:
    """A package may import names of the API and of the page of interfaces."""
    text = path.read_text()
    if path == _GUIDE:
        text = "\n".join(re.findall(r"^```python\n(.*?)^```$", text, re.M | re.S))
    taken = set(imported(text)) - interfaces.names()
    others = {
        (module, name)
        for module, name in taken
        if name not in api.__all__ or getattr(api, name) is not getattr(import_module(module), name)
    }
    assert not others


def test_a_notebook_is_a_page_of_its_cells() -> None:
    text = pages.page_text("examples/first_flight.ipynb")
    assert text.startswith("# A first flight\n")
    assert "```python\nimport matplotlib.pyplot as plt\n" in text
