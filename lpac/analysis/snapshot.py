"""A ground station's knowledge of its fleet, as its log holds it and its clients are told."""

from dataclasses import dataclass, field
from typing import Literal

from edge.core.fence import Fence
from edge.flight.margins import ErrorBudget
from edge.messages.mission import FlightState, GroundState, Place, RobotStatus

# A robot that said nothing for longer is not heard any more.
FRESH_S = 2.0
# A commander that was silent for longer is gone.
COMMANDER_SILENT_S = 2.0


@dataclass(frozen=True, slots=True)
class FleetSlot:
    """One slot: its place (height and landing point), its pad (x, y), m, and who sits in it."""

    place: Place
    pad_m: tuple[float, ...]
    robot: str = ""


@dataclass(frozen=True, slots=True)
class FleetSetup:
    """The part that does not change, or seldom.

    `operator` is this station's. `robots` are the robots' ids by name, in the fleet's order. The
    policy's world is `world_size` cells wide, `env_scale` of them per m, from the mission origin
    on; its sensor sees `sensor_size` cells. `world` is the text of the robots' world file, called
    `world_id`; "" if it is not known here. `truncation` and `norm` are what `rasterize` needs for
    it. `fence` is the configured one. A slot's height is `base_height_m` + its number x
    `slot_spacing_m`; how far places must be apart follows from `errors`. Robots land at once with a
    battery of `battery_critical`, hold when they have heard no ground for `ground_timeout_s`, and
    land `ground_lost_land_s` later. `insecure`: whoever is on the network can fly the fleet.
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
    """A robot as the ground knows it; `status` is its newest, None if it was never heard.

    `age_s` is how long ago that came, `clock_offset_s` how far its clock is ahead of this one.
    `rates_hz` are the rates at which it gets each neighbour's messages (robot id as text), over the
    last few seconds, `arrivals` what came of each in the last ten (`Arrivals.counts`). `duplicate`:
    two programs say that they are this robot.
    """

    name: str
    robot_id: int
    status: RobotStatus | None = None
    age_s: float | None = None
    clock_offset_s: float | None = None
    rates_hz: dict[str, float] = field(default_factory=dict)
    arrivals: dict[str, tuple[int, ...]] = field(default_factory=dict)
    duplicate: bool = False

    @property
    def fresh(self) -> bool:
        """Whether it is heard."""
        return self.age_s is not None and self.age_s <= FRESH_S


@dataclass(frozen=True, slots=True)
class FleetSnapshot:
    """The fleet now. `unix_time_s` is the ground's clock.

    `commander` is who commands, "" if nobody does yet; `ground` is the state that robots are told,
    by whoever commands. `running` are the commands that run now, in words. `commander_age_s` is how
    long ago the commander was heard, 0 if that is this station; `shares_name` whether another
    station speaks in this one's name.
    """

    unix_time_s: float
    commander: str
    ground: GroundState | None
    robots: tuple[RobotSnapshot, ...]
    running: tuple[str, ...] = ()
    commander_age_s: float = 0.0
    shares_name: bool = False


EventKind = Literal["command", "result", "refusal", "state", "commander", "presence"]


@dataclass(frozen=True, slots=True)
class GroundEvent:
    """Something happened: a command and each of its results, a robot's new state, a new commander.

    `robot` is a name, "" for the fleet; `operator` whose command it was, "" if nobody's. `trial` is
    the mission's name then, and `state` a robot's new one.
    """

    unix_time_s: float
    kind: EventKind
    robot: str
    text: str
    operator: str = ""
    trial: str = ""
    state: FlightState | None = None


@dataclass(frozen=True, slots=True)
class Explored:
    """A robot's explored map: `explored_to_bytes` in base64."""

    robot: str
    cells: str
