"""Radio traffic: the one table of topics.

A topic's key is `lpac/<fleet>/robot/<id>/<name>` or `lpac/<fleet>/ground/<name>`. The link takes
who sends what, sizes and priorities from here, and drops what is larger.
"""

import re
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from typing import Literal, NamedTuple, Protocol

from edge.core.wire import MAX_ROBOT_ID

_ROBOT_KEY = re.compile(r"robot/(0|[1-9][0-9]{0,4})/")

SenderKind = Literal["robot", "ground"]
Priority = Literal["now", "later"]


class Topic(NamedTuple):
    """One kind of message.

    `content` names what its bytes are, `rate_hz` is how often one sender says it, `most_hz` how
    often a key is listened to at most, and
    `most_of_one_hz` of that one connection, if several speak on the key; `limit_bytes` is the
    largest that is listened to, `logged` the flight log's topic that holds what came or went.
    Of what is sent at once, "later" goes when nothing else waits. A `deflated` payload travels as a
    raw deflate stream, of at most `limit_bytes` when unpacked.
    """

    name: str
    sender: SenderKind
    content: str
    rate_hz: float
    most_hz: float
    limit_bytes: int
    priority: Priority
    logged: str | None
    most_of_one_hz: float | None = None
    deflated: bool = True

    @property
    def pattern(self) -> str:
        """The key of all its senders, below `lpac/<fleet>/`."""
        return f"robot/*/{self.name}" if self.sender == "robot" else f"ground/{self.name}"


# A policy may be run faster than the paper's, and a ground orders each robot of a fleet at once.
MESSAGE = Topic(
    "message", "robot", "Beacon, AggregatedMessage", 2.5, 100, 2**20, "now", "received",
    deflated=False,  # `edge.core.wire` compresses what is worth it.
)  # fmt: skip
STATUS = Topic("status", "robot", "RobotStatus", 2.0, 20, 2**16, "now", "status")
EXPLORED = Topic("explored", "robot", "bits", 1.0, 5, 2**10, "later", None)
# Of ten grounds, so that one that floods, such as a revoked laptop, drowns no other's hold. What is
# said within such a time of the last is not heard, which is why an order has none: those for all
# robots of a fleet go at once.
STATE = Topic("state", "ground", "GroundState", 2.5, 500, 2**16, "now", "ground", 50)
HOLD = Topic("hold", "ground", "Hold", 2.5, 500, 2**14, "now", None, 50)
ORDER = Topic("order", "ground", "Order", 5.0, 500, 2**12, "now", "order")
WORLD = Topic("world", "ground", "CoverageControl world file", 2.0, 50, 400_000, "later", None, 5)

TOPICS = (MESSAGE, STATUS, EXPLORED, STATE, HOLD, ORDER, WORLD)


def robot_id_in(key: str) -> int | None:
    """Id of the robot whose key this is, below `lpac/<fleet>/`; None if it is no robot's."""
    found = _ROBOT_KEY.match(key)
    return int(found[1]) if found and int(found[1]) <= MAX_ROBOT_ID else None


class Link(Protocol):
    """The radio. Called from any thread; nothing waits, and nothing raises."""

    def publish(self, topic: Topic, data: bytes) -> None:
        """Send to whoever listens; it may be lost."""

    def is_claimed(self, robot_id: int) -> bool:
        """Whether another program than this one says that it is that robot."""

    def peers(self) -> int:
        """How many others it reaches now."""

    def refused(self) -> int:
        """How many messages it did not look at: too many at once, or too large."""


# Of the key below `lpac/<fleet>/` and the data; from any thread, and it only stores. False: it was
# nobody's word.
ReceiveCallback = Callable[[str, bytes], bool | None]


class Knocking(Protocol):
    """Maker of a member's knocks, and verifier of others'."""

    def knock(self, place: str) -> bytes:
        """A new datagram, which says who this is, for the port at `place`: IPv4 address:port."""

    def is_knock(self, data: bytes, place: str) -> bool:
        """Whether a member sent it to that port, for the first time."""


class TlsFiles(NamedTuple):
    """A member's paths: the authority's certificate, its own, and its secret key, all PEM."""

    authority: str
    certificate: str
    key: str


class GroupKeys(NamedTuple):
    """Keys of a multicast group, 32 bytes each: all that are heard, the newest first.

    `spoken` is the one of them that is spoken with.
    """

    heard: tuple[bytes, ...]
    spoken: bytes


class Group(NamedTuple):
    """A multicast group in which robots tell each other what they say.

    `interface` is the robot's own IPv4 address, by whose network it is reached. `keys` returns the
    fleet's, as they are now. Without `is_secret` they are no secret.
    """

    address: str
    port: int
    interface: str
    keys: Callable[[], GroupKeys]
    is_secret: bool


class LinkSetting(NamedTuple):
    """The radio's settings in robot.toml: see `edge.robot.config.LinkConfig`.

    With `robot_id` None it only listens. `subscriptions` maps topics to callbacks, which are called
    from any thread with the key below `lpac/<fleet>/`, such as robot/3/message, and the data; they
    only store. What is larger or more often than its topic allows is for the link to drop
    (`edge.messages.admission`). With `tls` only members of the fleet are let in; without, whoever
    reaches it. With `group` robots tell each other there what they have to say. With `members`
    it keeps strangers from its port, where it has one.
    """

    fleet: str
    robot_id: int | None
    listen: tuple[str, ...]
    connect: tuple[str, ...]
    scouting: bool
    options: Mapping[str, object]
    subscriptions: Mapping[Topic, ReceiveCallback]
    tls: TlsFiles | None
    group: Group | None = None
    members: Knocking | None = None


class LinkDriver(Protocol):
    """A type of radio. It is closed when the robot's program ends."""

    def __call__(self, setting: LinkSetting) -> AbstractContextManager[Link]:
        """Raises ValueError or OSError, one line, for a setting that cannot be used."""
