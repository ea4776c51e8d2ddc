"""`lpac mission`, and what the ground says of its commands."""

from typing import Any

import pytest
import typer

from edge.messages.mission import Origin
from lpac.cli.mission import app
from lpac.ground.station.commands import in_words
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
)


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
