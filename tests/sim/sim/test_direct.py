"""The vehicle in the robot's own process is the one on a wire."""

import struct
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from edge.core.ports import Clock
from edge.core.vehicle import Action, Mode, Position, VehicleState, Velocity
from lpac.sim.px4.direct import DirectVehicle
from lpac.sim.px4.errors import Errors
from lpac.sim.px4.vehicle import Px4Vehicle
from lpac.sim.schedule import Schedule

STEP_S = 0.02
EVENT, EVENT_SEQUENCE = "UNKNOWN_410", "UNKNOWN_411"


class VehicleOnAWire(DirectVehicle):
    """All that is said, either way, travels as bytes; pymavlink packs and parses them."""

    def __init__(self, vehicle: Px4Vehicle, system_id: int, clock: Clock) -> None:
        self._packer: Any = mavlink.MAVLink(None, srcSystem=system_id, srcComponent=191)
        self._parser: Any = mavlink.MAVLink(None)
        super().__init__(vehicle, system_id, clock)

    def _send(self, message: Any) -> None:
        self._link.receive(bytes(message.pack(self._packer)))

    def _received(self, now_s: float) -> Iterator[tuple[str, Mapping[str, Any]]]:
        for datagram in self._link.due():
            for message in self._parser.parse_buffer(datagram) or ():
                yield fields_of(message)


def fields_of(message: Any) -> tuple[str, dict[str, Any]]:
    """As MAVSDK tells them: it knows PX4's events, which pymavlink does not."""
    name = message.get_type()
    if name not in (EVENT, EVENT_SEQUENCE):
        return name, message.to_dict()
    frame = bytes(message.data)
    payload = frame[10 : 10 + frame[1]]
    if name == EVENT_SEQUENCE:
        sequence, flags = struct.unpack("<HB", payload.ljust(3, b"\0"))
        return "CURRENT_EVENT_SEQUENCE", {"sequence": sequence, "flags": flags}
    names = (
        "id", "event_time_boot_ms", "sequence", "destination_component", "destination_system",
        "log_levels", "arguments",
    )  # fmt: skip
    values = struct.unpack("<IIHBBB40s", payload.ljust(53, b"\0"))
    return "EVENT", dict(zip(names, values, strict=True))


def flown(kind: type[DirectVehicle]) -> tuple[list[VehicleState], bytes]:
    """What a robot knows of its vehicle at each step of a flight, and where that ends."""
    schedule = Schedule()
    px4 = Px4Vehicle(seed=4, errors=Errors(4, 5))
    vehicle = kind(px4, 7, schedule)
    states = []

    def step() -> None:
        vehicle.step(STEP_S)
        states.append(vehicle.state())
        time_s = px4.time_s
        if not px4.armed and px4.armable and 8.0 < time_s < 20.0:
            vehicle.command(Action.ARM if px4.mode.name == "OFFBOARD" else Action.OFFBOARD)
        if time_s < 25.0:
            vehicle.send(Velocity((0.1, 1.0 / 3.0, -1.0)))
        elif time_s < 30.0:
            place_m = states[0].position_local_m or (0.0, 0.0, 0.0)
            vehicle.send(Position((place_m[0] + 0.7, place_m[1], place_m[2] - 10.0)))

    def fail() -> None:
        px4.gps_lost = True

    schedule.every(STEP_S, step, STEP_S)
    # It loses its setpoints at 30 s, and its GPS at 40 s.
    schedule.at(40.0, fail)
    schedule.run_until(60.0)
    return states, px4.position_m.tobytes()


def test_a_vehicle_in_process_tells_and_obeys_as_over_a_wire() -> None:
    (direct, direct_end), (wired, wired_end) = flown(DirectVehicle), flown(VehicleOnAWire)
    for here, there in zip(direct, wired, strict=True):
        assert here == there
    assert direct_end == wired_end
    # All of it was about something.
    assert any(state.armed for state in direct)
    assert any(state.problems for state in direct) and any(state.warnings for state in direct)
    assert {state.mode for state in direct} >= {Mode.OFFBOARD, Mode.LAND}
    assert any(state.gps is not None and state.gps.fix == 0 for state in direct)
    heights_m = [state.height_above_home_m or 0.0 for state in direct]
    assert np.ptp(heights_m) > 5.0
