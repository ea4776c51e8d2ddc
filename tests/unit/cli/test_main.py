"""The list of `lpac`'s commands, which are loaded when they run."""

import importlib
import importlib.util
import re
import sys
import tomllib
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from lpac.cli.apps import CommandList
from lpac.cli.main import _EXTRAS, _missing_package, app
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
        "lpac: lpac.cli.sim is not installed here: this command is for a workstation"
    )


@pytest.mark.parametrize("extra", _EXTRAS)
def test_an_extra_that_people_are_told_to_install_exists(extra: str) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["optional-dependencies"][extra]
    assert set(_EXTRAS[extra]) <= set(LISTED.list_commands(None))


def test_a_mistyped_command_is_told_the_nearest() -> None:
    told = CliRunner().invoke(app, ["simm"])
    assert told.exit_code == 2 and "Did you mean 'sim'?" in told.output
    assert "Did you mean" not in CliRunner().invoke(app, ["xyzzy"]).output


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("train", "lpac: interrupted: the same command continues"),
        ("sim", "lpac: interrupted"),
    ],
)
def test_ctrl_c_says_whether_the_same_command_goes_on(
    command: str, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Module:
        app = typer.Typer()

        @staticmethod
        @app.command()
        def interrupted(file: str) -> None:
            raise KeyboardInterrupt

    monkeypatch.setattr("lpac.cli.main.importlib.import_module", lambda _: Module)
    ended = CliRunner().invoke(app, [command, "file"])
    assert ended.exit_code == 130 and ended.output.strip() == said


@pytest.mark.parametrize(
    "command",
    [
        ["train", "missing"], ["ablate", "missing"], ["evaluate", "missing"],
        ["export", "missing", "--params", "missing", "-o", "out"],
        ["paper", "e1", "--logs", "missing"], ["paper", "e1", "--bundle", "missing"],
    ],
    ids=lambda command: " ".join(command[:2]),
)  # fmt: skip
def test_a_missing_file_is_told_before_what_is_slow_is_loaded(
    command: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("torch", "lpac.study.summary", "lpac.study.figures", "lpac.train.run"):
        monkeypatch.setitem(sys.modules, module, None)
    missing = CliRunner().invoke(app, command).exception
    assert isinstance(missing, OSError | ValueError), missing
    assert "missing" in str(missing)


def test_an_error_of_the_program_is_no_missing_install() -> None:
    with pytest.raises(ModuleNotFoundError, match="mcap"):
        _missing("mcap", "robot")
    with pytest.raises(ModuleNotFoundError, match="edge"):
        _missing("edge.absent", "sim")
    assert install_command("ground") in _missing("aiohttp.web", "map")


def _missing(module: str, command: str) -> str:
    return _missing_package(ModuleNotFoundError(module, name=module), command)
