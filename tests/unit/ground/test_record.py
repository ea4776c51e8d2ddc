"""The ground's log: each thing once, and costs by trial."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from edge.core import F64
from edge.core.fence import Fence
from edge.core.world import parse_world, rasterize
from edge.messages.mission import FlightState, GroundState, Origin, Place
from lpac.analysis.coverage import Coverage
from lpac.analysis.snapshot import Explored, FleetSetup, FleetSnapshot, GroundEvent, RobotSnapshot
from lpac.analysis.voronoi import coverage_cost
from lpac.ground.record import Recording, _summary
from lpac.ground.station.protocol import (
    ServerMessage,
)
from tests.unit.analysis.test_coverage import STATUS, model

S = FlightState
FENCE = Fence(((-1.0, -1.0), (33.0, -1.0), (33.0, 33.0), (-1.0, 33.0)), 0.5, 1.0, 20.0)
WORLD = model()
SETUP = FleetSetup(
    fleet="f", operator="ann", robots={"r0": 0, "r1": 1}, slots=(), fence=FENCE,
    world=WORLD.world, world_id=WORLD.world_id, bundle_id="b", world_size=WORLD.world_size,
    sensor_size=16, communication_range=64.0, env_scale=WORLD.env_scale,
    truncation=WORLD.truncation, norm=WORLD.norm,
)  # fmt: skip
STATE = GroundState(3, "ann", Origin(47.0, 8.0, 0.0), places={"0": Place(0, (1.0, 2.0))})


class Kept:
    """What a `Recording` records."""

    def __init__(self) -> None:
        self.entries: list[tuple[str, float, Mapping[str, Any]]] = []
        self.recording = Recording(lambda *entry: self.entries.append(entry))

    def of(self, topic: str) -> list[Mapping[str, Any]]:
        return [message for name, _, message in self.entries if name == topic]


def snapshot(
    now_s: float, sequence: int, x_m: float, state: S = S.MISSION, **more: Any
) -> FleetSnapshot:
    """Two robots, of which the second was heard 0.1 s ago."""
    statuses = (
        dataclasses.replace(
            STATUS, robot_id=i, sequence=sequence, state=state, armed=state is not S.LANDED,
            trial="t1", position_m=(x_m, 5.0 + 20.0 * i, 4.0),
        )
        for i in range(2)
    )  # fmt: skip
    robots = tuple(
        RobotSnapshot(f"r{i}", i, status, 0.1 * i, 0.5) for i, status in enumerate(statuses)
    )
    return FleetSnapshot(now_s, "ann", STATE, robots, **more)


def test_each_thing_is_recorded_once() -> None:
    kept = Kept()
    event = GroundEvent(99.0, "command", "", "takeoff", "ann", "t1")
    told: list[tuple[float, ServerMessage]] = [
        (100.0, SETUP), (100.0, event), (100.0, Explored("r0", "AAAA")),
        (100.2, snapshot(100.2, 1, 1.0)), (100.4, snapshot(100.4, 1, 1.0)),
        # The same again from the ground's next process, and something new.
        (105.0, event), (105.0, Explored("r0", "AAAA")), (105.0, Explored("r0", "AAAB")),
        (105.2, snapshot(105.2, 2, 2.0)),
        (166.0, snapshot(166.0, 3, 3.0)),
    ]  # fmt: skip
    for now_s, message in told:
        kept.recording.take(message, now_s)
    kept.recording.close()
    assert kept.of("event") == [dataclasses.asdict(event)]
    assert [e["cells"] for e in kept.of("explored")] == ["AAAA", "AAAB"]
    assert [s["sequence"] for s in kept.of("state")] == [3]
    said = [(s["name"], s["sequence"]) for s in kept.of("status")]
    assert said == [("r0", 1), ("r1", 1), ("r0", 2), ("r1", 2), ("r0", 3), ("r1", 3)]
    # When they were heard, by the ground's clock.
    heard = [(at_s, m["heard_at_unix_s"]) for topic, at_s, m in kept.entries if topic == "status"]
    assert heard[:2] == [(100.2, 100.2), (pytest.approx(100.1), pytest.approx(100.1))]
    assert {s["clock_offset_s"] for s in kept.of("status")} == {0.5}
    assert len(kept.of("setup")) == 2  # the second after a minute
    # No cost for the second picture, which came too soon after the first.
    assert [at_s for topic, at_s, _ in kept.entries if topic == "cost"] == [100.2, 105.2, 166.0]


def test_the_cost_is_normalised_by_each_trials_begin() -> None:
    kept = Kept()
    kept.recording.take(SETUP, 0.0)
    kept.recording.take(snapshot(1.0, 1, 1.0, S.HOLD), 1.0)
    kept.recording.take(snapshot(2.0, 2, 5.0), 2.0)
    kept.recording.take(snapshot(3.0, 3, 9.0), 3.0)
    kept.recording.close()
    raster = rasterize(parse_world(WORLD.world), WORLD.world_size, 2.0, 1.0)
    expected = [
        coverage_cost(raster, np.array([(x_m, 5.0), (x_m, 25.0)]) * WORLD.env_scale)
        for x_m in (1.0, 5.0, 9.0)
    ]
    costs = kept.of("cost")
    assert [cost["cost"] for cost in costs] == expected
    assert [cost["initial"] for cost in costs] == [None, expected[1], expected[1]]
    assert costs[2]["normalized"] == expected[2] / expected[1]
    assert [cost["flying_mission"] for cost in costs] == [False, True, True]
    assert {(cost["trial"], cost["robots"]) for cost in costs} == {("t1", ("r0", "r1"))}


def test_a_name_that_is_flown_again_begins_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    bounds: list[F64] = []

    def lloyd(_: Coverage, positions_m: F64) -> float:
        bounds.append(positions_m)
        return 1.0

    monkeypatch.setattr(Coverage, "lloyd", lloyd)
    kept = Kept()
    kept.recording.take(SETUP, 0.0)
    flown = ((S.MISSION, 1.0), (S.HOLD, 5.0), (S.MISSION, 6.0), (S.LANDED, 7.0), (S.HOLD, 7.0))
    for second, (state, x_m) in enumerate((*flown, (S.MISSION, 9.0)), 1):
        kept.recording.take(snapshot(float(second), second, x_m, state), float(second))
    kept.recording._costs._pool.shutdown()
    assert [positions_m[0, 0] for positions_m in bounds] == [1.0, 9.0]
    costs = kept.of("cost")
    first = costs[0]["cost"]
    # A pause is no new mission; after landing there is a new one.
    assert [cost["initial"] for cost in costs] == [*[first] * 5, costs[5]["cost"]]
    assert costs[5]["normalized"] == 1.0 != costs[4]["normalized"]


def test_what_is_flown_now_is_that_of_those_who_fly() -> None:
    kept = Kept()
    kept.recording.take(SETUP, 0.0)
    seen = snapshot(1.0, 1, 1.0)
    holds, flies = (robot.status for robot in seen.robots)
    assert holds is not None and flies is not None
    pairs = (
        (dataclasses.replace(holds, state=S.HOLD), dataclasses.replace(flies, trial="t2")),
        (holds, dataclasses.replace(flies, state=S.LANDED, armed=False)),
    )
    for second, pair in enumerate(pairs, 1):
        robots = tuple(
            dataclasses.replace(robot, status=status)
            for robot, status in zip(seen.robots, pair, strict=True)
        )
        told = dataclasses.replace(seen, unix_time_s=float(second), robots=robots)
        kept.recording.take(told, float(second))
        assert kept.recording.flying
    assert kept.of("cost")[0]["trial"] == "t2"
    cost = kept.recording.cost
    assert cost is not None and cost.normalized is not None
    assert _summary(told, cost).partition("  ")[2] == (
        f"2 of 2 robots heard  trial t1  1 in the air  cost {cost.normalized:.2f} of the initial"
    )
    kept.recording.take(FleetSnapshot(9.0, "ann", STATE, ()), 9.0)
    kept.recording.close()
    assert kept.recording.cost is None and not kept.recording.flying


@pytest.mark.parametrize("world", ["", "Circle 1 2"])
def test_without_a_world_all_else_is_recorded(world: str) -> None:
    kept = Kept()
    kept.recording.take(dataclasses.replace(SETUP, world=world), 0.0)
    kept.recording.take(snapshot(1.0, 1, 1.0), 1.0)
    kept.recording.close()
    assert [topic for topic, _, _ in kept.entries] == ["setup", "state", "status", "status"]
