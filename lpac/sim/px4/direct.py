"""A simulated vehicle behind the robot's ports, in process: no socket, on a simulated clock."""

import struct
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from edge.core.ports import Clock
from edge.core.vehicle import Action, ActionResult, Setpoint, VehicleState, Velocity
from edge.drivers.px4.telemetry import RATES_HZ, Px4Telemetry
from lpac.sim.px4.link import FORCE, Px4Link
from lpac.sim.px4.modes import CUSTOM_MODES, Px4Mode
from lpac.sim.px4.vehicle import Px4Vehicle
from lpac.sim.px4.world import FencePolygon

_LOCAL_NED = mavlink.MAV_FRAME_LOCAL_NED
# Which fields count; see MAVLink's POSITION_TARGET_TYPEMASK.
_VELOCITY_MASK, _POSITION_MASK = 0b110111000111, 0b110111111000
_AUTOPILOT, _COMPANION = 1, 191  # component ids
_REQUEST_AGAIN_S = 1.0
_COMMANDS: dict[Action, tuple[int, tuple[float, ...]]] = {
    Action.ARM: (mavlink.MAV_CMD_COMPONENT_ARM_DISARM, (1.0,)),
    Action.DISARM: (mavlink.MAV_CMD_COMPONENT_ARM_DISARM, (0.0,)),
    Action.KILL: (mavlink.MAV_CMD_COMPONENT_ARM_DISARM, (0.0, FORCE)),
    Action.LAND: (mavlink.MAV_CMD_NAV_LAND, ()),
}
_MODES = {Action.OFFBOARD: Px4Mode.OFFBOARD, Action.HOLD: Px4Mode.HOLD}


class DirectVehicle:
    """A `Vehicle` and its `VehicleSetup`; `step` lets its time pass.

    `is_cut`: the wire to the computer is, so that neither hears the other.

    It says and hears MAVLink, message by message, as over a wire, and rounded as on one: what the
    robot knows of it is what PX4 tells, at PX4's rates.
    """

    def __init__(self, vehicle: Px4Vehicle, system_id: int, clock: Clock) -> None:
        self.vehicle = vehicle
        self.is_cut = False
        self._system_id = system_id
        self._clock = clock
        self._link = Px4Link(vehicle, system_id=system_id)
        self._telemetry = Px4Telemetry()
        self._result: ActionResult | None = None
        self._asked: Action | None = None
        self._requested_at_s = -_REQUEST_AGAIN_S
        self._uploaded: tuple[FencePolygon, ...] = ()
        for message_id, rate_hz in RATES_HZ.items():
            self._command_long(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, 1e6 / rate_hz)
        # Nobody else listens on this link: what the robot does not read costs time alone.
        for message_id, kind in mavlink.mavlink_map.items():
            if message_id and kind.msgname not in self._telemetry.messages:
                self._command_long(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, -1.0)

    def step(self, dt_s: float) -> None:
        """Let the vehicle fly on, and hear what it says."""
        self.vehicle.step(dt_s)
        now_s = self._clock.monotonic_s()
        said = self._said()
        for name, fields in () if self.is_cut else said:
            if name == "COMMAND_ACK":
                self._hear_answer(fields, now_s)
            elif name in self._telemetry.messages:
                self._telemetry.hear(name, fields, now_s)
        if self._telemetry.needs_origin() or now_s - self._requested_at_s >= _REQUEST_AGAIN_S:
            self._requested_at_s = now_s
            self._request(mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN)
            self._request(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)

    # The robot's ports

    def state(self) -> VehicleState:
        """The newest of everything."""
        return self._telemetry.state(
            self._clock.monotonic_s(), system_id=self._system_id, result=self._result
        )

    def send(self, setpoint: Setpoint) -> Setpoint | None:
        """Send it once."""
        position_m = velocity_m_s = (0.0, 0.0, 0.0)
        if isinstance(setpoint, Velocity):
            mask, velocity_m_s = _VELOCITY_MASK, setpoint.velocity_local_m_s
        else:
            mask, position_m = _POSITION_MASK, setpoint.position_local_m
        self._send(
            mavlink.MAVLink_set_position_target_local_ned_message(
                0, self._system_id, _AUTOPILOT, _LOCAL_NED, mask, *position_m, *velocity_m_s,
                0.0, 0.0, 0.0, 0.0, 0.0,
            )
        )  # fmt: skip
        return setpoint

    def command(self, action: Action) -> None:
        """Ask for it; what came of it is known after the vehicle's next step."""
        self._asked = action
        if action in _MODES:
            self._command_long(mavlink.MAV_CMD_DO_SET_MODE, 1.0, *CUSTOM_MODES[_MODES[action]])
        else:
            number, parameters = _COMMANDS[action]
            self._command_long(number, *parameters)

    def read_parameters(self, names: Sequence[str]) -> dict[str, int | float | None]:
        """PX4's parameters; None for one that it does not have."""
        return {name: self.vehicle.parameters.get(name) for name in names}

    def set_parameter(self, name: str, value: int | float) -> None:
        """Set one."""
        self.vehicle.parameters[name] = value

    def upload_fence(self, vertices_deg: Sequence[tuple[float, float]]) -> None:
        """Replace the fence by one polygon to stay in."""
        self.vehicle.fence = self._uploaded = (FencePolygon(True, tuple(vertices_deg)),)

    def has_fence(self) -> bool:
        """Whether it still has the one that was uploaded."""
        return bool(self._uploaded) and self.vehicle.fence == self._uploaded

    # What it sends

    def _hear_answer(self, fields: Mapping[str, Any], now_s: float) -> None:
        if self._asked is None or fields["command"] in (
            mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAV_CMD_REQUEST_MESSAGE,
        ):  # fmt: skip
            return
        accepted = fields["result"] == mavlink.MAV_RESULT_ACCEPTED
        refusal = "" if accepted else f"result {fields['result']}"
        self._result = ActionResult(self._asked, accepted, refusal, now_s)
        self._asked = None
        # Sooner than the next that is due.
        self._request(mavlink.MAVLINK_MSG_ID_HEARTBEAT)
        self._request(mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE)

    def _request(self, message_id: int) -> None:
        self._command_long(mavlink.MAV_CMD_REQUEST_MESSAGE, message_id)

    def _command_long(self, number: int, *parameters: float) -> None:
        padded = (*parameters, *(0.0,) * (7 - len(parameters)))
        self._send(
            mavlink.MAVLink_command_long_message(self._system_id, _AUTOPILOT, number, 0, *padded)
        )

    # The wire

    def _send(self, message: Any) -> None:
        if self.is_cut:
            return
        header = message.get_header()
        header.srcSystem, header.srcComponent = self._system_id, _COMPANION
        self._link.hear(_rounded(message))

    def _said(self) -> Iterable[tuple[str, Mapping[str, Any]]]:
        """Name and fields of each message that comes from the vehicle now."""
        return [(message.get_type(), vars(_rounded(message))) for message in self._link.say()]


def _rounded(message: Any) -> Any:
    """The message itself, its real numbers being such as MAVLink has bits for."""
    names, bits = _real_fields(message.__class__)
    if names:
        fields = vars(message)
        values = bits.unpack(bits.pack(*(fields[name] for name in names)))
        fields.update(zip(names, values, strict=True))
    return message


@cache
def _real_fields(kind: Any) -> tuple[tuple[str, ...], struct.Struct]:
    """Names of a message's 32-bit reals, but for those in arrays, and their packed form."""
    types = dict(zip(kind.fieldnames, kind.fieldtypes, strict=True))
    names = tuple(
        name
        for name, length in zip(kind.ordered_fieldnames, kind.lengths, strict=True)
        if types[name] == "float" and length == 1
    )
    return names, struct.Struct(f"<{len(names)}f")
