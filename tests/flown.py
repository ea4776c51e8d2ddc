"""What tests do to robots that fly, and see of them."""

import math

from edge.flight.margins import ErrorBudget
from edge.messages.mission import FlightState, RobotStatus
from lpac.sim.fleet.robots import SimulatedRobot
from lpac.sim.px4.parameters import PARAMETERS
from lpac.sim.px4.vehicle import Px4Vehicle

# With corrections, on flat ground: robots fly low, and a flight is short.
PRECISE = ErrorBudget(
    gps_m=0.25, height_apart_m=0.2, height_common_m=0.0, takeoffs_height_m=0.0, pads_height_m=0.2
)
# Where PX4 need not be as slow as it is.
QUICK = {
    "COM_SPOOLUP_TIME": 0.0, "MPC_TKO_RAMP_T": 0.0, "MPC_LAND_SPEED": 1.5, "COM_DISARM_LAND": 0.5,
}  # fmt: skip
_SLOWLY_M_S = 0.1
_FAST = {
    name: (PARAMETERS | QUICK)[name]
    for name in ("MPC_XY_VEL_MAX", "MPC_Z_VEL_MAX_UP", "MPC_Z_VEL_MAX_DN", "MPC_LAND_SPEED")
}


class FlownRobot:
    """One robot, as it is, whoever knows it."""

    def __init__(self, robot: SimulatedRobot) -> None:
        self.robot_id = robot.config.robot_id
        self.program = robot

    @property
    def said(self) -> RobotStatus:
        """What it says of itself, heard or not."""
        assert self.program.status is not None
        return self.program.status

    @property
    def state(self) -> FlightState:
        return self.said.state

    @property
    def vehicle(self) -> Px4Vehicle:
        return self.program.vehicle.vehicle

    @property
    def away_m(self) -> float:
        """How far from its landing point it takes itself to be."""
        assert self.said.position_m is not None
        return math.dist(self.said.position_m[:2], self.said.landing_point_m)

    def crawl(self) -> None:
        """The vehicle flies as slowly as one in a strong wind."""
        self.vehicle.parameters["MPC_XY_VEL_MAX"] = _SLOWLY_M_S

    def climb_slowly(self) -> None:
        """Its motors hardly lift it."""
        self.vehicle.parameters["MPC_Z_VEL_MAX_UP"] = 2.0 * _SLOWLY_M_S

    def sink_slowly(self) -> None:
        """It does not come down for a long time."""
        sinks = dict.fromkeys(("MPC_Z_VEL_MAX_DN", "MPC_LAND_SPEED"), _SLOWLY_M_S)
        self.vehicle.parameters |= sinks

    def hurry(self) -> None:
        """It flies as fast as ever."""
        self.vehicle.parameters |= _FAST

    def tire(self) -> None:
        """Its battery is too low to take off with, and not so low that it lands."""
        self.vehicle.battery_remaining = 0.4
