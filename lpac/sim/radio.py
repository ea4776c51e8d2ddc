"""Links in memory: what robots and a ground say to each other, on a simulated clock."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from edge.core import F64
from edge.messages.topics import Topic
from lpac.sim.schedule import Schedule

Subscriptions = Mapping[Topic, Callable[[str, bytes], None]]
GROUND = -1


@dataclass(frozen=True, slots=True)
class Air:
    """What becomes of messages. Any of it may be replaced while it is used.

    From one sender to one receiver a message is lost with probability `loss`, arrives twice with
    `duplication`, and travels `delay_s` on average, anything from half to one and a half of it, so
    that later ones overtake it. Robots further apart than `range_m` do not hear each other; the
    ground hears everybody. Who is in different groups of `partition` (robot ids, `GROUND` for the
    ground) hears nothing of each other; who is in none hears everybody.

    Raises ValueError that names an impossible value.
    """

    loss: float = 0.0
    duplication: float = 0.0
    delay_s: float = 0.01
    range_m: float = math.inf
    partition: tuple[frozenset[int], ...] = ()

    def __post_init__(self) -> None:
        for name in ("loss", "duplication"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} = {getattr(self, name)}: must be from 0 to 1")
        if not 0.0 <= self.delay_s < math.inf:
            raise ValueError(f"delay_s = {self.delay_s}: must be at least 0 and finite")
        if not self.range_m > 0.0:
            raise ValueError(f"range_m = {self.range_m}: must be above 0")

    def parts(self, one: int, other: int) -> bool:
        """Whether a partition keeps these two apart."""
        of_one = [group for group in self.partition if one in group]
        of_other = [group for group in self.partition if other in group]
        return bool(of_one and of_other and of_one != of_other)


class Radio:
    """All links of a fleet. `air` may be replaced at any time; it counts what was sent and lost."""

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
        self._schedule = schedule
        self._positions_m = positions_m
        self._rng = rng
        self._stations: dict[int, Subscriptions] = {}

    def link(self, station: int, subscriptions: Subscriptions) -> "RadioLink":
        """A robot's link, by its id, or the ground's, `GROUND`; one there was before is gone."""
        self._stations[station] = subscriptions
        return RadioLink(self, station)

    def stations(self) -> frozenset[int]:
        """Who is there."""
        return frozenset(self._stations)

    def send(self, sender: int, topic: Topic, data: bytes) -> None:
        """To everybody else who listens to the topic."""
        key = f"ground/{topic.name}" if topic.sender == "ground" else f"robot/{sender}/{topic.name}"
        self.sent_bytes += len(data)
        for receiver, subscriptions in self._stations.items():
            callback = subscriptions.get(topic)
            if callback is None or receiver == sender or len(data) > topic.limit_bytes:
                continue
            # All are drawn for each receiver: one chance alone does not change those after it.
            lost, twice, *travels = self._rng.random(4).tolist()
            if self._apart(sender, receiver):
                continue
            if lost < self.air.loss:
                self.lost += 1
                continue
            for travel in travels[: 2 if twice < self.air.duplication else 1]:
                at_s = self._schedule.monotonic_s() + self.air.delay_s * (0.5 + travel)
                self._schedule.at(at_s, lambda hear=callback: hear(key, data))  # type: ignore[misc]

    def _apart(self, sender: int, receiver: int) -> bool:
        if self.air.parts(sender, receiver):
            return True
        if GROUND in (sender, receiver) or self.air.range_m == math.inf:
            return False
        offset_m = self._positions_m()[sender] - self._positions_m()[receiver]
        return math.hypot(*offset_m) > self.air.range_m


class RadioLink:
    """One station's link: a `Link`."""

    def __init__(self, radio: Radio, station: int) -> None:
        self._radio = radio
        self._station = station

    def publish(self, topic: Topic, data: bytes) -> None:
        """Send to whoever listens; it may be lost."""
        self._radio.send(self._station, topic, data)

    def is_claimed(self, robot_id: int) -> bool:
        """Whether another station says that it is that robot: none does."""
        return robot_id != self._station and robot_id in self._radio.stations()
