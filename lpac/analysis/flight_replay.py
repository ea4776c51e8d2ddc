"""Recomputes flight decisions from a flight log, and compares them with the logged ones.

Each tick is computed from its logged inputs and memory, so differences do not propagate.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from edge.core.changes import plain, same
from edge.flight.guidance import guide
from edge.flight.record import FlightTick, Given, Made, TickReader, made
from edge.flight.state import FlightMemory
from edge.flight.step import step

# Processors differ in the last of 16 digits.
_ROUNDING = 1e-9
_REST = tuple(n for n in FlightMemory.__struct_fields__ if n not in ("state", "reason"))


class Differing(NamedTuple):
    """One differing item of a tick, such as "state", with both values as text.

    `is_rounding`: only numbers that differ in their last digits.
    """

    what: str
    then: str
    now: str
    is_rounding: bool


@dataclass(slots=True)
class FlightDifference:
    """A difference in `ticks` ticks in a row, with the values of the first of them."""

    since_unix_s: float
    until_unix_s: float
    ticks: int
    differing: Differing


class FlightReplay:
    """Recomputes the ticks of a log in order.

    `ticks` were recomputed, of which `differing` differ; `passed_over` could not be, since messages
    before them are missing. `began_unix_s` is the time of the first.
    """

    def __init__(self, reader: TickReader | None = None) -> None:
        """`reader` has read the same program's earlier messages."""
        self.began_unix_s = math.nan
        self.ticks = self.differing = self.passed_over = 0
        self.differences: list[FlightDifference] = []
        self._reader = reader or TickReader()
        # Differences of the last tick by item.
        self._ongoing: dict[str, FlightDifference] = {}

    def run(self, unix_time_s: float, message: Mapping[str, Any]) -> None:
        """Recompute the tick of one message of the topic `flight`. Raises TickError."""
        tick = self._reader.tick(message)
        if tick is None:
            self.passed_over += 1
            self._ongoing = {}
            return
        if not self.ticks:
            self.began_unix_s = unix_time_s
        self.ticks += 1
        before, self._ongoing = self._ongoing, {}
        for each in differing(tick):
            difference = before.get(each.what)
            if difference is None or difference.differing.is_rounding != each.is_rounding:
                difference = FlightDifference(unix_time_s, unix_time_s, 0, each)
                self.differences.append(difference)
            difference.until_unix_s = unix_time_s
            difference.ticks += 1
            self._ongoing[each.what] = difference
        self.differing += bool(self._ongoing)


def differing(tick: FlightTick) -> Iterator[Differing]:
    """Yield the differences of a tick, compared bit by bit."""
    then, now = tick.made, run_again(tick.given)
    for what, one, other in (
        ("state", then.flight.state, now.flight.state),
        ("reason", then.flight.reason, now.flight.reason),
        ("actions", then.actions, now.actions),
        ("alarms", then.alarms, now.alarms),
        ("new trial", then.new_trial, now.new_trial),
        ("velocity", then.velocity_m_s, now.velocity_m_s),
        ("position", then.position_m, now.position_m),
        *((f"memory: {n}", getattr(then.flight, n), getattr(now.flight, n)) for n in _REST),
        ("guidance: velocity", then.guidance.velocity_m_s, now.guidance.velocity_m_s),
        ("guidance: recovering", then.guidance.recovering, now.guidance.recovering),
    ):
        if not same(one, other):
            rounding = _is_rounding(plain(one), plain(other))
            yield Differing(what, _words(plain(one)), _words(plain(other)), rounding)


def run_again(given: Given) -> Made:
    """Decide a tick again."""
    decision = step(given.robot, given.flight, given.inputs)
    setpoint, guidance = guide(
        given.robot, decision.flight, given.inputs, given.guidance, given.dt_s
    )
    return made(decision, setpoint, guidance)


def _is_rounding(one: Any, other: Any) -> bool:
    if isinstance(one, list | tuple) and isinstance(other, list | tuple):
        return len(one) == len(other) and all(map(_is_rounding, one, other))
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=_ROUNDING, abs_tol=_ROUNDING)
    return bool(one == other)


def _words(value: Any) -> str:
    if isinstance(value, Mapping):
        return ": ".join(_words(each) for each in value.values())
    if isinstance(value, list | tuple):
        return ", ".join(map(_words, value)) or "none"
    return "none" if value is None else str(value)
