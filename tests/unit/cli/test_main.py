"""The list of `lpac`'s commands, which are loaded when they run."""

import importlib
import importlib.util
import re
import tomllib
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from lpac.cli.apps import CommandList
from lpac.cli.main import _EXTRAS, _what_is_missing, app
from lpac.extras import install_command
from tests.conftest import ROOT

LISTED: Any = typer.main.get_command(app)


def test_each_file_with_an_app_is_a_command_and_the_list_says_what_it_says_of_itself() -> None:
    names = {path.stem for path in (ROOT / "lpac" / "cli").iterdir()} - {"main", "__pycache__"}
    apps = {n for n in names if hasattr(importlib.import_module(f"lpac.cli.{n}"), "app")}
    assert set(LISTED.list_commands(None)) == apps
    told = " ".join(CliRunner().invoke(app, ["--help"]).stdout.split())
    for name in apps:
        sentence = CommandList.first_sentence(LISTED, None, name)
        assert f" {name} {sentence}" in told


def test_no_command_but_the_whole_offers_completion() -> None:
    options = {parameter.name for parameter in LISTED.params}
    assert {"version", "install_completion", "show_completion"} <= options
    for name in LISTED.list_commands(None):
        assert not options & {p.name for p in LISTED.get_command(None, name).params}


def test_a_command_that_a_robot_does_not_have_is_not_listed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    there = importlib.util.find_spec
    monkeypatch.setattr(
        "lpac.cli.main.find_spec", lambda name: None if name == "lpac.cli.sim" else there(name)
    )
    assert "sim" not in LISTED.list_commands(None) and "demo" in LISTED.list_commands(None)
    assert re.search(r"^  sim ", CliRunner().invoke(app, ["--help"]).stdout, re.MULTILINE) is None

    def absent(name: str) -> None:
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)

    monkeypatch.setattr("lpac.cli.main.importlib.import_module", absent)
    with pytest.raises(SystemExit) as ended:
        LISTED(["sim"], standalone_mode=False)
    assert ended.value.code == (
        "lpac: lpac.cli.sim is not installed here: this command is the workstation's"
    )


@pytest.mark.parametrize("extra", _EXTRAS)
def test_an_extra_that_people_are_told_to_install_exists(extra: str) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["optional-dependencies"][extra]
    assert set(_EXTRAS[extra]) <= set(LISTED.list_commands(None))


def test_an_error_of_the_program_is_no_missing_install() -> None:
    with pytest.raises(ModuleNotFoundError, match="mcap"):
        _missing("mcap", "robot")
    with pytest.raises(ModuleNotFoundError, match="edge"):
        _missing("edge.absent", "sim")
    assert install_command("ground") in _missing("aiohttp.web", "map")


def _missing(module: str, command: str) -> str:
    return _what_is_missing(ModuleNotFoundError(module, name=module), command)
