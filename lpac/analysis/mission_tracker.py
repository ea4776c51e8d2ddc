"""Detects missions: where one ends, and the next of the same name begins."""

from typing import NamedTuple, Protocol

from edge.messages.mission import ON_GROUND, FlightState

_SILENT_S = 10.0


class MissionStatus(Protocol):
    """State of a robot that tracking needs: a `RobotStatus`, or a part of it."""

    @property
    def boot_nonce(self) -> int: ...
    @property
    def state(self) -> FlightState: ...
    @property
    def trial(self) -> str: ...
    @property
    def armed(self) -> bool | None: ...


class _Flown(NamedTuple):
    """A robot in a mission; `heard_s` is the time of its last status."""

    trial: str
    boot_nonce: int
    heard_s: float


class MissionTracker:
    """Tracks missions from statuses in order of time.

    A robot takes part in a mission from when it flies it until it is on the ground and disarmed, is
    killed, begins another trial, or its trial is reset. The mission ends when no robot takes part.
    A robot that has been silent for `silent_s` does not keep it alive.
    """

    def __init__(self, silent_s: float = _SILENT_S) -> None:
        self._silent_s = silent_s
        self._flown: dict[int, _Flown] = {}

    @property
    def robots(self) -> set[int]:
        """Ids of the robots that take part in a mission."""
        return set(self._flown)

    def begins(self, robot_id: int, status: MissionStatus, heard_s: float) -> bool:
        """Add a robot's status; returns whether a mission begins with it."""
        before = self._flown.pop(robot_id, None)
        goes_on = before is not None and before[:2] == (status.trial, status.boot_nonce)
        now = _Flown(status.trial, status.boot_nonce, heard_s)
        if status.state is FlightState.MISSION:
            others = [flown for flown in self._flown.values() if flown.trial == status.trial]
            self._flown[robot_id] = now
            return not goes_on and all(heard_s - o.heard_s > self._silent_s for o in others)
        # A robot that lost its autopilot may recover, and fly on.
        killed = status.state is FlightState.FAULT and status.armed is False
        if goes_on and not killed and (status.state not in ON_GROUND or status.armed):
            self._flown[robot_id] = now
        return False
