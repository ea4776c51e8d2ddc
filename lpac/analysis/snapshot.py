"""State of the fleet at a ground station, for its log and its clients."""

from dataclasses import dataclass, field
from typing import Literal

from edge.core.fence import Fence
from edge.flight.margins import ErrorBudget
from edge.messages.mission import GroundState, Place, RobotStatus

# A robot without a status for longer is stale.
FRESH_S = 2.0
# A commander that is silent for longer counts as lost.
COMMANDER_SILENT_S = 2.0
# The state while nobody has commanded yet.
NO_STATE = GroundState(0, "")


@dataclass(frozen=True, slots=True)
class FleetSlot:
    """One slot: its place (height and landing point), its pad (x, y), m, and its robot."""

    place: Place
    pad_m: tuple[float, ...]
    robot: str = ""


@dataclass(frozen=True, slots=True)
class FleetSetup:
    """Part of the state that changes rarely.

    `operator` is this station's. `robots` are the robots' ids by name, in the fleet's order. The
    policy's world is `world_size` cells wide, with `env_scale` cells per m, and begins at the
    mission origin; the sensor sees `sensor_size` cells. `world` is the text of the robots' world
    file with the id `world_id`, "" if unknown. `truncation` and `norm` are arguments of
    `rasterize`. `fence` is the configured one. A slot's height is `base_height_m` + its number x
    `slot_spacing_m`; the distance of places follows from `errors`. Robots land at once at a battery
    of `battery_critical`, hold when the ground has been silent for `ground_timeout_s`, and land
    `ground_lost_land_s` later. `insecure`: anybody on the network can fly the fleet.
    """

    fleet: str
    operator: str
    robots: dict[str, int]
    slots: tuple[FleetSlot, ...]
    fence: Fence
    world: str
    world_id: str
    bundle_id: str
    world_size: int
    sensor_size: int
    communication_range: float
    env_scale: float
    truncation: float
    norm: float
    base_height_m: float = 5.0
    slot_spacing_m: float = 4.5
    errors: ErrorBudget = field(default_factory=ErrorBudget)
    battery_critical: float = 0.15
    ground_timeout_s: float = 3.0
    ground_lost_land_s: float = 10.0
    insecure: bool = False


@dataclass(frozen=True, slots=True)
class RobotSnapshot:
    """A robot as known to the ground; `status` is the newest one, None if there was none.

    `age_s` is the status's age; the robot's clock is `clock_offset_s` ahead of this one.
    `rates_hz` are the rates of messages from each neighbour (robot id as text) over the last few
    seconds, `arrivals` their counts by fate in the last ten (`Arrivals.counts`). `duplicate`: two
    programs use this robot's id. `other_release` is its release, "" if it is the ground's.
    """

    name: str
    robot_id: int
    status: RobotStatus | None = None
    age_s: float | None = None
    clock_offset_s: float | None = None
    rates_hz: dict[str, float] = field(default_factory=dict)
    arrivals: dict[str, tuple[int, ...]] = field(default_factory=dict)
    duplicate: bool = False
    other_release: str = ""

    @property
    def fresh(self) -> bool:
        """Whether the newest status is fresh."""
        return self.age_s is not None and self.age_s <= FRESH_S


@dataclass(frozen=True, slots=True)
class FleetSnapshot:
    """The fleet at one time. `unix_time_s` is the ground's clock.

    `commander` is the operator in command, "" if there is none yet; `ground` is the state that the
    commander publishes. `running` are descriptions of the running commands. `commander_age_s` is
    the time since the commander was heard, 0 if it is this station. `shares_name`: another station
    uses this station's name. `members_problem`: fault of the list of members, "" if there is none.
    `mission_s` is the time of this trial's mission, None without one, or if it had begun before
    this station heard of it.
    """

    unix_time_s: float
    commander: str
    ground: GroundState | None
    robots: tuple[RobotSnapshot, ...]
    running: tuple[str, ...] = ()
    commander_age_s: float = 0.0
    shares_name: bool = False
    members_problem: str = ""
    mission_s: float | None = None

    @property
    def state(self) -> GroundState:
        """The commander's state; without one, its defaults."""
        return self.ground or NO_STATE


EventKind = Literal["command", "result", "refusal", "state", "commander", "presence"]


@dataclass(frozen=True, slots=True)
class GroundEvent:
    """An event: a command, one of its results, a robot's new state, or a new commander.

    `robot` is a name, "" for the fleet; `operator` gave the command, "" if there was none. `trial`
    is the mission's name at the time.
    """

    unix_time_s: float
    kind: EventKind
    robot: str
    text: str
    operator: str = ""
    trial: str = ""


@dataclass(frozen=True, slots=True)
class Explored:
    """A robot's explored map: `explored_to_bytes` in base64."""

    robot: str
    cells: str
