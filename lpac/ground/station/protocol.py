"""Protocol between the ground process and its clients, and its JSON.

The ground process (`lpac ground`) alone speaks to the fleet. Its clients (commands, views, scripts)
connect to its Unix socket and send one line: a command, or `SUBSCRIBE`. Each line of the answer
is one JSON object whose only key names its kind, such as {"snapshot": {...}}.

A command is answered by any number of `CommandProgress`, at least one a second, if only an empty
one, and then one `CommandReport`. A client that leaves before abandons what is not ordered yet. A
subscription is answered by a `FleetSetup` (again whenever the world changes), what is known of each
robot's `Explored`, the last `GroundEvent`s, and then a `FleetSnapshot` at 5 Hz or more, and the
rest as it happens, until the client leaves.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Literal, TypeVar

import msgspec
from msgspec import Meta

from edge.core.fence import Fence
from edge.core.schema import Bounded
from edge.core.world import MOST_FEATURES, parse_world
from edge.messages.codec import MessageError, decode, encode
from edge.messages.codes import RefusalCode
from edge.messages.mission import Origin, Place
from edge.messages.topics import WORLD
from lpac.analysis.snapshot import Explored, FleetSetup, FleetSnapshot, GroundEvent

# With a reserve: 5 Hz is promised.
SNAPSHOT_PERIOD_S = 0.18
SUBSCRIBE = b"subscribe\n"

T = TypeVar("T")

# Commands: `robots` are names, empty for all robots that sit in a slot.


@dataclass(frozen=True, slots=True)
class SetOrigin:
    """Set the origin of the mission frame. Refused while one of the robots is armed."""

    origin: Origin
    robots: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class SetFence:
    """Set the fence; None: each robot's configured fence. Refused while one is armed."""

    fence: Fence | None
    robots: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class SetWorld:
    """World of the virtual sensors: a CoverageControl world file's text, and its name.

    Refused while one of the robots is armed.
    """

    text: str
    name: str
    robots: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.name.isprintable():
            raise ValueError(f"name = {self.name!r}: must be printable")
        if len(self.text) > WORLD.limit_bytes:
            raise ValueError(
                f"{self.name} has {len(self.text)} characters: must be {WORLD.limit_bytes} at most"
            )
        features = parse_world(self.text, self.name)
        if len(features) > MOST_FEATURES:
            raise ValueError(
                f"{self.name} has {len(features)} features: must be {MOST_FEATURES} at most"
            )


@dataclass(frozen=True, slots=True)
class SetPlaces:
    """Slots of robots, by their names; all others stay where they are.

    Who sat in one of these slots sits in none. Refused while one of the robots is armed.
    """

    places: dict[str, Place]


@dataclass(frozen=True, slots=True)
class Enable:
    """Let robots run their checks, and fly; or with `on` False no more: what flies then holds."""

    on: bool = True
    robots: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Takeoff(Bounded):
    """One after another, `interval_s` apart, the highest first; done when all are at their heights.

    With `abort_on_failure` nobody else takes off once one has failed.
    """

    robots: tuple[str, ...] = ()
    interval_s: Annotated[float, Meta(ge=0.0, le=600.0)] = 2.0
    abort_on_failure: bool = False


@dataclass(frozen=True, slots=True)
class Start:
    """Fly the mission, from hold."""

    robots: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class SafetyCommand:
    """Hold, return to the landing points, or land. `wait`: done only when all have landed.

    Anybody may command hold; robots of a return land from the lowest height to the highest.
    """

    action: Literal["hold", "return", "land"]
    robots: tuple[str, ...] = ()
    wait: bool = False


@dataclass(frozen=True, slots=True)
class Resume:
    """Withdraw hold, return or land; who flew this trial's mission before flies it again."""

    robots: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class RobotCommand:
    """Order of one kind to each robot: hand over to a pilot, take back, disarm, kill.

    Unlike elsewhere, no robots are none.
    """

    kind: Literal["pilot", "rejoin", "disarm", "kill"]
    robots: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class NextTrial(Bounded):
    """The next trial, called `trial`, or numbered on: explored maps and messages are forgotten.

    Refused while a robot flies its mission.
    """

    trial: Annotated[
        str,
        Meta(
            pattern=r"\A[A-Za-z0-9_.-]{0,32}\Z",
            description="at most 32 letters, digits, '.', '-' and '_'",
        ),
    ] = ""
    robots: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class TakeCommand:
    """Take the command of the fleet from whoever has it."""


Request = (
    SetOrigin | SetFence | SetWorld | SetPlaces | Enable | Takeoff | Start | SafetyCommand
    | Resume | RobotCommand | NextTrial | TakeCommand
)  # fmt: skip


def command_name(request: Request) -> str:
    """The name of a command in `lpac mission`."""
    match request:
        case Enable():
            return "enable" if request.on else "disable"
        case SafetyCommand():
            return request.action
        case RobotCommand():
            return request.kind
    return _NAMES[type(request)]


def of_robots(name: str, robots: tuple[str, ...]) -> Request:
    """The command of that name for these robots, and nothing else of it chosen.

    Raises KeyError if there is none that needs nothing else.
    """
    return _OF_ROBOTS[name](robots)


_OF_ROBOTS: dict[str, Callable[[tuple[str, ...]], Request]] = {
    "enable": lambda robots: Enable(True, robots),
    "disable": lambda robots: Enable(False, robots),
    "takeoff": Takeoff,
    "start": Start,
    "hold": lambda robots: SafetyCommand("hold", robots),
    "return": lambda robots: SafetyCommand("return", robots),
    "land": lambda robots: SafetyCommand("land", robots),
    "resume": Resume,
    "pilot": lambda robots: RobotCommand("pilot", robots),
    "rejoin": lambda robots: RobotCommand("rejoin", robots),
    "command": lambda _: TakeCommand(),
}


def in_words(request: Request) -> str:
    """A command as `lpac mission` has it, with its robots."""
    robots: tuple[str, ...] = getattr(request, "robots", ())
    words = [command_name(request), getattr(request, "name", ""), ",".join(robots)]
    return " ".join(filter(None, words))


# Answers


@dataclass(frozen=True, slots=True)
class CommandProgress:
    """Something became known of one robot (its name) while a command runs; "" is the fleet.

    Each robot's result is told so, too, as soon as it is known. Without a text it tells only that
    the ground process is there.
    """

    robot: str
    text: str


class ResultCode(StrEnum):
    """Outcome of a command for one robot."""

    DONE = "done"
    NOT_HEARD = "not_heard"
    DUPLICATE_ID = "duplicate_id"
    NOT_OBEYING = "not_obeying"
    NOT_TAKEN_UP = "not_taken_up"
    NOT_ENABLED = "not_enabled"
    NOT_READY = "not_ready"
    UNDER_SAFETY_ACTION = "under_safety_action"
    WRONG_STATE = "wrong_state"
    LANDED_ELSEWHERE = "landed_elsewhere"
    TOO_LOW = "too_low"
    REFUSED = "refused"
    NOT_ORDERED = "not_ordered"
    ABANDONED = "abandoned"


@dataclass(frozen=True, slots=True)
class RobotResult:
    """Result of one robot; `text` is how, or why not. `refusal` is of an order that it refused."""

    robot: str
    code: ResultCode
    text: str
    refusal: RefusalCode | None = None

    @property
    def done(self) -> bool:
        """Whether it did it."""
        return self.code is ResultCode.DONE


class ProblemCode(StrEnum):
    """Why nothing of a command was done."""

    NOT_UNDERSTOOD = "not_understood"
    NO_GROUND = "no_ground"
    DEFECT = "defect"
    MAY_NOT = "may_not"
    OTHER_COMMANDS = "other_commands"
    UNKNOWN_ROBOT = "unknown_robot"
    NO_ROBOT = "no_robot"
    NO_ORIGIN = "no_origin"
    NOT_ENABLED = "not_enabled"
    UNDER_SAFETY_ACTION = "under_safety_action"
    ARMED = "armed"
    ON_MISSION = "on_mission"
    SLOT_SHARED = "slot_shared"


@dataclass(frozen=True, slots=True)
class Problem:
    """Why nothing of a command was done, and what helps."""

    code: ProblemCode
    text: str


@dataclass(frozen=True, slots=True)
class CommandReport:
    """The end of a command: each addressed robot's result, or why nothing was done at all."""

    results: tuple[RobotResult, ...] = ()
    problem: Problem | None = None

    @property
    def done(self) -> bool:
        """Whether every addressed robot did it."""
        return self.problem is None and all(result.done for result in self.results)


ServerMessage = (
    FleetSetup | FleetSnapshot | GroundEvent | Explored | CommandProgress | CommandReport
)

_REQUESTS: dict[str, type[Request]] = {
    "origin": SetOrigin, "fence": SetFence, "world": SetWorld, "assign": SetPlaces,
    "enable": Enable, "takeoff": Takeoff, "start": Start,
    "safety_command": SafetyCommand, "resume": Resume, "robot_command": RobotCommand,
    "again": NextTrial, "command": TakeCommand,
}  # fmt: skip
_ANSWERS: dict[str, type[ServerMessage]] = {
    "setup": FleetSetup, "snapshot": FleetSnapshot, "event": GroundEvent, "explored": Explored,
    "progress": CommandProgress, "report": CommandReport,
}  # fmt: skip
_NAMES = {kind: name for name, kind in (*_REQUESTS.items(), *_ANSWERS.items())}


_kinds_and_fields = msgspec.json.Decoder(dict[str, msgspec.Raw])


def to_line(message: Request | ServerMessage) -> bytes:
    """The message as one line of JSON."""
    return encode({_NAMES[type(message)]: message}) + b"\n"


def request_from_line(line: bytes) -> Request:
    """Raises MessageError that says what is wrong with it."""
    return _from_line(_REQUESTS, line)


def server_message_from_line(line: bytes) -> ServerMessage:
    """Raises MessageError that says what is wrong with it."""
    return _from_line(_ANSWERS, line)


def _from_line(kinds: dict[str, type[T]], line: bytes) -> T:
    try:
        mapping = _kinds_and_fields.decode(line)
    except (msgspec.MsgspecError, RecursionError) as error:
        raise MessageError(f"ground: {error}") from None
    if len(mapping) != 1 or not kinds.keys() >= mapping.keys():
        raise MessageError(f"ground: one of {', '.join(kinds)} is expected")
    ((name, fields),) = mapping.items()
    return decode(kinds[name], fields)
