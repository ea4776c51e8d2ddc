"""Simulated vehicle for a robot in the same process, without a socket."""

import struct
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from edge.core.ports import Clock
from edge.core.vehicle import Action, ActionResult, Setpoint, VehicleState, Velocity
from edge.drivers.px4.dialogue import Dialogue
from edge.drivers.px4.reception import Frame, VehicleFrames
from edge.drivers.px4.telemetry import Px4Telemetry
from lpac.sim.px4.link import Px4Link, request_event
from lpac.sim.px4.vehicle import Px4Vehicle
from lpac.sim.px4.world import FencePolygon

_LOCAL_NED = mavlink.MAV_FRAME_LOCAL_NED
# Masks of ignored fields; see MAVLink's POSITION_TARGET_TYPEMASK.
_VELOCITY_MASK, _POSITION_MASK = 0b110111000111, 0b110111111000
_AUTOPILOT, _COMPANION = 1, 191  # component ids
# Message -> the field with the vehicle's time, and its unit, s.
_TIMES = {
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: ("time_boot_ms", 1e-3),
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: ("time_boot_ms", 1e-3),
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: ("time_usec", 1e-6),
}


class DirectVehicle:
    """`Vehicle` and `VehicleSetup` in one; `step` advances simulated time.

    Exchanges MAVLink message objects at PX4's rates, rounded as on the wire.
    """

    def __init__(self, vehicle: Px4Vehicle, system_id: int, clock: Clock) -> None:
        self.vehicle = vehicle
        self._system_id = system_id
        self._clock = clock
        self._link = Px4Link(vehicle, system_id=system_id)
        self._telemetry = Px4Telemetry()
        self._uploaded: tuple[FencePolygon, ...] = ()
        self._dialogue = Dialogue(self._telemetry)
        self._frames = VehicleFrames()
        # State, with its time and command result, for a robot that reads it several times a tick.
        # Each step clears it.
        self._cached: tuple[float, ActionResult | None, VehicleState] | None = None
        # The link has no other subscriber, so messages that the robot does not read only cost time.
        self._link.silence(self._telemetry.messages)

    def step(self, dt_s: float) -> None:
        """Advance the vehicle, and receive its messages."""
        self._cached = None
        self.vehicle.step(dt_s)
        now_s = self._clock.monotonic_s()
        for name, fields in self._received(now_s):
            if name == "COMMAND_ACK":
                self._dialogue.receive_ack(fields["command"], fields["result"], now_s)
            elif name in self._telemetry.messages:
                self._telemetry.receive(name, fields, now_s)
        if now_s >= self._dialogue.next_s or self._telemetry.needs_origin():
            self._send_due(now_s)

    def state(self) -> VehicleState:
        """State from the vehicle's last messages."""
        now_s, result = self._clock.monotonic_s(), self._dialogue.result
        if self._cached is None or self._cached[:2] != (now_s, result):
            state = self._telemetry.state(
                now_s, system_id=self._system_id, result=result,
                link_lost=self._frames.lost(now_s), link_twice=self._frames.has_duplicates(now_s),
            )  # fmt: skip
            self._cached = now_s, result, state
        return self._cached[2]

    def send(self, setpoint: Setpoint) -> Setpoint | None:
        """Send the setpoint once; returns it."""
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
        """Command an action; its result is known after the vehicle's next step."""
        now_s = self._clock.monotonic_s()
        self._dialogue.command(action, now_s)
        self._send_due(now_s)

    def read_parameters(self, names: Sequence[str]) -> dict[str, int | float | None]:
        """Values of PX4's parameters; None for those that it lacks."""
        return {name: self.vehicle.parameters.get(name) for name in names}

    def set_parameter(self, name: str, value: int | float) -> None:
        """Set one of PX4's parameters."""
        self.vehicle.parameters[name] = value

    def upload_fence(self, vertices_deg: Sequence[tuple[float, float]]) -> None:
        """Replace the fence by one inclusion polygon."""
        self.vehicle.fence = self._uploaded = (FencePolygon(True, tuple(vertices_deg)),)

    def has_fence(self) -> bool:
        """Whether the vehicle still has the uploaded fence."""
        return bool(self._uploaded) and self.vehicle.fence == self._uploaded

    def _send_due(self, now_s: float) -> None:
        for name, fields in self._dialogue.due_messages(now_s, self.state()):
            if name == "REQUEST_EVENT":
                self._send(request_event(**fields))
            elif name == "PARAM_SET":
                encoded = {**fields, "param_id": fields["param_id"].encode()}
                self._send(
                    mavlink.MAVLink_param_set_message(self._system_id, _AUTOPILOT, **encoded)
                )
            else:
                self._send(
                    mavlink.MAVLink_command_long_message(self._system_id, _AUTOPILOT, **fields)
                )

    def _send(self, message: Any) -> None:
        header = message.get_header()
        header.srcSystem, header.srcComponent = self._system_id, _COMPANION
        self._link.handle(_rounded(message))

    def _received(self, now_s: float) -> Iterable[tuple[str, Mapping[str, Any]]]:
        """Name and fields of each accepted message of the vehicle."""
        for message in self._link.due_messages():
            number, message_id = message.link_number, message.get_msgId()
            time_name, unit_s = _TIMES.get(message_id, ("", 0.0))
            vehicle_s = getattr(message, time_name) * unit_s if time_name else None
            if self._frames.accept(Frame(0, number % 256, number, message_id, vehicle_s), now_s):
                yield message.get_type(), vars(_rounded(message))


def _rounded(message: Any) -> Any:
    """Round the message's floats in place to MAVLink's 32 bits; returns the message."""
    names, bits = _float_fields(message.__class__)
    if names:
        fields = vars(message)
        values = bits.unpack(bits.pack(*map(fields.__getitem__, names)))
        fields.update(zip(names, values, strict=True))
    return message


@cache
def _float_fields(kind: Any) -> tuple[tuple[str, ...], struct.Struct]:
    """Names of a message's 32-bit floats, except arrays, and their packed format."""
    types = dict(zip(kind.fieldnames, kind.fieldtypes, strict=True))
    names = tuple(
        name
        for name, length in zip(kind.ordered_fieldnames, kind.lengths, strict=True)
        if types[name] == "float" and length == 1
    )
    return names, struct.Struct(f"<{len(names)}f")
