"""JSON protocol between the ground process and its clients.

Only the ground process (`lpac ground`) communicates with the fleet. Clients (commands, views,
scripts) connect to its Unix socket and send one line: a command, or `SUBSCRIBE`. Each line of the
answer is a JSON object whose only key names its kind, such as {"snapshot": {...}}.

A command is answered by `CommandProgress` at least once a second (empty if there is none), then one
`CommandReport`. A client that disconnects earlier abandons what is not ordered yet. A subscription
is answered by a `FleetSetup`, the known `Explored` maps and the last `GroundEvent`s; then, until
the client disconnects, by a `FleetSnapshot` at 5 Hz or more, and the other kinds as they change.
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

# With a margin for the promised 5 Hz.
SNAPSHOT_PERIOD_S = 0.18
SUBSCRIBE = b"subscribe\n"

T = TypeVar("T")

# In commands, `robots` are names; empty for all robots with a slot.


@dataclass(frozen=True, slots=True)
class SetOrigin:
    """Set the origin of the mission frame. Refused while any robot is armed."""

    origin: Origin
    robots: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class SetFence:
    """Set the fence; None: each robot's configured fence. Refused while any is armed."""

    fence: Fence | None
    robots: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class SetWorld:
    """Set the virtual sensors' world: a CoverageControl world file's text, and its name.

    Refused while any robot is armed.
    """

    text: str
    name: str
    robots: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.name.isprintable():
            raise ValueError(f"name = {self.name!r}: must be printable")
        if len(self.text) > WORLD.limit_bytes:
            raise ValueError(
                f"{self.name} has {len(self.text)} characters: must be at most {WORLD.limit_bytes}"
            )
        features = parse_world(self.text, self.name)
        if len(features) > MOST_FEATURES:
            raise ValueError(
                f"{self.name} has {len(features)} features: must be at most {MOST_FEATURES}"
            )


@dataclass(frozen=True, slots=True)
class SetPlaces:
    """Assign slots to robots, by name. Others keep theirs, unless it is one of these slots.

    Refused while any robot is armed.
    """

    places: dict[str, Place]


@dataclass(frozen=True, slots=True)
class Enable:
    """Let robots run their checks and fly. With `on` False they may not; those in flight hold."""

    on: bool = True
    robots: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Takeoff(Bounded):
    """Take off one after another, `interval_s` apart, the highest first.

    Done when all are at their heights. With `abort_on_failure`, a failure cancels later takeoffs.
    """

    robots: tuple[str, ...] = ()
    interval_s: Annotated[float, Meta(ge=0.0, le=600.0)] = 2.0
    abort_on_failure: bool = False


@dataclass(frozen=True, slots=True)
class Start:
    """Start the mission, from hold."""

    robots: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class SafetyCommand:
    """Hold, return to the landing points, or land in place. `wait`: done when all have landed.

    Any station may command hold. In a return, robots land from the lowest to the highest.
    """

    action: Literal["hold", "return", "land"]
    robots: tuple[str, ...] = ()
    wait: bool = False


@dataclass(frozen=True, slots=True)
class Resume:
    """Withdraw hold, return or land; robots that flew this trial's mission fly it again."""

    robots: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class RobotCommand:
    """Hand over to a pilot, take back, disarm or kill robots. Here, empty `robots` means none."""

    kind: Literal["pilot", "rejoin", "disarm", "kill"]
    robots: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class NextTrial(Bounded):
    """Begin the next trial, named `trial` or by the next number; reset maps and messages.

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
    """Take command of the fleet from the present commander."""


Request = (
    SetOrigin | SetFence | SetWorld | SetPlaces | Enable | Takeoff | Start | SafetyCommand
    | Resume | RobotCommand | NextTrial | TakeCommand
)  # fmt: skip


def command_name(request: Request) -> str:
    """Name of a command in `lpac mission`."""
    match request:
        case Enable():
            return "enable" if request.on else "disable"
        case SafetyCommand():
            return request.action
        case RobotCommand():
            return request.kind
    return _NAMES[type(request)]


def of_robots(name: str, robots: tuple[str, ...]) -> Request:
    """Make the command of that name for these robots, with defaults.

    Raises KeyError if there is none, or it has no defaults.
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
    """Describe a command as `lpac mission` has it, with its robots."""
    robots: tuple[str, ...] = getattr(request, "robots", ())
    words = [command_name(request), getattr(request, "name", ""), ",".join(robots)]
    return " ".join(filter(None, words))


@dataclass(frozen=True, slots=True)
class CommandProgress:
    """Progress of a command for a robot, or for the fleet ("").

    A robot's result is sent this way too, as soon as it is known. An empty text is a keep-alive.
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
    """Result for one robot. `refusal` is the code of an order that it refused."""

    robot: str
    code: ResultCode
    text: str
    refusal: RefusalCode | None = None

    @property
    def done(self) -> bool:
        """Whether the robot did it."""
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
    """Why nothing of a command was done, and the remedy."""

    code: ProblemCode
    text: str


@dataclass(frozen=True, slots=True)
class CommandReport:
    """End of a command: each addressed robot's result, or why nothing was done."""

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
    """Encode a message as one line of JSON."""
    return encode({_NAMES[type(message)]: message}) + b"\n"


def request_from_line(line: bytes) -> Request:
    """Decode a command. Raises MessageError."""
    return _from_line(_REQUESTS, line)


def server_message_from_line(line: bytes) -> ServerMessage:
    """Decode an answer. Raises MessageError."""
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
