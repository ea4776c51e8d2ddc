"""One flight of a fault, as its operator flies it, on whatever vehicles there are.

The operator's part is a procedure of the real ground; what is done to the fleet is put on the
field's own clock. Everything that is drawn follows from the seed and the fault's name.
"""

import zlib
from collections.abc import Callable, Mapping
from typing import NamedTuple, Protocol

import numpy as np

from lpac.analysis.snapshot import FleetSnapshot
from lpac.ground.procedure import Ground, NothingComesError, Procedure, Until
from lpac.ground.station.protocol import (
    CommandReport,
    Enable,
    Request,
    SafetyCommand,
    SetOrigin,
    Start,
    Takeoff,
)
from lpac.sim.drill.faults import Fault, Phase
from lpac.sim.drill.injections import Do, Injection
from lpac.sim.fleet.layout import ORIGIN
from lpac.sim.scenario import Scenario

# When a fault begins, after its phase has.
_BEGINS_S: Mapping[Phase, tuple[float, float]] = {
    "ready": (1.0, 2.0), "takeoff": (0.0, 3.0), "mission": (2.0, 14.0), "return": (0.5, 12.0),
}  # fmt: skip
# From a fault on the ground until the operator takes off: the robots' checks have run by then.
_NOTICED_S = 8.0
_HEARD_S, _READY_S = 30.0, 60.0
# From the highest height of a large fleet down, at PX4's slowest.
_ALL_DOWN_S = 200.0


class Field(Protocol):
    """A fleet that faults are done to, under its ground, on some kind of vehicles."""

    @property
    def ground(self) -> Ground:
        """The ground that commands now."""
        ...

    @property
    def ground_runs(self) -> bool:
        """Whether it does."""
        ...

    def at(self, after_s: float, do: Do, hit: tuple[int, ...]) -> None:
        """Have something happen, so much later."""
        ...

    def lead_s(self, injection: Injection) -> float:
        """How much earlier it has to happen to be felt in time."""
        ...

    def now_s(self) -> float:
        """The vehicles' clock."""
        ...

    def all_down(self) -> bool:
        """Whether all vehicles really stand on the ground, motors off."""
        ...

    def noted(self, request: Request) -> Callable[[], None]:
        """Note that something is commanded now; call the result when it is answered."""
        ...


class Timeline(NamedTuple):
    """Robots that were hit, and times of the fault and its marks, s of the vehicles' clock."""

    hit: tuple[int, ...]
    fault_s: float
    marks: Mapping[str, float]


def drawn(fault: Fault, seed: int, robots: int) -> tuple[tuple[int, ...], float]:
    """Draw the robots to hit, and how long after its phase the fault begins, s."""
    rng = np.random.default_rng([seed, zlib.crc32(fault.name.encode())])
    order = rng.permutation(robots).tolist()
    hits = min(fault.hits, robots) if fault.hits else robots
    return tuple(sorted(order[:hits])), float(rng.uniform(*_BEGINS_S[fault.phase]))


def to_ready(field: Field) -> Procedure[None]:
    """All are heard, and have passed their checks."""
    yield Until(lambda told: all(robot.fresh for robot in told.robots), _HEARD_S)
    for request in (SetOrigin(ORIGIN), Enable()):
        yield from _command(field, request)
    yield Until(_all_ready, _READY_S)


def to_mission(field: Field) -> Procedure[None]:
    """From there into the mission, as far as it goes: who refuses stays behind."""
    for request in (Takeoff(), Start()):
        yield from _command(field, request)


def fly(field: Field, fault: Fault, scenario: Scenario) -> Procedure[Timeline]:
    """From `to_ready`, or for a fault in the mission or later from `to_mission`, to the end."""
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


def _command(field: Field, request: Request) -> Procedure[CommandReport | None]:
    """Report of the command; None if there is no ground, or it does not end."""
    if not field.ground_runs:
        return None
    answered = field.noted(request)
    try:
        report: CommandReport = yield request
    except NothingComesError:
        return None
    finally:
        answered()
    return report


def _wait(seconds: float) -> Procedure[None]:
    yield Until(lambda _: False, seconds)


def _all_ready(told: FleetSnapshot) -> bool:
    return all(robot.status is not None and robot.status.ready for robot in told.robots)
