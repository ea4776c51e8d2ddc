"""Pictures of fleets in any state, for tests of what shows them."""

from dataclasses import replace
from typing import Any

from edge.core.fence import Fence
from edge.messages.codes import ReasonCode
from edge.messages.mission import FlightState, GroundState, LoopStatus, Origin, Place, RobotStatus
from lpac.analysis.snapshot import FleetSetup, FleetSlot, FleetSnapshot, RobotSnapshot
from tests.said import checks, reason

ORIGIN = Origin(47.397742, 8.545594, 30.0)
FENCE = Fence(((-2.0, -2.0), (34.0, -2.0), (34.0, 34.0), (-2.0, 34.0)), 1.5, 2.0, 100.0)
LOOP = LoopStatus(100, 0, 0, 0.2, 1.1, 3.0)


def setup(n: int) -> FleetSetup:
    """A fleet of n robots, r0 and on, one a slot."""
    return FleetSetup(
        fleet="field", operator="alice", robots={f"r{i}": i for i in range(n)},
        slots=tuple(FleetSlot(Place(i, (2.0, 2.0)), (2.0, 2.0), f"r{i}") for i in range(n)),
        fence=FENCE, world="CircularBND 256 256 40 8\n", world_id="c64e4b1b0000",
        bundle_id="7992912100000000", world_size=512, sensor_size=64, communication_range=128.0,
        env_scale=16.0, truncation=2.0, norm=1.0,
    )  # fmt: skip


def status(robot_id: int, **changes: Any) -> RobotStatus:
    """A robot that flies its mission well."""
    well = RobotStatus(
        robot_id=robot_id, boot_nonce=7, sequence=9, uptime_s=30.0, unix_time_s=1e9,
        state=FlightState.MISSION, reason=reason("mission started", ReasonCode.MISSION_STARTED),
        ready=False, failed_checks=(),
        alarms=(), obeyed_sequence=4, operator="alice", orders=(), bundle_id="7992912100000000",
        world_id="c64e4b1b0000", trial="t1", origin=ORIGIN, system_id=1, slot_height_m=4.0,
        landing_point_m=(2.0, 2.0), position_m=(5.0 * robot_id, 12.0, 4.0),
        velocity_m_s=(1.0, 0.0, 0.0), heading_rad=0.0, mode="offboard", armed=True, battery=0.9,
        satellites=14, message_counts={}, neighbour_ages_s={str(i): 0.2 for i in range(3)},
        loops={"control": LOOP}, fence=FENCE, in_air=True, hdop=0.8, feature_age_s=0.1,
        neighbour_messages={str(i): 50 for i in range(3)},
    )  # fmt: skip
    return replace(well, **changes)


def on_ground(robot_id: int, **changes: Any) -> RobotStatus:
    """A robot that nobody has enabled yet."""
    return status(
        robot_id,
        **{
            "state": FlightState.IDLE, "armed": False,
            "reason": reason("autopilot and position found", ReasonCode.FOUND),
            "in_air": False, "mode": "hold", "origin": None, "position_m": None,
            "feature_age_s": None, "neighbour_ages_s": {},
            "failed_checks": checks("GPS sees 3 satellites"), "satellites": 3, "hdop": None,
        }
        | changes,
    )  # fmt: skip


def robot(said: RobotStatus, **changes: Any) -> RobotSnapshot:
    """A robot that has just been heard."""
    rates_hz = {str(i): 2.5 for i in range(3)}
    heard = RobotSnapshot(f"r{said.robot_id}", said.robot_id, said, 0.1, 0.01, rates_hz)
    return replace(heard, **changes)


def snapshot(*robots: RobotSnapshot, **changes: Any) -> FleetSnapshot:
    """A fleet whose mission alice commands."""
    ground = GroundState(sequence=4, operator="alice", origin=ORIGIN, enabled=True, trial="t1")
    return replace(FleetSnapshot(1e9, "alice", ground, robots), **changes)
