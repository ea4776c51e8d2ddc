"""Inputs and results of control ticks in the flight log.

A message has the exact differences from the one before; every hundredth is complete, so that a log
can be read from the middle. A tick's memory is usually the result of the last one.
"""

from collections.abc import Mapping
from typing import Any

from msgspec import Struct
from msgspec.structs import replace

from edge.core.changes import changed, changes
from edge.core.vehicle import Action, Vector
from edge.flight.guidance import Guidance, MissionPosition, MissionSetpoint, MissionVelocity
from edge.flight.state import FlightInputs, FlightMemory, Robot
from edge.flight.step import Decision
from edge.messages.codes import Reason

# Every 10 s at 10 Hz.
_COMPLETE_EVERY = 100


class TickError(ValueError):
    """A message is not a valid tick; the text says why."""


class Given(Struct, frozen=True, eq=False):
    """All inputs of `step` and `guide` in one tick."""

    robot: Robot
    flight: FlightMemory
    inputs: FlightInputs
    guidance: Guidance
    dt_s: float


class Made(Struct, frozen=True, eq=False):
    """Result of a tick. One of the two setpoints is set, in the mission frame, or none."""

    flight: FlightMemory
    actions: tuple[Action, ...]
    alarms: tuple[Reason, ...]
    new_trial: bool
    velocity_m_s: Vector | None
    position_m: Vector | None
    guidance: Guidance


def made(decision: Decision, setpoint: MissionSetpoint | None, guidance: Guidance) -> Made:
    """Make the record of `step`'s and `guide`'s results."""
    return Made(
        flight=decision.flight,
        actions=decision.actions,
        alarms=decision.alarms,
        new_trial=decision.new_trial,
        velocity_m_s=setpoint.velocity_m_s if isinstance(setpoint, MissionVelocity) else None,
        position_m=setpoint.position_m if isinstance(setpoint, MissionPosition) else None,
        guidance=guidance,
    )


class FlightTick(Struct, frozen=True, eq=False):
    """One control tick."""

    given: Given
    made: Made


class TickWriter:
    """Encodes one program's ticks as messages, in order."""

    def __init__(self) -> None:
        self._last: FlightTick | None = None
        self._number = 0

    def message(self, tick: FlightTick) -> dict[str, Any]:
        """Message of plain values."""
        last = self._last if self._number % _COMPLETE_EVERY else None
        given = changes(None if last is None else _next_inputs(last), tick.given)
        made = changes(None if last is None else _next_result(last, tick.given), tick.made)
        message = {"number": self._number, "whole": last is None, "given": given, "made": made}
        self._last, self._number = tick, self._number + 1
        return message


class TickReader:
    """Decodes messages into ticks."""

    def __init__(self) -> None:
        self._last: FlightTick | None = None
        self._number = -1

    def tick(self, message: Mapping[str, Any]) -> FlightTick | None:
        """Decode a tick; None if messages before it are missing. Raises TickError."""
        try:
            number, whole = int(message["number"]), bool(message["whole"])
            if not whole and (self._last is None or number != self._number + 1):
                self._last = None
                return None
            last = None if whole else self._last
            given = changed(Given, None if last is None else _next_inputs(last), message["given"])
            base = None if last is None else _next_result(last, given)
            self._last = FlightTick(given, changed(Made, base, message["made"]))
        except KeyError as error:
            raise TickError(f"{error} is missing") from None
        except (AttributeError, TypeError, ValueError, RecursionError) as error:
            raise TickError(str(error)) from None
        self._number = number
        return self._last


def _next_inputs(last: FlightTick) -> Given:
    """Inputs of the next tick if nothing changes."""
    return replace(last.given, flight=last.made.flight, guidance=last.made.guidance)


def _next_result(last: FlightTick, given: Given) -> Made:
    """Result of this tick if nothing changes."""
    return replace(last.made, flight=given.flight, guidance=given.guidance)
