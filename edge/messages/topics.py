"""Topics of the radio, and the interface of links.

A topic's key is `lpac/<fleet>/robot/<id>/<name>` or `lpac/<fleet>/ground/<name>`. Links take each
topic's sender, size limit and priority from here, and drop larger messages.
"""

import re
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from typing import Literal, NamedTuple, Protocol

from edge.core.wire import MAX_ROBOT_ID, deflate, inflate

_ROBOT_KEY = re.compile(r"robot/(0|[1-9][0-9]{0,4})/")

SenderKind = Literal["robot", "ground"]
Priority = Literal["now", "later"]


class Topic(NamedTuple):
    """One kind of message.

    `content` names its type, `rate_hz` is one sender's rate. Receivers accept at most `most_hz` on
    a key, `most_of_one_hz` of it from one connection, and `limit_bytes` a message. `logged` is the
    flight log's topic for these messages. Messages with priority "later" wait until no others do. A
    `deflated` payload travels as a raw deflate stream, of at most `limit_bytes` when inflated.
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
        """Key expression of all its senders, below `lpac/<fleet>/`."""
        return f"robot/*/{self.name}" if self.sender == "robot" else f"ground/{self.name}"

    def packed(self, payload: bytes) -> bytes:
        """The payload as it travels."""
        return deflate(payload) if self.deflated else payload

    def unpacked(self, data: bytes) -> bytes | None:
        """The inverse of `packed`; None for other data, or for more than `limit_bytes`."""
        if not self.deflated:
            return data
        payload = inflate(data, self.limit_bytes)
        return None if payload is None or len(payload) > self.limit_bytes else bytes(payload)


# `most_hz` leaves room for a policy faster than the paper's, and for orders to all robots at once.
MESSAGE = Topic(
    "message", "robot", "Beacon, AggregatedMessage", 2.5, 100, 2**20, "now", "received",
    deflated=False,  # `edge.core.wire` compresses what is worth it.
)  # fmt: skip
STATUS = Topic("status", "robot", "RobotStatus", 2.0, 20, 2**16, "now", "status")
EXPLORED = Topic("explored", "robot", "bits", 1.0, 5, 2**10, "later", None)
# Room for ten grounds: one that floods, such as a revoked laptop, must not drown another's hold.
# `most_of_one_hz` drops a message that follows the last too closely, so orders have none: those for
# all robots go at once.
# A ground publishes STATE at each tick, 5.5 times a second, while a robot receives it late.
STATE = Topic("state", "ground", "GroundState", 2.5, 500, 2**16, "now", "ground", 50)
HOLD = Topic("hold", "ground", "Hold", 5.0, 500, 2**14, "now", None, 50)
ORDER = Topic("order", "ground", "Order", 5.0, 500, 2**12, "now", "order")
WORLD = Topic("world", "ground", "CoverageControl world file", 2.0, 50, 400_000, "later", None, 5)

TOPICS = (MESSAGE, STATUS, EXPLORED, STATE, HOLD, ORDER, WORLD)


def robot_id_in(key: str) -> int | None:
    """Robot id in a key below `lpac/<fleet>/`; None if it is no robot's key."""
    found = _ROBOT_KEY.match(key)
    return int(found[1]) if found and int(found[1]) <= MAX_ROBOT_ID else None


class Link(Protocol):
    """The radio. Methods may be called from any thread; they neither block nor raise."""

    def publish(self, topic: Topic, data: bytes) -> None:
        """Send to all subscribers, without a guarantee of delivery."""

    def is_claimed(self, robot_id: int) -> bool:
        """Whether another program claims to be that robot."""

    def peers(self) -> int:
        """Number of other programs that it reaches now."""

    def refused(self) -> int:
        """Count of messages dropped before decoding: too many at once, or too large."""


# Takes the key below `lpac/<fleet>/` and the data, on any thread; it must only store them. Returns
# False if it refused the message.
ReceiveCallback = Callable[[str, bytes], bool | None]


class Knocking(Protocol):
    """Maker and verifier of knocks: signed datagrams that open a member's port (port knocking)."""

    def knock(self, place: str) -> bytes:
        """A new knock from this member for the port at `place`: IPv4 address:port."""

    def is_knock(self, data: bytes, place: str) -> bool:
        """Whether it is a member's knock for that port, and no replay."""


class TlsFiles(NamedTuple):
    """A member's paths: the authority's certificate, its own, and its secret key, all PEM."""

    authority: str
    certificate: str
    key: str


class GroupKeys(NamedTuple):
    """Keys of a multicast group, 32 bytes each; `receiving` has all accepted ones, newest first."""

    receiving: tuple[bytes, ...]
    sending: bytes


class Group(NamedTuple):
    """A multicast group for the messages from robot to robots.

    `interface` is the robot's own IPv4 address in the group's network. `keys` returns the present
    keys; they are secret only with `is_secret`.
    """

    address: str
    port: int
    interface: str
    keys: Callable[[], GroupKeys]
    is_secret: bool


class LinkSetting(NamedTuple):
    """The radio's settings in robot.toml: see `edge.robot.config.LinkConfig`.

    With `robot_id` None it only subscribes. `subscriptions` maps topics to callbacks. The link must
    drop messages that exceed their topic's rate or size (`edge.messages.admission`). With `tls`
    only members of the fleet can connect; without, everybody who reaches it. With `group`, messages
    from robot to robots go by multicast. With `members`, a listening port admits members alone.
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
    """A type of radio: a factory of links, which are closed when the robot's program ends."""

    def __call__(self, setting: LinkSetting) -> AbstractContextManager[Link]:
        """Open a link. Raises ValueError or OSError, one line, for an unusable setting."""
