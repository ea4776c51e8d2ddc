"""Install command shown for an extra that is missing."""

import json
import re
import tomllib
from importlib import metadata
from typing import Any

import pytest

from lpac import extras
from tests.conftest import ROOT

TEXTS = [
    *(ROOT / "docs").rglob("*.md"), ROOT / "README.md", *(ROOT / "examples").rglob("*.*"),
    *(ROOT / "lpac").rglob("*.py"), *(ROOT / "bench").rglob("*.py"),
]  # fmt: skip
CLONE = "file:///home/ann/my%20robots/lpac-edge"
WHEEL = "file:///home/ann/lpac_edge-0.2.0-py3-none-any.whl"
GIT = "https://git.example.org/lab/lpac-edge"


@pytest.mark.parametrize(
    ("noted", "command"),
    [
        (
            {"dir_info": {"editable": True}, "url": CLONE},
            "pip install -e '/home/ann/my robots/lpac-edge[sim]'",
        ),
        ({"dir_info": {}, "url": CLONE}, f"pip install 'lpac-edge[sim] @ {CLONE}'"),
        ({"archive_info": {}, "url": WHEEL}, f"pip install 'lpac-edge[sim] @ {WHEEL}'"),
        (
            {"vcs_info": {"vcs": "git", "commit_id": "3f2a"}, "url": GIT},
            f"pip install 'lpac-edge[sim] @ git+{GIT}@3f2a'",
        ),
        (
            {"vcs_info": {"vcs": "git", "commit_id": "3f2a"}, "url": "file:///srv/lpac-edge"},
            "pip install 'lpac-edge[sim] @ git+file://localhost/srv/lpac-edge@3f2a'",
        ),
        (None, "pip install 'lpac-edge[sim]'"),
    ],
)
def test_an_extra_comes_from_where_the_program_came_from(
    monkeypatch: pytest.MonkeyPatch, noted: dict[str, Any] | None, command: str
) -> None:
    class Installed(metadata.PathDistribution):
        def __init__(self) -> None:
            pass

        def read_text(self, filename: Any) -> str | None:
            assert filename == "direct_url.json"
            return None if noted is None else json.dumps(noted)

    monkeypatch.setattr(extras, "distribution", lambda _: Installed())
    assert extras.install_command("sim") == command


def test_nothing_else_sends_people_to_an_index() -> None:
    """Which does not have it."""
    told = re.compile(rb"pip install '?lpac[-_]edge(\[[\w,]*\])?'?(?! @|` finds)")
    found = {path for path in TEXTS if path.is_file() and told.search(path.read_bytes())}
    assert found == set()


def test_a_robot_installs_nothing_that_it_does_not_need() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    names = {re.match(r"[\w-]+", requirement)[0] for requirement in project["dependencies"]}  # type: ignore[index]
    assert names == {
        "eclipse-zenoh", "geographiclib", "mavsdk", "mcap", "msgspec", "numpy", "onnxruntime",
        "pynacl", "structlog", "typer", "zstandard",
    }  # fmt: skip
