"""A vehicle that flies about with sensor errors, and its robot's judgement of the position.

It sends as PX4 does; the position is judged ten times a second, as in flight.
"""

import math
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from edge.core.position import PositionJudgement, PositionLimits, judge
from edge.drivers.px4.telemetry import RATES_HZ, Px4Telemetry
from lpac.sim.px4.errors import Errors
from lpac.sim.px4.link import Px4Link
from lpac.sim.px4.modes import Px4Mode
from lpac.sim.px4.server import STEP_S
from lpac.sim.px4.vector import vector
from lpac.sim.px4.vehicle import Airframe, Px4Setpoint, Px4Vehicle

# One look; and by when the vehicle flies at its height.
TICK_S, READY_S = 0.1, 20.0
_SPEED_M_S = 1.25
_HEIGHT_M = 8.0
_TURN_S = 10.0


class Watched:
    """A vehicle that flies about, and its robot's judgement of the position."""

    def __init__(self, seed: int, endurance_s: float) -> None:
        self.vehicle = Px4Vehicle(
            seed=seed,
            airframe=Airframe(endurance_s=endurance_s),
            errors=Errors(seed, fleet_seed=seed),
        )
        self.judgement = PositionJudgement()
        self.greatest_offset_m = 0.0
        self._rng = np.random.default_rng(seed)
        self._velocity_m_s = np.zeros(3)
        self._link, self._telemetry = Px4Link(self.vehicle, system_id=1), Px4Telemetry()
        self._parser: Any = mavlink.MAVLink(None)
        self._parser.robust_parsing = True
        _request_streams(self._link)

    def tick(self) -> None:
        """Fly for a tenth of a second, and judge the position."""
        vehicle, telemetry = self.vehicle, self._telemetry
        for _ in range(round(TICK_S / STEP_S)):
            vehicle.step(STEP_S)
            for datagram in self._link.due():
                for message in self._parser.parse_buffer(datagram) or ():
                    if message.get_type() in telemetry.messages:
                        telemetry.receive(message.get_type(), message.to_dict(), vehicle.time_s)
        now_s = vehicle.time_s
        state = telemetry.state(now_s)
        self.judgement = judge(self.judgement, state, PositionLimits(), now_s)
        if vehicle.armed and state.gps is not None and state.gps.offset_m is not None:
            self.greatest_offset_m = max(self.greatest_offset_m, state.gps.offset_m)
        if now_s % _TURN_S < TICK_S:
            bearing = self._rng.uniform(0.0, math.tau)
            self._velocity_m_s[:2] = _SPEED_M_S * np.array([math.cos(bearing), math.sin(bearing)])
        height_m = -float(vehicle.local_position_m[2])
        self._velocity_m_s[2] = -min(_HEIGHT_M - height_m, 1.5)
        vehicle.offboard(Px4Setpoint((math.nan,) * 3, vector(self._velocity_m_s)))
        if not vehicle.armed and vehicle.armable and now_s > READY_S / 2.0:
            vehicle.set_mode(Px4Mode.OFFBOARD)
            vehicle.arm()


def _request_streams(link: Px4Link) -> None:
    """Request the streams of a robot; all others are off, which saves time."""
    sender: Any = mavlink.MAVLink(None, srcSystem=1, srcComponent=195)
    unused = (mavlink.MAVLINK_MSG_ID_ATTITUDE, mavlink.MAVLINK_MSG_ID_ODOMETRY)
    for message, interval_us in (
        *((message, 1e6 / rate_hz) for message, rate_hz in RATES_HZ.items()),
        *((message, -1.0) for message in unused),
    ):
        command = mavlink.MAVLink_command_long_message(
            1, 1, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 0, message, interval_us, 0, 0, 0, 0, 0
        )
        link.receive(bytes(command.pack(sender)))
