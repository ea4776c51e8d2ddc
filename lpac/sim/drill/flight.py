"""One flight of a fault, on any kind of vehicles.

The operator's part is a procedure of the real ground station; injections are scheduled on the
field's own clock. All random values follow from the seed and the fault's name.
"""

import zlib
from collections.abc import Mapping

import numpy as np

from lpac.analysis.snapshot import FleetSnapshot
from lpac.ground.procedure import Procedure, Until
from lpac.ground.station.protocol import (
    Enable,
    Request,
    SafetyCommand,
    SetOrigin,
    Start,
    Takeoff,
)
from lpac.sim.drill.faults import Fault, Phase
from lpac.sim.drill.field import FaultyFleet, Timeline
from lpac.sim.fleet.layout import ORIGIN
from lpac.sim.scenario import Scenario

# Range of a fault's start, s after the start of its phase.
_BEGINS_S: Mapping[Phase, tuple[float, float]] = {
    "ready": (1.0, 2.0), "takeoff": (0.0, 3.0), "mission": (2.0, 14.0), "return": (0.5, 12.0),
}  # fmt: skip
# From a fault on the ground until the operator takes off: the robots' checks have run by then.
_NOTICED_S = 8.0
_CONNECTED_S, _READY_S = 30.0, 60.0
# From the highest height of a large fleet down, at PX4's slowest.
_ALL_DOWN_S = 200.0


def drawn(fault: Fault, seed: int, robots: int) -> tuple[tuple[int, ...], float]:
    """Draw the robots to hit, and how long after its phase the fault begins, s."""
    rng = np.random.default_rng([seed, zlib.crc32(fault.name.encode())])
    order = rng.permutation(robots).tolist()
    hits = min(fault.hits, robots) if fault.hits else robots
    return tuple(sorted(order[:hits])), float(rng.uniform(*_BEGINS_S[fault.phase]))


def to_ready(field: FaultyFleet) -> Procedure[None]:
    """Procedure until all robots are connected and have passed their checks."""
    yield Until(lambda snapshot: all(robot.fresh for robot in snapshot.robots), _CONNECTED_S)
    for request in (SetOrigin(ORIGIN), Enable()):
        yield from _command(field, request)
    yield Until(_all_ready, _READY_S)


def to_mission(field: FaultyFleet) -> Procedure[None]:
    """Procedure from there into the mission; robots that refuse stay behind."""
    for request in (Takeoff(), Start()):
        yield from _command(field, request)


def fly(field: FaultyFleet, fault: Fault, scenario: Scenario) -> Procedure[Timeline]:
    """Procedure from `to_ready`, or `to_mission` for a fault in a later phase, to the end."""
    hit, delay_s = drawn(fault, scenario.seed, scenario.robots)
    delay_s = max([delay_s, *(field.lead_s(do.injection) - do.at_s for do in fault.does)])
    began_s = field.now_s()
    fault_s = began_s + delay_s
    marks = {do.mark: fault_s + do.at_s for do in fault.does if do.mark}
    for do in fault.does:
        field.at(delay_s + do.at_s - field.lead_s(do.injection), do, hit)
    if fault.phase == "ready":
        yield from _wait(delay_s + _NOTICED_S)
    if fault.phase in ("ready", "takeoff"):
        yield from to_mission(field)
    if fault.phase == "return":
        yield from _command(field, SafetyCommand("return", wait=True))
    yield from _wait(max(0.0, fault_s + fault.watched_s - field.now_s()))
    if fault.home:
        for action in ("return", "land"):
            if not field.all_down():
                yield from _command(field, SafetyCommand(action, wait=True))
    yield Until(lambda _: field.all_down(), _ALL_DOWN_S)
    yield from _wait(1.0)
    return Timeline(hit, fault_s, marks)


def _command(field: FaultyFleet, request: Request) -> Procedure[None]:
    """Send a command, if the ground runs, and wait for its report or a timeout."""
    if field.ground_runs:
        answered = field.record_order(request)
        yield request
        answered()


def _wait(seconds: float) -> Procedure[None]:
    yield Until(lambda _: False, seconds)


def _all_ready(snapshot: FleetSnapshot) -> bool:
    return all(robot.status is not None and robot.status.ready for robot in snapshot.robots)
