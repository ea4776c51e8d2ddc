"""In-memory links between robots and ground stations, on a simulated clock."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from edge.core import F64
from edge.core.schema import Bounded, NonNegative, Share
from edge.messages.topics import ReceiveCallback, Topic
from lpac.sim.schedule import Schedule

Subscriptions = Mapping[Topic, ReceiveCallback]
# Station id of the first ground station; further ones are -2, -3, ...
GROUND = -1


@dataclass(frozen=True, slots=True)
class Air(Bounded):
    """Radio faults. They may be replaced while the radio is in use.

    From one sender to one receiver a message is lost with probability `loss`, arrives twice with
    `duplication`, with one bit flipped with `corruption`, and travels `delay_s` on average,
    anything from half to one and a half of it, so that later ones overtake it. Robots further apart
    than `range_m` do not receive each other; a ground station is always in range. Stations in
    different groups of `partition` (ids of robots and ground stations) cannot communicate; stations
    in no group reach all. `silent` stations are never received, and `deaf` ones receive nothing.

    Raises ValueError that names the invalid field.
    """

    loss: Share = 0.0
    duplication: Share = 0.0
    corruption: Share = 0.0
    delay_s: NonNegative = 0.01
    range_m: float = math.inf
    partition: tuple[frozenset[int], ...] = ()
    silent: frozenset[int] = frozenset()
    deaf: frozenset[int] = frozenset()

    def check_rules(self) -> None:
        if not self.range_m > 0.0:
            raise ValueError(f"range_m = {self.range_m}: must be above 0")

    def keeps_apart(self, sender: int, receiver: int) -> bool:
        """Whether these faults block all messages to the receiver, at any distance."""
        if sender in self.silent or receiver in self.deaf:
            return True
        if not self.partition:
            return False
        of_one = [group for group in self.partition if sender in group]
        of_other = [group for group in self.partition if receiver in group]
        return bool(of_one and of_other and of_one != of_other)


class Radio:
    """All links of a fleet, with counts of sent bytes and lost messages.

    `air` may be replaced at any time.
    """

    def __init__(
        self,
        schedule: Schedule,
        positions_m: Callable[[], F64],
        rng: np.random.Generator,
        air: Air | None = None,
    ) -> None:
        """`positions_m` gives the robots' true positions, (N, 3), m; `rng` draws losses, delays."""
        self.air = air or Air()
        self.sent_bytes = 0
        self.lost = 0
        self.schedule = schedule
        self._positions_m = positions_m
        self.rng = rng
        self._links: list[RadioLink] = []

    def link(self, station: int, subscriptions: Subscriptions) -> "RadioLink":
        """Open a link for robot `station`; ids below 0 are ground stations."""
        link = RadioLink(self, station, subscriptions)
        self._links.append(link)
        return link

    def suspend(self, station: int, duration_s: float) -> None:
        """Hold back all messages to that station for this long."""
        for link in self._links:
            if link.station == station:
                link.suspended_until_s = self.schedule.monotonic_s() + duration_s

    def leave(self, link: "RadioLink") -> None:
        """Remove a link."""
        self._links.remove(link)

    def others(self, link: "RadioLink") -> frozenset[int]:
        """Stations of all other links."""
        return frozenset(other.station for other in self._links if other is not link)

    def send(self, sender: "RadioLink", topic: Topic, data: bytes) -> None:
        """Send to all other subscribers of the topic."""
        own = sender.station
        key = f"ground/{topic.name}" if topic.sender == "ground" else f"robot/{own}/{topic.name}"
        self.sent_bytes += len(data)
        if len(data) > topic.limit_bytes:
            return
        air, now_s = self.air, self.schedule.monotonic_s()
        for receiver in self._links:
            if receiver is sender or not receiver.subscribes(topic):
                continue
            # All four are drawn for each receiver: changing one fault leaves later draws alone.
            lost, twice, travel, second_travel = self.rng.random(4).tolist()
            if self._apart(own, receiver.station):
                continue
            if lost < air.loss:
                self.lost += 1
                continue
            arrives = data
            if air.corruption and self.rng.random() < air.corruption:
                arrives = _corrupted(data, int(self.rng.integers(8 * len(data))))
            deliver = partial(receiver.deliver, topic, key, arrives)
            self.schedule.at(now_s + air.delay_s * (0.5 + travel), deliver)
            if twice < air.duplication:
                self.schedule.at(now_s + air.delay_s * (0.5 + second_travel), deliver)

    def _apart(self, sender: int, receiver: int) -> bool:
        if self.air.keeps_apart(sender, receiver):
            return True
        if min(sender, receiver) < 0 or self.air.range_m == math.inf:
            return False
        offset_m = self._positions_m()[sender] - self._positions_m()[receiver]
        return math.hypot(*offset_m) > self.air.range_m


class RadioLink:
    """One program's link: a `Link`."""

    def __init__(self, radio: Radio, station: int, subscriptions: Subscriptions) -> None:
        self.station = station
        self._radio = radio
        self.suspended_until_s = -math.inf
        self._subscriptions: Subscriptions = dict(subscriptions)

    def publish(self, topic: Topic, data: bytes) -> None:
        """Publish to all subscribers; messages may be lost."""
        self._radio.send(self, topic, data)

    def peers(self) -> int:
        """Number of other stations, in range or not."""
        return len(self._radio.others(self))

    def refused(self) -> int:
        """Return 0: oversized messages are dropped on the way, and nothing floods the link."""
        return 0

    def is_claimed(self, robot_id: int) -> bool:
        """Whether another station uses that robot id."""
        return robot_id in self._radio.others(self)

    def subscribes(self, topic: Topic) -> bool:
        """Whether the link subscribes to the topic."""
        return topic in self._subscriptions

    def deliver(self, topic: Topic, key: str, data: bytes) -> None:
        """Pass a message to its callback, unless the link closed while it was on its way."""
        if self._radio.schedule.monotonic_s() < self.suspended_until_s:
            self._radio.schedule.at(self.suspended_until_s, partial(self.deliver, topic, key, data))
            return
        callback = self._subscriptions.get(topic)
        if callback is not None:
            callback(key, data)

    def close(self) -> None:
        """Unsubscribe and leave the radio."""
        self._subscriptions = {}
        self._radio.leave(self)


def _corrupted(data: bytes, bit: int) -> bytes:
    """Copy of the message with one bit flipped."""
    changed = bytearray(data)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)
