"""The live map: who may see it, and the numbers that it draws."""

import json
import math
from dataclasses import replace

import pytest

from edge.core.address import is_loopback
from edge.messages.mission import ON_GROUND, FlightState, GroundState
from lpac.analysis.snapshot import FleetSnapshot
from lpac.ground.cost import MissionCosts
from lpac.ground.map.access import Access
from lpac.ground.map.server import _PAGE as PAGE
from lpac.ground.map.view import Curve, Paths, detail_view, setup_view, snapshot_view
from lpac.ground.rendering import Row
from tests.unit.ground.snapshots import (
    FENCE,
    LOOP,
    ORIGIN,
    on_ground,
    robot,
    setup,
    snapshot,
    status,
)


@pytest.mark.parametrize(
    ("host", "origin", "allowed"),
    [
        ("127.0.0.1:8300", None, True),
        ("localhost:8300", "http://localhost:8300", True),
        ("[::1]:8300", "http://[::1]:8300", True),
        # Names of others that lead here, and pages of others.
        ("evil.example:8300", None, False),
        ("evil.example:8300", "http://evil.example:8300", False),
        ("127.0.0.1.evil.example", None, False),
        ("127.0.0.1:8300", "http://evil.example", False),
        ("127.0.0.1:8300", "http://127.0.0.1:5000", False),
        ("127.0.0.1:8300", "null", False),
        ("127.0.0.1:8300", "", False),
        ("127.0.0.1:8300", "https://127.0.0.1:8300", False),
        ("[::1", None, False),
        ("", None, False),
    ],
)
def test_only_this_machines_own_page_is_served(
    host: str, origin: str | None, allowed: bool
) -> None:
    refusal = Access(local=True, token=None).refusal(host, origin, ())
    assert (refusal is None) == allowed


def test_beyond_this_machine_a_token_is_asked_for() -> None:
    assert not is_loopback("0.0.0.0") and not is_loopback("192.168.8.2")
    assert is_loopback("127.0.0.1") and is_loopback("::1") and is_loopback("localhost")
    token = "correct-horse"
    access = Access(local=False, token=token)
    host = "192.168.8.2:8300"
    assert access.refusal(host, None, (None, token)) is None
    assert access.refusal(host, f"http://{host}", (token, None)) is None
    for tokens in ((None, None), ("", "wrong"), ("corréct-horse", None), (f"{token} ", None)):
        assert access.refusal(host, None, tokens) is not None
    assert access.refusal(host, "http://evil.example", (token, None)) is not None


def snapshot_of(state: FlightState, unix_time_s: float, trial: str = "t1") -> FleetSnapshot:
    said = status(1, state=state, trial=trial, armed=state not in ON_GROUND)
    ground = GroundState(1, "alice", trial=trial)
    return FleetSnapshot(unix_time_s, "alice", ground, (robot(said),))


def begins(costs: MissionCosts, seen: FleetSnapshot, cost: float = 50.0) -> bool:
    """Take a picture and its cost; whether a mission begins with it."""
    places_m = costs.follow(seen)
    before = costs.began_s
    judged = costs.cost(seen, places_m, cost)
    assert (judged.initial is None) == (costs.began_s is None)
    return costs.began_s not in (before, None)


def test_a_page_that_opens_late_has_the_whole_curve() -> None:
    costs = MissionCosts()
    costs.take_setup(setup(2))
    waiting, flying = (
        snapshot_of(state, 100.0) for state in (FlightState.HOLD, FlightState.MISSION)
    )
    assert not begins(costs, waiting) and costs.mission_s(waiting) is None
    assert begins(costs, flying) and costs.whole and costs.began_s == 100.0
    curve = Curve("t1", 100.0, whole=True, lloyd=0.2)
    for n in range(5000):
        curve.add(0.4 * n, round(1.0 - 0.0001 * n, 4))
    view = curve.view()
    assert view["whole"] and view["began_s"] == 100.0 and view["lloyd"] == 0.2
    assert view["points"][0] == (0.0, 1.0) and view["points"][-1] == (1999.6, 0.5001)
    assert len(view["points"]) <= 3000
    # Hold is part of a mission, landing is not.
    assert costs.mission_s(snapshot_of(FlightState.HOLD, 160.0)) == 60.0
    assert costs.mission_s(snapshot_of(FlightState.LAND, 160.0)) is None
    assert not begins(costs, snapshot_of(FlightState.MISSION, 170.0))
    # What was seen of it over another world is nothing to compare with.
    costs.take_setup(replace(setup(2), world="CircularBND 9 9 4 1\n"))
    assert begins(costs, snapshot_of(FlightState.MISSION, 180.0), 40.0) and not costs.whole
    costs.close()


@pytest.mark.parametrize(
    ("between", "trial", "anew"),
    [
        (snapshot_of(FlightState.HOLD, 110.0), "t1", False),
        (snapshot_of(FlightState.LANDED, 110.0), "t1", True),
        (snapshot_of(FlightState.HOLD, 110.0, ""), "t1", True),
        (snapshot_of(FlightState.HOLD, 110.0), "t2", True),
    ],
)
def test_a_mission_after_another_is_a_new_curve(
    between: FleetSnapshot, trial: str, anew: bool
) -> None:
    costs = MissionCosts()
    costs.take_setup(setup(2))
    assert begins(costs, snapshot_of(FlightState.MISSION, 100.0))
    costs.follow(between)
    waiting, again = (
        snapshot_of(state, 120.0, trial) for state in (FlightState.HOLD, FlightState.MISSION)
    )
    costs.follow(waiting)
    assert (costs.mission_s(waiting) is None) == anew
    assert begins(costs, again) == anew
    costs.close()


def test_what_the_page_is_told_of_the_fleet() -> None:
    fence = replace(FENCE, vertices_m=((0.0, 0.0), (20.0, 0.0), (20.0, 20.0), (0.0, 20.0)))
    ground = GroundState(
        4, "bob", ORIGIN, enabled=True, robot_enabled={"1": False}, fence=fence, trial="t2",
        safety_action="land", safety_action_by="carol", robot_safety_actions={"1": "hold"},
    )  # fmt: skip
    turned = replace(ORIGIN, heading_deg=40.0)
    r0 = status(
        0, origin=turned, heading_rad=math.radians(50.0), neighbour_ages_s={"1": 0.21, "7": 1.0}
    )
    r1 = on_ground(1, heading_rad=math.radians(50.0), neighbour_ages_s={"0": 0.2})
    seen = snapshot(robot(r0), robot(r1, age_s=9.0), commander="bob", ground=ground)
    view = snapshot_view(setup(2), seen, ())
    assert (view["own"], view["safety_action"], view["safety_action_by"]) == (
        False,
        "land",
        "carol",
    )
    assert (view["fence"][2], max(view["buffer"])) == ([20.0, 20.0], [18.5, 18.5])
    keys = ("fresh", "enabled", "look", "in_air", "not_ready", "problem", "hears")
    assert [[robot[key] for key in keys] for robot in view["robots"]] == [
        [True, True, "mission", True, "mission", "mission started", [[1, 0.21]]],
        [False, False, "lost", False, "not heard", "GPS sees 3 satellites", [[0, None]]],
    ]
    assert view["robots"][0]["cells"] == {
        "height": ("4.0 m", ""), "battery": ("90 %", ""), "satellites": ("14", ""),
        "link": ("0.1 s", ""),
    }  # fmt: skip
    yaws_deg = [math.degrees(robot["yaw_rad"]) for robot in view["robots"]]
    assert yaws_deg == pytest.approx([10.0, 20.0], abs=0.1)
    assert [setup_view(setup(2), None)[key] for key in ("side_m", "range_m", "sensor_m")] == [
        32.0,
        8.0,
        4.0,
    ]


def test_who_stands_on_the_ground_leaves_no_path() -> None:
    paths, places_m = Paths(), {"r1": (5.0, 12.0)}
    paths.take(snapshot_of(FlightState.LANDED, 100.0), places_m)
    assert paths.view()["paths"] == {}
    paths.take(snapshot_of(FlightState.MISSION, 101.0), places_m)
    assert paths.view()["paths"] == {"r1": [(5.0, 12.0)]}


def test_numbers_that_are_none_do_not_stop_the_drawer() -> None:
    late = replace(LOOP, lateness_p99_ms=math.nan)
    broken = status(1, loops={"control": late}, hdop=math.nan)
    view = detail_view(Row(robot(broken), None, setup(2)), snapshot(), ())
    shown = json.loads(json.dumps(view, allow_nan=False))
    _, loops = shown["tables"]
    assert [cell.strip() for cell in loops["rows"][0][0]][4:] == ["0.2", "-", "3.0"]
    assert ["GPS", "14 satellites", ""] in shown["facts"]


def test_the_page_has_a_colour_for_every_look() -> None:
    """Of its own it says nothing of a robot."""
    looks = {"ready", "lost", *FlightState}
    canvas, css, panel = (
        (PAGE / name).read_text() for name in ("canvas.js", "map.css", "panel.js")
    )
    assert all(f'"{look}"' in canvas and f"--{look}: " in css for look in looks)
    assert "background = `var(--${robot.look})`" in panel
