"""A robot in the words of all views."""

import dataclasses
import io

import pytest
from rich.console import Console

from edge.messages.mission import FlightState, RobotStatus
from lpac.analysis.snapshot import FRESH_S
from lpac.cli.live import fleet_table
from lpac.ground.alarms import alarms
from lpac.ground.foxglove.view import FoxgloveView
from lpac.ground.map.view import snapshot_view
from lpac.ground.rendering import Row, cell, not_ready, problem, rows
from lpac.ground.terminal.text import full_view
from tests.said import checks, reasons
from tests.unit.ground.snapshots import on_ground, robot, setup, snapshot, status

_S = FlightState
HELP = "mission origin is not set: order `mission origin`"
WAITS = on_ground(0, state=_S.PREFLIGHT, failed_checks=checks(HELP, "GPS sees 3 satellites"))


@pytest.mark.parametrize(
    ("said", "age_s", "state", "why"),
    [
        (status(0), 0.1, "mission", "mission started"),
        (status(0, alarms=reasons("position lost")), 0.1, "mission", "position lost"),
        (status(0, battery=0.12), 0.1, "mission", "battery critical: 12%"),
        (status(0), FRESH_S + 1.0, "mission", "no longer heard, last in the air in mission"),
        (on_ground(0, state=_S.PREFLIGHT, ready=True, failed_checks=()), 0.1, "ready",
         "autopilot and position found"),
        (WAITS, 0.1, "preflight", HELP),
        (None, None, "not heard", ""),
    ],
)  # fmt: skip
def test_all_views_say_the_same(
    said: RobotStatus | None, age_s: float | None, state: str, why: str
) -> None:
    fleet = setup(2)
    first = dataclasses.replace(robot(status(0)), status=said, age_s=age_s)
    seen = snapshot(first, robot(status(1)))
    told = alarms(fleet, seen)
    row = rows(fleet, seen, told)[0]
    assert (cell(row, "state").text, problem(row).text) == (state, why)
    lines = full_view(fleet, seen, told, 200).splitlines()
    assert [line for line in lines if line[2:4] == "r0"][-1].endswith(why or "-")
    page = snapshot_view(fleet, seen, told)["robots"][0]
    assert (page["word"], page["problem"]) == (state, why)
    assert page["severity"] == ("" if row.alarm is None else row.alarm.severity)
    view = FoxgloveView()
    list(view.take("setup", 0.0, dataclasses.asdict(fleet)))
    assert seen.ground is not None
    list(view.take("state", 0.0, dataclasses.asdict(seen.ground)))
    if said is not None and age_s is not None:
        list(view.take("status", 100.0 - age_s, dataclasses.asdict(said) | {"name": "r0"}))
    (shown,) = (each.message for each in view.tick(100.0) if each.topic == "/fleet")
    assert (shown.robots[0].state, shown.robots[0].problem) == (state, why)
    out = io.StringIO()
    Console(file=out, width=200).print(fleet_table([row]))
    assert state in out.getvalue() and why in out.getvalue()


def test_why_a_robot_does_not_take_off() -> None:
    def obstacle(said: RobotStatus, age_s: float = 0.1) -> str:
        return not_ready(Row(robot(said, age_s=age_s)))

    assert obstacle(WAITS) == f"{HELP}; GPS sees 3 satellites"
    assert obstacle(WAITS, FRESH_S + 1.0) == "not heard"
    assert obstacle(status(0)) == "mission"
    ready = dataclasses.replace(WAITS, ready=True, failed_checks=())
    assert obstacle(ready) == ""
    assert obstacle(dataclasses.replace(ready, ready=False)) == "the checks are still running"


def test_without_a_setup_less_is_judged() -> None:
    """As of the robots of a simulation, which no ground knows."""
    row = Row(robot(status(0, battery=0.05, fence=None, alarms=reasons("position lost"))))
    assert [cell(row, key).text.strip() for key in ("battery", "margin", "problem")] == [
        "5", "-", "position lost",
    ]  # fmt: skip
