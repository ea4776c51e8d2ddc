"""What travels by radio: the one table of topics.

A topic's key is `lpac/<fleet>/robot/<id>/<name>` or `lpac/<fleet>/ground/<name>`. The link takes
who sends what, sizes and priorities from here, and drops what is larger.
"""

from dataclasses import dataclass
from typing import Literal, Protocol

Sender = Literal["robot", "ground"]
Priority = Literal["now", "later"]


@dataclass(frozen=True, slots=True)
class Topic:
    """One kind of message.

    `content` names what its bytes are, `rate_hz` is how often one sender says it, `limit_bytes` the
    largest that is listened to, `logged` the flight log's topic that holds what came or went.
    Of what is sent at once, "later" goes when nothing else waits.
    """

    name: str
    sender: Sender
    content: str
    rate_hz: float
    limit_bytes: int
    priority: Priority
    logged: str | None

    @property
    def pattern(self) -> str:
        """The key of all its senders, below `lpac/<fleet>/`."""
        return f"robot/*/{self.name}" if self.sender == "robot" else f"ground/{self.name}"


MESSAGE = Topic("message", "robot", "Beacon, AggregatedMessage", 2.5, 2**20, "now", "received")
STATUS = Topic("status", "robot", "RobotStatus", 2.0, 2**16, "now", "status")
EXPLORED = Topic("explored", "robot", "bits", 1.0, 2**10, "later", None)
STATE = Topic("state", "ground", "GroundState", 5.0, 2**16, "now", "ground")
ORDER = Topic("order", "ground", "Order", 5.0, 2**12, "now", "order")
WORLD = Topic("world", "ground", "CoverageControl world file", 2.0, 400_000, "later", None)

TOPICS = (MESSAGE, STATUS, EXPLORED, STATE, ORDER, WORLD)


class Link(Protocol):
    """The radio. Called from any thread; nothing waits, and nothing raises."""

    def publish(self, topic: Topic, data: bytes) -> None:
        """Send to whoever listens; it may be lost."""

    def is_claimed(self, robot_id: int) -> bool:
        """Whether another program than this one says that it is that robot."""
