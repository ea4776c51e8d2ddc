"""`lpac mission`, and what the ground says of its commands."""

import io
from pathlib import Path
from typing import Any

import pytest
import typer

from edge.messages.mission import Origin
from lpac.cli.mission import app
from lpac.ground.station.protocol import (
    Enable,
    NextTrial,
    Request,
    Resume,
    RobotCommand,
    SafetyCommand,
    SetFence,
    SetOrigin,
    SetPlaces,
    SetWorld,
    Start,
    TakeCommand,
    Takeoff,
    in_words,
)
from tests.unit.cli.test_fleet import write_fleet


class Terminal(io.StringIO):
    """Stdin of a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("typed", "options", "asked"),
    [
        (Terminal("n\n"), (), True),
        (Terminal("y\n"), (), True),
        (Terminal(""), ("--yes",), False),
        (io.StringIO(""), (), False),
    ],
    ids=["no", "yes", "--yes", "script"],
)
def test_takeoff_asks_who_sits_at_a_terminal(
    typed: io.StringIO,
    options: tuple[str, ...],
    asked: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    ordered: list[Request] = []
    monkeypatch.setattr(
        "lpac.cli.mission.ask", lambda to, request, *_, **__: ordered.append(request)
    )
    monkeypatch.setattr("sys.stdin", typed)
    command: Any = typer.main.get_command(app)
    arguments = ["takeoff", "--fleet", str(write_fleet(tmp_path, 22)), "--robots", "r1", *options]
    if typed.getvalue() == "n\n":
        with pytest.raises(ValueError, match="takeoff: nothing was done"):
            command.main(arguments, standalone_mode=False)
        assert not ordered
    else:
        command.main(arguments, standalone_mode=False)
        assert ordered == [Takeoff(("r1",), 2.0)]
    assert ("Start the motors of r1, and take off?" in capsys.readouterr().err) == asked


@pytest.mark.parametrize(
    ("request_", "said"),
    [
        (SetOrigin(Origin(0.0, 0.0, 0.0)), "origin"),
        (SetFence(None), "fence"),
        (SetWorld("", "field.env"), "world field.env"),
        (SetPlaces({}), "assign"),
        (Enable(), "enable"),
        (Enable(on=False), "disable"),
        (Takeoff(("r1", "r2")), "takeoff r1,r2"),
        (Start(), "start"),
        (SafetyCommand("hold"), "hold"),
        (SafetyCommand("return"), "return"),
        (SafetyCommand("land"), "land"),
        (Resume(), "resume"),
        (RobotCommand("pilot", ("r1",)), "pilot r1"),
        (RobotCommand("rejoin", ("r1",)), "rejoin r1"),
        (RobotCommand("disarm", ("r1",)), "disarm r1"),
        (RobotCommand("kill", ("r1",)), "kill r1"),
        (NextTrial("t2"), "again"),
        (TakeCommand(), "command"),
    ],
)
def test_the_ground_calls_a_command_as_people_type_it(request_: Request, said: str) -> None:
    assert in_words(request_) == said
    group: Any = typer.main.get_command(app)
    assert said.split(maxsplit=1)[0] in group.commands
