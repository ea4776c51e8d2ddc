"""What the ground process and its clients say to each other, and its JSON.

The ground process (`lpac ground`) alone speaks to the fleet. Its clients (commands, views, scripts)
connect to its Unix socket and send one line: a command, or `SUBSCRIBE`. Each line of the answer
is one JSON object whose only key names its kind, such as {"picture": {...}}.

A command is answered by any number of `Progress`, at least one a second, if only an empty one, and
then one `Report`. A client that leaves before abandons what is not ordered yet. A subscription is
answered by a `Setup` (again whenever the world changes), what is known of each robot's `Explored`,
the last `Event`s, and then a `Picture` at 5 Hz or more, and the rest as it happens, until the
client leaves.
"""

import dataclasses
import json
import re
from dataclasses import dataclass, field
from typing import Literal, TypeVar

from edge.core.margins import ErrorBudget
from edge.core.mission import GroundState, Origin, Place, RobotStatus
from edge.core.safety import Fence
from edge.core.schema import ConfigError, from_mapping
from edge.core.world import MOST_FEATURES, parse_world

# With a reserve: 5 Hz is promised.
PICTURE_PERIOD_S = 0.18
# A robot that said nothing for longer is not heard any more.
FRESH_S = 2.0
SUBSCRIBE = b"subscribe\n"
# What the radio takes at once.
LARGEST_WORLD = 400_000
_TRIAL = re.compile(r"[A-Za-z0-9_.-]{0,32}")

T = TypeVar("T")

# Commands: `robots` are names, empty for all robots that sit in a slot.


@dataclass(frozen=True, slots=True)
class SetOrigin:
    """Where the mission frame lies. Refused while one of the robots is armed."""

    origin: Origin
    robots: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class SetFence:
    """Where robots may fly; None: each robot's configured fence. Refused while one is armed."""

    fence: Fence | None
    robots: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class SetWorld:
    """What the virtual sensors see: a CoverageControl world file's text, and how it is called.

    Refused while one of the robots is armed.
    """

    text: str
    name: str
    robots: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.name.isprintable():
            raise ValueError(f"name = {self.name!r}: must be printable")
        if len(self.text) > LARGEST_WORLD:
            raise ValueError(
                f"{self.name} has {len(self.text)} characters: must be {LARGEST_WORLD} at most"
            )
        features = parse_world(self.text, self.name)
        if len(features) > MOST_FEATURES:
            raise ValueError(
                f"{self.name} has {len(features)} features: must be {MOST_FEATURES} at most"
            )


@dataclass(frozen=True, slots=True)
class SetPlaces:
    """Who flies and lands where, by the robots' names; all others stay where they are.

    Who sat in one of these slots sits in none. Refused while one of the robots is armed.
    """

    places: dict[str, Place]


@dataclass(frozen=True, slots=True)
class Enable:
    """Let robots run their checks, and fly; or with `on` False no more: what flies then holds."""

    on: bool = True
    robots: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Takeoff:
    """One after another, `interval_s` apart, the highest first; done when all are at their heights.

    With `abort_on_failure` nobody else takes off once one has failed.
    """

    robots: tuple[str, ...] = ()
    interval_s: float = 2.0
    abort_on_failure: bool = False

    def __post_init__(self) -> None:
        if not 0.0 <= self.interval_s <= 600.0:
            raise ValueError(f"interval_s = {self.interval_s}: must be from 0 to 600")


@dataclass(frozen=True, slots=True)
class Start:
    """Fly the mission, from hold."""

    robots: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Calm:
    """Hold, return to the landing points, or land. `wait`: done only when all have landed.

    Anybody may command hold; robots of a return land from the lowest height to the highest.
    """

    calm: Literal["hold", "return", "land"]
    robots: tuple[str, ...] = ()
    wait: bool = False


@dataclass(frozen=True, slots=True)
class Resume:
    """Withdraw hold, return or land; who flew this trial's mission before flies it again."""

    robots: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Give:
    """Order of one kind to each robot: hand over to a pilot, take back, disarm, kill.

    Unlike elsewhere, no robots are none.
    """

    kind: Literal["pilot", "rejoin", "disarm", "kill"]
    robots: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Again:
    """The next trial, called `trial`, or numbered on: explored maps and mailboxes are reset.

    Refused while a robot flies its mission.
    """

    trial: str = ""
    robots: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if _TRIAL.fullmatch(self.trial) is None:
            raise ValueError(
                f"trial = {self.trial!r}: must be at most 32 letters, digits, '.', '-' and '_'"
            )


@dataclass(frozen=True, slots=True)
class Command:
    """Take the command of the fleet from whoever has it."""


Request = (
    SetOrigin | SetFence | SetWorld | SetPlaces | Enable | Takeoff | Start | Calm | Resume | Give
    | Again | Command
)  # fmt: skip

# Answers


@dataclass(frozen=True, slots=True)
class Progress:
    """Something became known of one robot (its name) while a command runs; "" is the fleet.

    Each robot's result is told so, too, as soon as it is known. Without a text it tells only that
    the ground process is there.
    """

    robot: str
    text: str


@dataclass(frozen=True, slots=True)
class Result:
    """What one robot did; `text` is how, or why not."""

    robot: str
    done: bool
    text: str


@dataclass(frozen=True, slots=True)
class Report:
    """The end of a command: each addressed robot's result, and what concerns no single one.

    `problem` is "" unless nothing was done at all.
    """

    results: tuple[Result, ...] = ()
    problem: str = ""

    @property
    def done(self) -> bool:
        """Whether every addressed robot did it."""
        return not self.problem and all(result.done for result in self.results)


@dataclass(frozen=True, slots=True)
class Site:
    """One slot: its place (height and landing point), its pad (x, y), m, and who sits in it."""

    place: Place
    pad_m: tuple[float, ...]
    robot: str = ""


@dataclass(frozen=True, slots=True)
class Setup:
    """What does not change, or seldom.

    `operator` is this station's. `robots` are the robots' ids by name, in the fleet's order. The
    policy's world is `world_size` cells wide, `env_scale` of them per m, from the mission origin
    on; its sensor sees `sensor_size` cells. `world` is the text of the robots' world file, called
    `world_id`; "" if it is not known here. `truncation` and `norm` are what `rasterize` needs for
    it. `fence` is the configured one. A slot's height is `base_height_m` + its number x
    `slot_spacing_m`; how far places must be apart follows from `errors`. Robots land at once with a
    battery of `battery_critical`, hold when they have heard no ground for `ground_timeout_s`, and
    land `ground_lost_land_s` later.
    """

    fleet: str
    operator: str
    robots: dict[str, int]
    slots: tuple[Site, ...]
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


@dataclass(frozen=True, slots=True)
class RobotPicture:
    """A robot as the ground knows it; `status` is its newest, None if it was never heard.

    `age_s` is how long ago that came, `clock_offset_s` how far its clock is ahead of this one.
    `rates_hz` are the rates at which it gets each neighbour's messages (robot id as text), over the
    last few seconds. `duplicate`: two programs say that they are this robot.
    """

    name: str
    robot_id: int
    status: RobotStatus | None = None
    age_s: float | None = None
    clock_offset_s: float | None = None
    rates_hz: dict[str, float] = field(default_factory=dict)
    duplicate: bool = False

    @property
    def fresh(self) -> bool:
        """Whether it is heard."""
        return self.age_s is not None and self.age_s <= FRESH_S


@dataclass(frozen=True, slots=True)
class Picture:
    """The fleet now. `unix_time_s` is the ground's clock.

    `commander` is who commands, "" if nobody does yet; `ground` is the state that robots are told,
    by whoever commands. `running` are the commands that run now, in words. `commander_age_s` is how
    long ago the commander was heard, 0 if that is this station.
    """

    unix_time_s: float
    commander: str
    ground: GroundState | None
    robots: tuple[RobotPicture, ...]
    running: tuple[str, ...] = ()
    commander_age_s: float = 0.0


EventKind = Literal["command", "result", "refusal", "state", "commander", "presence"]


@dataclass(frozen=True, slots=True)
class Event:
    """Something happened: a command and each of its results, a robot's new state, a new commander.

    `robot` is a name, "" for the fleet; `operator` whose command it was, "" if nobody's. `trial` is
    the mission's name then.
    """

    unix_time_s: float
    kind: EventKind
    robot: str
    text: str
    operator: str = ""
    trial: str = ""


@dataclass(frozen=True, slots=True)
class Explored:
    """What a robot has explored: `explored_to_bytes` in base64."""

    robot: str
    cells: str


Told = Setup | Picture | Event | Explored | Progress | Report

_REQUESTS: dict[str, type[Request]] = {
    "origin": SetOrigin, "fence": SetFence, "world": SetWorld, "places": SetPlaces,
    "enable": Enable, "takeoff": Takeoff, "start": Start, "calm": Calm, "resume": Resume,
    "give": Give, "again": Again, "command": Command,
}  # fmt: skip
_ANSWERS: dict[str, type[Told]] = {
    "setup": Setup, "picture": Picture, "event": Event, "explored": Explored,
    "progress": Progress, "report": Report,
}  # fmt: skip
_NAMES = {kind: name for name, kind in (*_REQUESTS.items(), *_ANSWERS.items())}


def to_line(message: Request | Told) -> bytes:
    """The message as one line of JSON."""
    mapping = {_NAMES[type(message)]: dataclasses.asdict(message)}
    return json.dumps(mapping, separators=(",", ":")).encode() + b"\n"


def request_from_line(line: bytes) -> Request:
    """Raises ConfigError that says what is wrong with it."""
    return _from_line(_REQUESTS, line)


def told_from_line(line: bytes) -> Told:
    """Raises ConfigError that says what is wrong with it."""
    return _from_line(_ANSWERS, line)


def _from_line(kinds: dict[str, type[T]], line: bytes) -> T:
    try:
        mapping = json.loads(line)
    except (ValueError, RecursionError):
        raise ConfigError("ground: not JSON") from None
    if not isinstance(mapping, dict) or len(mapping) != 1 or not kinds.keys() >= mapping.keys():
        raise ConfigError(f"ground: one of {', '.join(kinds)} is expected")
    ((name, fields),) = mapping.items()
    return from_mapping(kinds[name], fields, name)
