"""PX4 over MAVSDK: telemetry, setpoints and commands of one vehicle.

Setpoints go through `mavlink_direct`, which sends each once. MAVSDK's offboard plugin would repeat
the last one for ever, and so hide a dead control loop from PX4's failsafe. Commands go the same way
(`dialogue`), since MAVSDK repeats an unanswered one three times within two seconds, and arming must
never be repeated.
"""

import json
import math
import re
import struct
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from threading import Condition, Lock, Thread
from typing import Any, NamedTuple, Self

from mavsdk.component_type import ComponentType
from mavsdk.exceptions import MavsdkError
from mavsdk.logging import LogLevel, log_subscribe
from mavsdk.mavsdk import Configuration, Mavsdk
from mavsdk.plugins.geofence import FenceType, Geofence, GeofenceData, Point, Polygon
from mavsdk.plugins.mavlink_direct import MavlinkDirect, MavlinkMessage
from mavsdk.plugins.param import Param
from mavsdk.system import System

from edge.core.logger import log
from edge.core.vehicle import Action, Setpoint, VehicleState, Velocity
from edge.drivers.px4.datagrams import Datagrams, LinkState
from edge.drivers.px4.dialogue import Dialogue
from edge.drivers.px4.telemetry import Px4Telemetry

_AUTOPILOT = 1  # component id
_INT32, _REAL32 = 6, 9
_LOCAL_NED = 1
# Ignored fields: acceleration, yaw, yaw rate; and position or velocity.
_VELOCITY_MASK, _POSITION_MASK = 0b110111000111, 0b110111111000
# Larger coordinates are errors.
_MAX_COORDINATE = 1e6

_SEARCH_PERIOD_S = 1.0
# Attempts for a request without answer, and on a link that loses messages.
_ATTEMPTS, _ATTEMPTS_WITH_LOSS = 3, 12
_PARAMETER_TIMEOUT_S = 0.3
_ABSENT_AFTER_CALLS = 5
# PX4's name of the checksum over all parameters' names and values.
_CHECKSUM = "_HASH_CHECK"
# PX4 sends its fence's id once a second. One received just after an upload may be the old one.
_FENCE_ID_VALID_S, _FENCE_ID_LATE_S = 3.5, 0.5
_FENCE_TIMEOUT_S = 0.5
_FENCE = 1  # MAV_MISSION_TYPE


class AutopilotError(OSError):
    """The autopilot did not execute a command; the text is one line."""


class _UploadedFence(NamedTuple):
    """Identification of a fence; the id is 0 before PX4 v1.15, which has none."""

    corners: int
    fence_id: int


class _Link(NamedTuple):
    """Connection to the vehicle."""

    system: System
    system_id: int
    direct: MavlinkDirect


class MavsdkAutopilot:
    """Vehicle on one MAVLink connection, a context; implements `Vehicle` and `VehicleSetup`.

    It opens at once, and finds the vehicle when it appears, also after it was gone. MAVSDK's
    threads only store messages; a worker thread finds vehicles, requests streams and executes
    commands. `state`, `send`, `command` and `close` are thread-safe and never raise.
    """

    def __init__(self, url: str, *, system_id: int | None = None) -> None:
        """`url` is MAVSDK's, such as udpin://127.0.0.1:14551.

        With `system_id`, other vehicles are ignored; None takes the first one found.
        """
        self._url = url
        self._wanted_system_id = system_id
        self._telemetry = Px4Telemetry()
        self._mavsdk: Mavsdk | None = None
        self._datagrams: Datagrams | None = None
        self._own_id = (0, 0)
        self._link: _Link | None = None
        self._others: tuple[int, ...] = ()
        self._worker = Thread(target=self._work, name="autopilot")
        self._search_due_s = 0.0
        # No message may be sent while MAVSDK is destroyed.
        self._sending = Lock()
        self._failures: Counter[str] = Counter()
        # Guards the next five fields.
        self._wake = Condition()
        self._closing = False
        self._dialogue = Dialogue(self._telemetry)
        self._parameters: dict[str, tuple[int, float | None]] = {}
        self._acknowledged_fence_id: int | None = None
        self._counted_fence: _UploadedFence | None = None
        # Fields of the preflight thread. `_values` were read at this checksum.
        self._checksum: float | None = None
        self._values: dict[str, int | float] = {}
        self._unanswered: Counter[str] = Counter()  # calls without an answer
        self._uploaded: tuple[_UploadedFence, float] | None = None

    def __enter__(self) -> Self:
        """Raises AutopilotError for an invalid or occupied address."""
        _redirect_log()
        configuration = Configuration.create_with_component_type(ComponentType.COMPANION_COMPUTER)
        if self._wanted_system_id is not None:
            # A companion computer has its vehicle's system id.
            configuration.system_id = self._wanted_system_id
        self._own_id = (configuration.system_id, configuration.component_id)
        self._mavsdk = Mavsdk(configuration)
        try:
            self._datagrams = self._open(self._mavsdk)
        except (OSError, ValueError) as error:
            self._mavsdk.destroy()
            raise AutopilotError(f"autopilot url = {self._url!r}: {error}") from error
        if self._wanted_system_id is not None:
            self._datagrams.follow(self._wanted_system_id)
        self._datagrams.start()
        self._worker.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _open(self, mavsdk: Mavsdk) -> Datagrams:
        host, _, port = self._url.removeprefix("udpin://").rpartition(":")
        if not port.isdecimal():
            raise ValueError("must be udpin://ADDRESS:PORT")
        datagrams = Datagrams(host, int(port), mavsdk.pass_received_raw_bytes)
        mavsdk.add_any_connection("raw://")
        mavsdk.subscribe_raw_bytes_to_be_sent(datagrams.send)
        return datagrams

    def close(self) -> None:
        """Stop without a message to the vehicle. Queued commands are not sent."""
        with self._wake:
            self._closing = True
            self._wake.notify_all()
        if self._worker.ident is not None:
            self._worker.join()
        if self._datagrams is not None:
            self._datagrams.close()
        if self._mavsdk is not None:
            with self._sending:
                self._mavsdk.destroy()

    def state(self) -> VehicleState:
        """See `Vehicle.state`. `other_system_ids` has this vehicle's own if two share it."""
        now_s = time.monotonic()
        link = self._link
        others = self._others
        received = LinkState() if self._datagrams is None else self._datagrams.state(now_s)
        if link is not None and (received.has_twin or self._telemetry.has_twin(now_s)):
            others = (*others, link.system_id)
        return self._telemetry.state(
            now_s,
            system_id=None if link is None else link.system_id,
            other_system_ids=others,
            link_lost=received.lost,
            link_twice=received.has_duplicates,
            result=self._dialogue.result,
        )

    def send(self, setpoint: Setpoint) -> Setpoint | None:
        """See `Vehicle.send`. A setpoint that is not finite is not sent; yaw does not change."""
        position_m = velocity_m_s = (0.0, 0.0, 0.0)
        if isinstance(setpoint, Velocity):
            mask, velocity_m_s = _VELOCITY_MASK, setpoint.velocity_local_m_s
        else:
            mask, position_m = _POSITION_MASK, setpoint.position_local_m
        if not all(abs(value) <= _MAX_COORDINATE for value in (*position_m, *velocity_m_s)):
            self._count("setpoint that is not finite", str(setpoint))
            return None
        names = ("x", "y", "z", "vx", "vy", "vz")
        sent = self._send(
            "SET_POSITION_TARGET_LOCAL_NED",
            time_boot_ms=0,
            coordinate_frame=_LOCAL_NED,
            type_mask=mask,
            **dict(zip(names, map(float, (*position_m, *velocity_m_s)), strict=True)),
        )
        return setpoint if sent else None

    def command(self, action: Action) -> None:
        """See `Vehicle.command` and `Dialogue.command`."""
        with self._wake:
            self._dialogue.command(action, time.monotonic())
            self._wake.notify_all()

    def read_parameters(self, names: Sequence[str]) -> dict[str, int | float | None]:
        """Read PX4's values; None for a parameter that it does not have. One thread at a time.

        May take a few seconds. Values are cached: each call reads PX4's checksum over all
        parameters, and reads values again only if that has changed. A parameter without answer is
        requested again in later calls; after five it counts as absent.

        Raises AutopilotError if the vehicle is not connected or stops answering.
        """
        answer = self._ask_parameters([_CHECKSUM]).get(_CHECKSUM)
        checksum = None if answer is None else answer[1]
        # None if the checksum's bits are not a number as a float.
        if checksum is None or checksum != self._checksum:
            self._checksum, self._values = checksum, {}
        missing = [
            name
            for name in names
            if name not in self._values and self._unanswered[name] < _ABSENT_AFTER_CALLS
        ]
        answers = self._ask_parameters(missing) if missing else {}
        for name, (kind, received) in answers.items():
            try:
                self._values[name] = self._value(name, kind, received)
            except MavsdkError as error:
                # The vehicle fell silent: reading the others would take as long.
                raise AutopilotError(f"parameter {name}: {_reason(error)}") from error
        if answer is not None:
            self._unanswered.update(set(missing) - answers.keys())
        return {name: self._values.get(name) for name in names}

    def _value(self, name: str, kind: int, received: float | None) -> int | float:
        """Value of a parameter received as a float, or an integer's bits as a float's.

        `received` is None if those bits are not a number; MAVSDK then reads the parameter.
        """
        if received is not None:
            bits: int = struct.unpack("<i", struct.pack("<f", received))[0]
            return received if kind == _REAL32 else bits
        parameters = Param(self._required_link().system)
        read = parameters.get_param_float if kind == _REAL32 else parameters.get_param_int
        value: int | float = read(name)
        return value

    def set_parameter(self, name: str, value: int | float) -> None:
        """Set a parameter, in PX4's own type. One thread at a time.

        Raises AutopilotError if the vehicle is not connected, has no such parameter or refuses.
        """
        kind, _ = self._ask_parameters([name]).get(name, (None, None))
        if kind is None:
            raise AutopilotError(f"parameter {name}: the autopilot has no such parameter")
        if kind == _INT32 and value != int(value):
            raise AutopilotError(f"parameter {name} = {value}: must be a whole number")
        parameters = Param(self._required_link().system)
        try:
            if kind == _REAL32:
                parameters.set_param_float(name, float(value))
            else:
                parameters.set_param_int(name, int(value))
        except MavsdkError as error:
            raise AutopilotError(f"parameter {name} = {value}: {_reason(error)}") from error

    def upload_fence(self, vertices_deg: Sequence[tuple[float, float]]) -> None:
        """Replace PX4's fence by one inclusion polygon: latitude and longitude, deg, in order.

        Raises AutopilotError if the vehicle is not connected or refuses.
        """
        points = [
            Point(latitude_deg, longitude_deg) for latitude_deg, longitude_deg in vertices_deg
        ]
        fence = GeofenceData([Polygon(points, FenceType.INCLUSION)], [])
        self._uploaded = None
        with self._wake:
            self._acknowledged_fence_id = None
        try:
            Geofence(self._required_link().system).upload_geofence(fence)
        except MavsdkError as error:
            raise AutopilotError(f"fence upload: {_reason(error)}") from error
        with self._wake:
            # MAVSDK and this class receive the same acknowledgement.
            self._wake.wait_for(lambda: self._acknowledged_fence_id is not None, _FENCE_TIMEOUT_S)
            fence_id = self._acknowledged_fence_id or 0
        self._uploaded = _UploadedFence(len(points), fence_id), time.monotonic() + _FENCE_ID_LATE_S

    def has_fence(self) -> bool:
        """Whether PX4 still has the last uploaded fence. One thread at a time.

        PX4 sends the fence's id. If none arrives, because of losses or before v1.15, the fence's
        number of corners is requested.

        Raises AutopilotError if the vehicle is not connected or does not answer.
        """
        if self._uploaded is None:
            return False
        uploaded, since_s = self._uploaded
        if uploaded.fence_id:
            fence_id = self._telemetry.fence_id(max(since_s, time.monotonic() - _FENCE_ID_VALID_S))
            if fence_id is not None:
                return fence_id == uploaded.fence_id
        return self._count_fence() == uploaded

    def _count_fence(self) -> _UploadedFence:
        """Start a download and cancel it: its first answer has the number of corners."""
        self._required_link()
        with self._wake:
            self._counted_fence = None
        for _ in range(self._attempts()):
            self._send("MISSION_REQUEST_LIST", mission_type=_FENCE)
            with self._wake:
                self._wake.wait_for(lambda: self._counted_fence is not None, _FENCE_TIMEOUT_S)
                counted = self._counted_fence
            if counted is not None:
                self._send("MISSION_ACK", type=0, mission_type=_FENCE)
                return counted
        raise AutopilotError("fence: the autopilot does not answer whether it has it")

    def _required_link(self) -> _Link:
        link = self._link
        if link is None or not self.state().connected:
            raise AutopilotError(f"no vehicle on {self._url}")
        return link

    def _attempts(self) -> int:
        return _ATTEMPTS_WITH_LOSS if self.state().link_lost else _ATTEMPTS

    def _ask_parameters(self, names: Iterable[str]) -> dict[str, tuple[int, float | None]]:
        """Type and received value of each existing parameter; all are requested at once."""
        self._required_link()
        wanted = set(names)
        with self._wake:
            self._parameters = {}
        for _ in range(self._attempts()):
            for name in sorted(wanted - self._parameters.keys()):
                self._send("PARAM_REQUEST_READ", param_id=name, param_index=-1)
            with self._wake:
                if self._wake.wait_for(
                    lambda: self._parameters.keys() >= wanted, _PARAMETER_TIMEOUT_S
                ):
                    break
        return {name: self._parameters[name] for name in wanted & self._parameters.keys()}

    def _send(self, name: str, **fields: Any) -> bool:
        """Send a message to the vehicle; returns whether it was sent. Thread-safe."""
        link = self._link
        if link is None:
            return False
        target = {"target_system": link.system_id, "target_component": _AUTOPILOT}
        text = json.dumps(target | fields)
        message = MavlinkMessage(name, 0, 0, link.system_id, _AUTOPILOT, text)
        try:
            with self._sending:
                if self._closing:
                    return False
                link.direct.send_message(message)
        except MavsdkError as error:
            self._count(f"sending {name}", repr(error))
            return False
        return True

    def _count(self, what: str, detail: str) -> None:
        """Count a failure; only the first of its kind is logged, since there may be many."""
        self._failures[what] += 1
        if self._failures[what] == 1:
            log.warning("autopilot link", failure=what, detail=detail)

    def _subscriber(
        self, name: str, receive: Callable[[dict[str, Any]], None]
    ) -> Callable[..., None]:
        """Callback for MAVSDK's thread."""

        def on_message(message: MavlinkMessage, _: object) -> None:
            if message.component_id != _AUTOPILOT:
                return
            try:
                receive(json.loads(message.fields_json))
            except Exception as error:
                self._count(f"receiving {name}", repr(error))

        return on_message

    def _on_telemetry(self, name: str) -> Callable[[dict[str, Any]], None]:
        def on_telemetry(fields: dict[str, Any]) -> None:
            self._telemetry.receive(name, fields, time.monotonic())
            if self._telemetry.needs_origin() or name in ("STATUSTEXT", "EVENT"):
                with self._wake:
                    self._dialogue.next_s = -math.inf
                    self._wake.notify_all()

        return on_telemetry

    def _on_command_ack(self, fields: dict[str, Any]) -> None:
        target = fields["target_system"], fields["target_component"]
        ours = all(to in (0, own) for to, own in zip(target, self._own_id, strict=True))
        if not ours:
            return
        with self._wake:
            self._dialogue.receive_ack(fields["command"], fields["result"], time.monotonic())
            self._wake.notify_all()

    def _on_param_value(self, fields: dict[str, Any]) -> None:
        with self._wake:
            self._parameters[fields["param_id"]] = fields["param_type"], fields["param_value"]
            self._wake.notify_all()

    def _on_mission_ack(self, fields: dict[str, Any]) -> None:
        if self._is_for_our_fence(fields) and fields["type"] == 0:
            with self._wake:
                self._acknowledged_fence_id = fields.get("opaque_id", 0)
                self._wake.notify_all()

    def _on_mission_count(self, fields: dict[str, Any]) -> None:
        if self._is_for_our_fence(fields):
            with self._wake:
                self._counted_fence = _UploadedFence(fields["count"], fields.get("opaque_id", 0))
                self._wake.notify_all()

    def _is_for_our_fence(self, fields: dict[str, Any]) -> bool:
        target = fields["target_system"], fields["target_component"]
        return target == self._own_id and fields["mission_type"] == _FENCE

    def _work(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(
                    self._has_work, max(self._dialogue.next_s - time.monotonic(), 0.0)
                )
                if self._closing:
                    return
            try:
                self._tick(time.monotonic())
            except Exception as error:
                self._count("autopilot thread", repr(error))

    def _has_work(self) -> bool:
        return self._closing or time.monotonic() >= self._dialogue.next_s

    def _tick(self, now_s: float) -> None:
        """Find the vehicle, and send the messages that are due."""
        if self._link is None or now_s >= self._search_due_s:
            self._search_due_s = now_s + _SEARCH_PERIOD_S
            self._find_vehicles()
        with self._wake:
            # The search takes time, and a command may have been queued meanwhile.
            now_s = time.monotonic()
            vehicle = None if self._link is None else self.state()
            messages = self._dialogue.due_messages(now_s, vehicle)
        for name, fields in messages:
            self._send(name, **fields)

    def _find_vehicles(self) -> None:
        assert self._mavsdk is not None
        autopilots = {
            system.get_system_id(): system
            for system in self._mavsdk.get_systems()
            if system.has_autopilot() and system.is_connected()
        }
        if self._link is None:
            wanted = self._wanted_system_id
            system_id = min(autopilots, default=0) if wanted is None else wanted
            if system_id in autopilots:
                self._connect(system_id, autopilots[system_id])
        own = None if self._link is None else self._link.system_id
        self._others = tuple(sorted(autopilots.keys() - {own}))

    def _connect(self, system_id: int, system: System) -> None:
        direct = MavlinkDirect(system)
        answers = {
            "COMMAND_ACK": self._on_command_ack,
            "PARAM_VALUE": self._on_param_value,
            "MISSION_ACK": self._on_mission_ack,
            "MISSION_COUNT": self._on_mission_count,
        }
        telemetry = {name: self._on_telemetry(name) for name in self._telemetry.messages}
        for name, receive in (*answers.items(), *telemetry.items()):
            direct.subscribe_message(name, self._subscriber(name, receive))
        assert self._datagrams is not None
        self._datagrams.follow(system_id)
        self._link = _Link(system, system_id, direct)
        log.info("autopilot found", system_id=system_id)


@cache
def _redirect_log() -> None:
    """Redirect MAVSDK's log, once: replacing a callback frees it while MAVSDK may be in it."""
    log_subscribe(_on_mavsdk_log)
    # MAVSDK's Python prints exceptions of its callbacks.
    for name, module in list(sys.modules.items()):
        if name.partition(".")[0] == "mavsdk":
            vars(module)["print"] = lambda *parts: _log_mavsdk(" ".join(map(str, parts)))


def _on_mavsdk_log(level: LogLevel, text: str, _file: str | None, _line: int) -> bool:
    if level >= LogLevel.WARN:
        _log_mavsdk(text)
    return True  # do not print it


_mavsdk_lines: Counter[str] = Counter()
_MOST_MAVSDK_LINES = 1000


def _log_mavsdk(text: str) -> None:
    """Log a line at its 1st, 2nd, 4th, 8th ... occurrence, to not fill the disk."""
    kind = re.sub(r"\d+", "#", text)
    if kind in _mavsdk_lines or len(_mavsdk_lines) < _MOST_MAVSDK_LINES:
        _mavsdk_lines[kind] += 1
        times = _mavsdk_lines[kind]
        if times & (times - 1) == 0:
            log.warning("MAVSDK", says=text, times=times)


def _reason(error: MavsdkError) -> str:
    return str(error.args[0].name).lower().replace("_", " ")
