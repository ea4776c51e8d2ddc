"""Which mission is under way: one of a name ends where the next begins."""

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
    """A robot in a mission; `heard_s` is when it said so last."""

    trial: str
    boot_nonce: int
    heard_s: float


class MissionTracker:
    """Follows what robots say, in the order of time.

    A robot has part in a mission from when it flies it until it is on the ground, disarmed, is
    killed, begins another trial, or its trial is reset. The mission ends when nobody has part in
    it. Who was heard no more for `silent_s` does not keep it going by itself.
    """

    def __init__(self, silent_s: float = _SILENT_S) -> None:
        self._silent_s = silent_s
        self._flown: dict[int, _Flown] = {}

    @property
    def robots(self) -> set[int]:
        """The ids of those that have part in a mission."""
        return set(self._flown)

    def begins(self, robot_id: int, said: MissionStatus, heard_s: float) -> bool:
        """Take what a robot said; whether a mission begins with it."""
        before = self._flown.pop(robot_id, None)
        goes_on = before is not None and before[:2] == (said.trial, said.boot_nonce)
        now = _Flown(said.trial, said.boot_nonce, heard_s)
        if said.state is FlightState.MISSION:
            others = [flown for flown in self._flown.values() if flown.trial == said.trial]
            self._flown[robot_id] = now
            return not goes_on and all(heard_s - o.heard_s > self._silent_s for o in others)
        # Who has lost its autopilot may get it back, and fly on.
        killed = said.state is FlightState.FAULT and said.armed is False
        if goes_on and not killed and (said.state not in ON_GROUND or said.armed):
            self._flown[robot_id] = now
        return False
