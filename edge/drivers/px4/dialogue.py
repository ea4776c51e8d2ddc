"""Commands and requests to PX4, and their timing. No socket, thread or clock.

PX4 loses acknowledgements of commands that arrive in bursts. Therefore at most one command and one
request await an answer at any time, requests are spaced, and each has a period and a limit of
repetitions. An answer never triggers more than one message. Setpoints are sent elsewhere.
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
# Requests: spacing, time for an answer, and attempts before the next period.
_SPACING_S, _ANSWER_S, _ATTEMPTS = 0.02, 0.3, 5
# A position that jumped is withheld until the origin arrives, for at most 0.5 s.
_ORIGIN_PERIOD_S = 0.1
# A heartbeat that is this late was lost; only a heartbeat reports the mode.
_HEARTBEAT_LATE_S, _HEARTBEAT_PERIOD_S = 1.2, 0.3
_EVENTS_PERIOD_S = 0.2
_GPS_ACTIONS, _GPS_PERIOD_S, _INT32 = (Action.IGNORE_GPS, Action.USE_GPS), 0.2, 6
# Longest time between two calls of `due_messages`.
_POLL_S = 0.2

Message = tuple[str, Mapping[str, Any]]


class _Command(NamedTuple):
    """COMMAND_LONG of an action, sent up to `attempts` times, until it is answered.

    `overrides` are actions that must not be executed after this one was requested.
    """

    number: int
    parameters: tuple[float, ...]
    attempts: int
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
        _NAV_LAND, (), 3, 0.5, frozenset({Action.ARM, Action.OFFBOARD, Action.HOLD})
    ),
    Action.DISARM: _Command(_ARM_DISARM, (0.0,), 3, 0.5, frozenset({Action.ARM, Action.OFFBOARD})),
    # Sent all five times: an answer may belong to an ARM that it overtook.
    Action.KILL: _Command(_ARM_DISARM, (0.0, _FORCE), 5, 0.1, frozenset(Action) - {Action.KILL}),
}
# Commands that must not be executed late, and need a connected vehicle.
_STARTS = frozenset({Action.ARM, Action.OFFBOARD})


class _Request(NamedTuple):
    """COMMAND_LONG that requests a message or setting, repeated `period_s` after its answer."""

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
# Messages that a command changes, requested at once after it.
_AFTER_COMMAND = (_MODE, _Request(_REQUEST_MESSAGE, (_EXTENDED_SYS_STATE,)))


class _Running:
    """Command in progress; `is_refused` while PX4's reasons for its refusal are awaited."""

    def __init__(self, action: Action, began_s: float) -> None:
        self.action, self.command, self.began_s = action, _COMMANDS[action], began_s
        self.sent, self.wait_until_s = 0, began_s
        self.answer: int | None = None
        self.is_refused = self.is_overridden = False


class Dialogue:
    """Messages to one vehicle; `result` is the outcome of the last command.

    Call `due_messages` at `next_s`, and after every call of another method.
    """

    def __init__(self, telemetry: Px4Telemetry) -> None:
        self.result: ActionResult | None = None
        self.next_s = -math.inf
        self._telemetry = telemetry
        self._queue: list[tuple[Action, float]] = []
        self._running: _Running | None = None
        self._due_s: dict[_Request, float] = {}
        self._sent_s: dict[_Request, float] = {}
        # Number of attempts in this period.
        self._unanswered: dict[_Request, int] = {}
        self._outstanding: _Request | None = None
        self._spaced_until_s = -math.inf
        self._events_at_s = -math.inf
        self._connection = (False, 0)
        self._gps: Action | None = None
        self._gps_at_s = -math.inf

    @property
    def running(self) -> Action | None:
        """The action in progress."""
        return None if self._running is None else self._running.action

    def command(self, action: Action, now_s: float) -> None:
        """Queue an action. Actions that it overrides end as "superseded".

        An action that is queued or in progress is not queued again.
        """
        if action in _GPS_ACTIONS:
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

    def receive_ack(self, number: int, result: int, now_s: float) -> None:
        """Process a COMMAND_ACK addressed to this program."""
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

    def due_messages(self, now_s: float, vehicle: VehicleState | None) -> list[Message]:
        """Return the messages due now; `vehicle` is its last state, None if none was found."""
        due: list[Message] = []
        if self._gps is not None and now_s >= self._gps_at_s + _GPS_PERIOD_S:
            value = 0.0 if self._gps is Action.IGNORE_GPS else self._telemetry.gps_control
            fields = {"param_id": GPS_CONTROL, "param_value": value, "param_type": _INT32}
            due.append(("PARAM_SET", fields))
            self._gps, self._gps_at_s = None, now_s
        while self._advance(now_s, due, vehicle):
            pass
        self.next_s = now_s + _POLL_S
        if self._running is not None:
            self.next_s = min(self.next_s, self._running.wait_until_s)
        elif vehicle is not None:
            self._send_request(now_s, due, vehicle)
        return due

    def _advance(self, now_s: float, due: list[Message], vehicle: VehicleState | None) -> bool:
        """Advance the command in progress; returns whether it ended, so the next may begin."""
        running = self._running
        if running is None:
            if not self._queue:
                return False
            action, queued_at_s = self._queue.pop(0)
            refusal = _refusal(action, queued_at_s, now_s, vehicle)
            if refusal:
                self._finish(action, refusal, now_s)
                return True
            running = self._running = _Running(action, now_s)
        if running.is_overridden:
            return self._end(running, "superseded", now_s)
        if running.is_refused:
            # PX4 sends the reasons shortly before or after the answer.
            reasons = self._telemetry.refusal_reasons(running.began_s)
            if not reasons and now_s < running.wait_until_s:
                return False
            assert running.answer is not None
            word = _REFUSALS.get(running.answer, f"result {running.answer}")
            why = "; ".join(reason.text for reason in reasons)
            return self._end(running, f"{word}: {why}" if why else word, now_s)
        if now_s < running.wait_until_s:
            return False
        command = running.command
        is_answered = running.answer is not None and running.action is not Action.KILL
        if running.sent < command.attempts and not is_answered:
            running.sent, running.wait_until_s = running.sent + 1, now_s + command.wait_s
            due.append(_command_long(command.number, command.parameters))
            return False
        if running.answer is None:
            return self._end(running, "no answer", now_s)
        if running.answer == _ACCEPTED:
            return self._end(running, "", now_s)
        running.is_refused, running.wait_until_s = True, now_s + _REASON_S
        return self._advance(now_s, due, vehicle)

    def _end(self, running: _Running, refusal: str, now_s: float) -> bool:
        self._running = None
        self._finish(running.action, refusal, now_s)
        for request in _AFTER_COMMAND:
            self._due_s[request] = now_s
        return True

    def _finish(self, action: Action, refusal: str, now_s: float) -> None:
        self.result = ActionResult(action, not refusal, refusal, now_s)
        log.info("command", action=action.value, accepted=not refusal, refusal=refusal)

    def _send_request(self, now_s: float, due: list[Message], vehicle: VehicleState) -> None:
        missing = self._telemetry.missing_events()
        if missing is not None and now_s >= self._events_at_s + _EVENTS_PERIOD_S:
            self._events_at_s = now_s
            first, last = missing
            due.append(("REQUEST_EVENT", {"first_sequence": first, "last_sequence": last}))
        request = self._outstanding
        if request is not None:
            give_up_s = self._sent_s[request] + _ANSWER_S
            if now_s < give_up_s:
                self.next_s = min(self.next_s, give_up_s)
                return
            self._outstanding = None
            attempts = self._unanswered[request] = self._unanswered.get(request, 0) + 1
            if attempts >= _ATTEMPTS:
                self._unanswered[request] = 0
                self._due_s[request] = now_s + request.period_s
        self._schedule(now_s, vehicle)
        request, due_s = min(self._due_s.items(), key=itemgetter(1))
        at_s = max(due_s, self._spaced_until_s)
        if now_s < at_s:
            self.next_s = min(self.next_s, at_s)
            return
        # If unanswered, it comes after the others that are due.
        self._due_s[request] = self._sent_s[request] = now_s
        self._outstanding, self._spaced_until_s = request, now_s + _SPACING_S
        self.next_s = min(self.next_s, now_s + _ANSWER_S)
        due.append(_command_long(request.number, request.parameters))

    def _schedule(self, now_s: float, vehicle: VehicleState) -> None:
        """Update the times of all requests from the vehicle's state."""
        connection = vehicle.connected, self._telemetry.restarts()
        if connection != self._connection:
            self._connection = connection
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
            self._request_within(_ORIGIN, _ORIGIN_PERIOD_S)
        if now_s - vehicle.heartbeat_at_s > _HEARTBEAT_LATE_S:
            self._request_within(_MODE, _HEARTBEAT_PERIOD_S)

    def _request_within(self, request: _Request, after_s: float) -> None:
        """Repeat the request at the latest `after_s` after the last attempt."""
        soon_s = self._sent_s.get(request, -math.inf) + after_s
        self._due_s[request] = min(self._due_s.get(request, math.inf), soon_s)


def _refusal(action: Action, queued_at_s: float, now_s: float, vehicle: VehicleState | None) -> str:
    """Reason not to send a command; "" if there is none."""
    if action in _STARTS and now_s - queued_at_s > _STALE_COMMAND_S:
        return "requested too long ago"
    if vehicle is None or (action in _STARTS and not vehicle.connected):
        return "no vehicle"
    return ""


def _command_long(number: int, parameters: tuple[float, ...]) -> Message:
    padded = (*parameters, *(0.0,) * (7 - len(parameters)))
    fields: dict[str, Any] = {f"param{i}": value for i, value in enumerate(padded, 1)}
    return "COMMAND_LONG", {"command": number, "confirmation": 0, **fields}
