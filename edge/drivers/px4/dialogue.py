"""Commands and requests to PX4, and their timing; setpoints are sent elsewhere.

No socket, thread or clock. PX4 loses acknowledgements when commands come in bursts, so at most one
command and one request wait for an answer at any time, requests keep apart, and each has a period
and a limit: no answer ever leads to more than the one next message.
"""

import math
from collections.abc import Mapping
from operator import itemgetter
from typing import Any, NamedTuple

from edge.core.logger import log
from edge.core.vehicle import GPS_CONTROL, Action, ActionResult, VehicleState
from edge.drivers.px4.telemetry import RATES_HZ, Px4Telemetry

_HEARTBEAT, _GPS_GLOBAL_ORIGIN, _AUTOPILOT_VERSION, _EXTENDED_SYS_STATE = 0, 49, 148, 245

_NAV_LAND, _DO_SET_MODE, _ARM_DISARM = 21, 176, 400
_RUN_PREARM_CHECKS, _SET_MESSAGE_INTERVAL, _REQUEST_MESSAGE = 401, 511, 512
_CUSTOM_MODE, _MAIN_AUTO, _MAIN_OFFBOARD, _SUB_HOLD = 1.0, 4.0, 6.0, 3.0
_FORCE = 21196.0

# MAV_RESULT
_ACCEPTED, _IN_PROGRESS = 0, 5
_REFUSALS = {1: "not now", 2: "denied", 3: "not supported", 4: "failed", 6: "cancelled"}

_REASON_S = 0.3
_STALE_COMMAND_S = 1.0
# Of requests: how soon one may follow another, how long each waits for its answer, and how often
# an unanswered one is repeated before it waits for its next period.
_APART_S, _ANSWER_S, _TIMES = 0.02, 0.3, 5
# A position that jumped waits for its origin, for half a second at most.
_ORIGIN_URGENT_S = 0.1
# A heartbeat that is so late was lost; it alone tells the mode.
_HEARTBEAT_LATE_S, _HEARTBEAT_AGAIN_S = 1.2, 0.3
_EVENTS_AGAIN_S = 0.2
# Whether to use the GPS is asked again and again, until PX4 says that it is so.
_OF_GPS, _GPS_AGAIN_S, _INT32 = (Action.IGNORE_GPS, Action.USE_GPS), 0.2, 6
# How late a request may come because nobody looked.
_LOOK_S = 0.2

Message = tuple[str, Mapping[str, Any]]


class _Command(NamedTuple):
    """How an action is sent: a COMMAND_LONG, `times` at most, until one is answered.

    `overrides` are the actions that must not be carried out after this one was asked for.
    """

    number: int
    parameters: tuple[float, ...]
    times: int
    wait_s: float
    overrides: frozenset[Action]


_COMMANDS = {
    Action.ARM: _Command(_ARM_DISARM, (1.0,), 1, 1.5, frozenset()),
    # Not repeated: a pilot may have taken the vehicle in between.
    Action.OFFBOARD: _Command(_DO_SET_MODE, (_CUSTOM_MODE, _MAIN_OFFBOARD), 1, 1.5, frozenset()),
    Action.HOLD: _Command(
        _DO_SET_MODE,
        (_CUSTOM_MODE, _MAIN_AUTO, _SUB_HOLD),
        3,
        0.5,
        frozenset({Action.ARM, Action.OFFBOARD, Action.LAND}),
    ),
    Action.LAND: _Command(
        _NAV_LAND,
        (),
        3,
        0.5,
        frozenset({Action.ARM, Action.OFFBOARD, Action.HOLD}),
    ),
    Action.DISARM: _Command(_ARM_DISARM, (0.0,), 3, 0.5, frozenset({Action.ARM, Action.OFFBOARD})),
    # Sent every time: the answer may be the one to an ARM that it overtook.
    Action.KILL: _Command(_ARM_DISARM, (0.0, _FORCE), 5, 0.1, frozenset(Action) - {Action.KILL}),
}
# What must not happen late, and not to a vehicle that is not there.
_STARTS = frozenset({Action.ARM, Action.OFFBOARD})


class _Request(NamedTuple):
    """A COMMAND_LONG that asks for something, again `period_s` after it was answered."""

    number: int
    parameters: tuple[float, ...]
    period_s: float = math.inf


_STREAMS = tuple(
    _Request(_SET_MESSAGE_INTERVAL, (float(message), 1e6 / rate_hz), 10.0)
    for message, rate_hz in RATES_HZ.items()
)
_ORIGIN = _Request(_REQUEST_MESSAGE, (_GPS_GLOBAL_ORIGIN,), 1.0)
_VERSION = _Request(_REQUEST_MESSAGE, (_AUTOPILOT_VERSION,), 1.0)
_CHECKS = _Request(_RUN_PREARM_CHECKS, (), 10.0)
_MODE = _Request(_REQUEST_MESSAGE, (_HEARTBEAT,))
# What a command changes: sooner than the next that is due.
_AFTER_COMMAND = (_MODE, _Request(_REQUEST_MESSAGE, (_EXTENDED_SYS_STATE,)))


class _Running:
    """A command that is being carried out."""

    def __init__(self, action: Action, began_s: float) -> None:
        self.action, self.command, self.began_s = action, _COMMANDS[action], began_s
        self.sent, self.wait_until_s = 0, began_s
        self.answer: int | None = None
        self.is_over = self.is_overridden = False


class Dialogue:
    """The messages to send to one vehicle; `result` is the outcome of the last command.

    `say` is called whenever `next_s` has come, and after every other call.
    """

    def __init__(self, telemetry: Px4Telemetry) -> None:
        self.result: ActionResult | None = None
        self.next_s = -math.inf
        self._telemetry = telemetry
        self._queue: list[tuple[Action, float]] = []
        self._running: _Running | None = None
        # When each request is due, and how often in a row it was not answered.
        self._due_s: dict[_Request, float] = {}
        self._sent_s: dict[_Request, float] = {}
        self._unanswered: dict[_Request, int] = {}
        self._outstanding: _Request | None = None
        self._apart_until_s = -math.inf
        self._events_at_s = -math.inf
        self._heard = (False, 0)
        # What is to become of the GPS receiver, and when that was said last.
        self._gps: Action | None = None
        self._gps_at_s = -math.inf

    @property
    def running(self) -> Action | None:
        """The action that is being carried out."""
        return None if self._running is None else self._running.action

    def command(self, action: Action, now_s: float) -> None:
        """Carry it out after those that wait, except those that it contradicts.

        They end as "superseded". An action that waits or is being carried out is not queued again.
        """
        if action in _OF_GPS:
            self._gps = action
            self.next_s = -math.inf
            return
        if action is self.running or any(action is queued for queued, _ in self._queue):
            return
        overrides = _COMMANDS[action].overrides
        for queued, _ in self._queue:
            if queued in overrides:
                self._finish(queued, "superseded", now_s)
        self._queue = [entry for entry in self._queue if entry[0] not in overrides]
        if self._running is not None and self._running.action in overrides:
            self._running.is_overridden = True
        self._queue.append((action, now_s))
        self.next_s = -math.inf

    def hear_ack(self, number: int, result: int, now_s: float) -> None:
        """Take in a COMMAND_ACK that is meant for us."""
        if result == _IN_PROGRESS:
            return
        running = self._running
        if running is not None and running.sent and number == running.command.number:
            if running.answer != _ACCEPTED:
                running.answer = result
            running.wait_until_s = now_s
            self.next_s = -math.inf
        elif self._outstanding is not None and number == self._outstanding.number:
            request = self._outstanding
            self._outstanding = None
            self._unanswered[request] = 0
            self._due_s[request] = self._sent_s[request] + request.period_s
            self.next_s = -math.inf

    def say(self, now_s: float, vehicle: VehicleState | None) -> list[Message]:
        """Return the messages due now; `vehicle` is its last state, None if none was found."""
        said: list[Message] = []
        if self._gps is not None and now_s >= self._gps_at_s + _GPS_AGAIN_S:
            value = 0.0 if self._gps is Action.IGNORE_GPS else self._telemetry.gps_control
            fields = {"param_id": GPS_CONTROL, "param_value": value, "param_type": _INT32}
            said.append(("PARAM_SET", fields))
            self._gps, self._gps_at_s = None, now_s
        while self._carry_on(now_s, said, vehicle):
            pass
        self.next_s = now_s + _LOOK_S
        if self._running is not None:
            self.next_s = min(self.next_s, self._running.wait_until_s)
        elif vehicle is not None:
            self._ask(now_s, said, vehicle)
        return said

    # Commands

    def _carry_on(self, now_s: float, said: list[Message], vehicle: VehicleState | None) -> bool:
        """Whether a command ended, so that the next one may begin."""
        running = self._running
        if running is None:
            if not self._queue:
                return False
            action, asked_at_s = self._queue.pop(0)
            refusal = _refusal(action, asked_at_s, now_s, vehicle)
            if refusal:
                self._finish(action, refusal, now_s)
                return True
            running = self._running = _Running(action, now_s)
        if running.is_overridden:
            return self._end(running, "superseded", now_s)
        if running.is_over:
            # PX4 says why it refused soon before or after the answer.
            reasons = self._telemetry.refusal_reasons(running.began_s)
            if not reasons and now_s < running.wait_until_s:
                return False
            assert running.answer is not None
            word = _REFUSALS.get(running.answer, f"result {running.answer}")
            told = "; ".join(reason.text for reason in reasons)
            return self._end(running, f"{word}: {told}" if told else word, now_s)
        if now_s < running.wait_until_s:
            return False
        command = running.command
        is_answered = running.answer is not None and running.action is not Action.KILL
        if running.sent < command.times and not is_answered:
            running.sent, running.wait_until_s = running.sent + 1, now_s + command.wait_s
            said.append(_command_long(command.number, command.parameters))
            return False
        if running.answer is None:
            return self._end(running, "no answer", now_s)
        if running.answer == _ACCEPTED:
            return self._end(running, "", now_s)
        running.is_over, running.wait_until_s = True, now_s + _REASON_S
        return self._carry_on(now_s, said, vehicle)

    def _end(self, running: _Running, refusal: str, now_s: float) -> bool:
        self._running = None
        self._finish(running.action, refusal, now_s)
        for request in _AFTER_COMMAND:
            self._due_s[request] = now_s
        return True

    def _finish(self, action: Action, refusal: str, now_s: float) -> None:
        self.result = ActionResult(action, not refusal, refusal, now_s)
        log.info("command", action=action.value, accepted=not refusal, refusal=refusal)

    # Requests

    def _ask(self, now_s: float, said: list[Message], vehicle: VehicleState) -> None:
        missing = self._telemetry.missing_events()
        if missing is not None and now_s >= self._events_at_s + _EVENTS_AGAIN_S:
            self._events_at_s = now_s
            first, last = missing
            said.append(("REQUEST_EVENT", {"first_sequence": first, "last_sequence": last}))
        request = self._outstanding
        if request is not None:
            give_up_s = self._sent_s[request] + _ANSWER_S
            if now_s < give_up_s:
                self.next_s = min(self.next_s, give_up_s)
                return
            self._outstanding = None
            times = self._unanswered[request] = self._unanswered.get(request, 0) + 1
            if times >= _TIMES:
                self._unanswered[request] = 0
                self._due_s[request] = now_s + request.period_s
        self._plan(now_s, vehicle)
        due, due_s = min(self._due_s.items(), key=itemgetter(1))
        at_s = max(due_s, self._apart_until_s)
        if now_s < at_s:
            self.next_s = min(self.next_s, at_s)
            return
        # Behind the others that are due, should it not be answered.
        self._due_s[due] = self._sent_s[due] = now_s
        self._outstanding, self._apart_until_s = due, now_s + _APART_S
        self.next_s = min(self.next_s, now_s + _ANSWER_S)
        said.append(_command_long(due.number, due.parameters))

    def _plan(self, now_s: float, vehicle: VehicleState) -> None:
        """Bring the times of all requests up to date with what is known of the vehicle."""
        heard = vehicle.connected, self._telemetry.restarts()
        if heard != self._heard:
            self._heard = heard
            self._due_s.update(dict.fromkeys(_STREAMS, now_s))
        for request, wanted in (
            (_ORIGIN, True),
            (_VERSION, not vehicle.armed),
            (_CHECKS, vehicle.armable is False and not vehicle.armed),
        ):
            if wanted:
                self._due_s.setdefault(request, now_s)
            elif self._due_s.get(request, math.inf) <= now_s:
                del self._due_s[request]
        if self._telemetry.needs_origin():
            self._hasten(_ORIGIN, _ORIGIN_URGENT_S)
        if now_s - vehicle.heartbeat_at_s > _HEARTBEAT_LATE_S:
            self._hasten(_MODE, _HEARTBEAT_AGAIN_S)

    def _hasten(self, request: _Request, after_s: float) -> None:
        """Ask for it so soon after the last time."""
        soon_s = self._sent_s.get(request, -math.inf) + after_s
        self._due_s[request] = min(self._due_s.get(request, math.inf), soon_s)


def _refusal(action: Action, asked_at_s: float, now_s: float, vehicle: VehicleState | None) -> str:
    """Why a command is not even sent; "" if it is."""
    if action in _STARTS and now_s - asked_at_s > _STALE_COMMAND_S:
        return "asked for too long ago"
    if vehicle is None or (action in _STARTS and not vehicle.connected):
        return "no vehicle"
    return ""


def _command_long(number: int, parameters: tuple[float, ...]) -> Message:
    padded = (*parameters, *(0.0,) * (7 - len(parameters)))
    fields: dict[str, Any] = {f"param{i}": value for i, value in enumerate(padded, 1)}
    return "COMMAND_LONG", {"command": number, "confirmation": 0, **fields}
