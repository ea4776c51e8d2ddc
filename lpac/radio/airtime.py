"""Model of a Wi-Fi channel: airtime, loss and delay of a fleet's messages.

docs/network.md has its results, and a comparison with emulated Wi-Fi. All stations share one
channel and one access point, and hear each other:

- `mesh`: each robot has a TLS connection to each other station. A message crosses the air twice for
  each receiver, station -> access point -> station, and so does TCP's acknowledgement.
- `multicast`: a robot's message to the others goes up once, acknowledged and at the data rate, like
  all that a station sends. It goes down once for all, at the multicast rate and unacknowledged.
  Messages to and from the ground use one TLS connection per robot.

A transmission consists of DIFS, backoff, preamble, data, SIFS and acknowledgement. Packets to one
station form one A-MPDU. All packets of a robot go to the access point, so they form one too.
Idle slots and collisions per successful transmission follow Bianchi, "Performance Analysis of the
IEEE 802.11 Distributed Coordination Function" (IEEE JSAC 18(3), 2000). The number of contenders is
that of stations waiting in a queue at this load.
"""

import bisect
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType
from typing import Annotated, Literal, NamedTuple, get_args

from msgspec import Meta

from edge.core.schema import AtLeastOne, Bounded, NonNegative, Positive, require
from edge.core.wire import PayloadType
from edge.identity.envelope import HEAD_BYTES
from edge.identity.group import DATAGRAM_BYTES, PART_BYTES, frames
from edge.messages.topics import EXPLORED, MESSAGE, STATE, STATUS

# Transport of messages between robots, in fleets and in the model.
Transport = Literal["mesh", "multicast"]
TRANSPORTS: tuple[Transport, ...] = get_args(Transport)

# OFDM PHY at 5 GHz (IEEE 802.11-2020, 17.4.4).
_SLOT_US, _SIFS_US, _DIFS_US = 9.0, 16.0, 34.0
# Mixed-mode preamble of 802.11n and later, and legacy preamble, which multicast frames have.
_PREAMBLE_US, _LEGACY_PREAMBLE_US = 40.0, 20.0
# A compressed block acknowledgement: the legacy preamble, and 32 bytes at 24 Mbit/s.
_ACK_US = 32.0
_LEAST_WINDOW, _DOUBLINGS = 16, 6
# Attempts at a frame before a station gives up.
_ATTEMPTS = 8
# Half of the standard's limits for an A-MPDU, 64 frames and 5.484 ms: a queue is seldom full.
_MOST_FRAMES, _LONGEST_US = 32.0, 2500.0
# QoS header 26, LLC and SNAP 8, CCMP 16, checksum 4; delimiters of an A-MPDU are left out.
_MAC_BYTES = 54
_IP_BYTES, _UDP_BYTES, _MTU_BYTES = 20, 8, 1500
# With timestamps, the default of Linux.
_TCP_IP_BYTES = 52
# Counted on a connection of two zenoh 1.x sessions, with declared keys.
_ZENOH_BYTES = 27
# TLS 1.3: a record's header 5, its type 1, its authentication tag 16.
_TLS_BYTES = 22
# TCP acknowledges every second full segment, and the rest within 40 ms. At 2.5 messages a second,
# no acknowledgement can ride on a message in the other direction.
_SEGMENTS_PER_ACK = 2.0

# Sizes in an envelope (`edge.identity.envelope`): means over simulated flights of the field policy.
# A message with its beacon, with ten robots; with 30 in one world it is a tenth larger.
MESSAGE_BYTES: Mapping[PayloadType, float] = MappingProxyType(
    {"float32": 2576.0, "float16": 1786.0, "int8": 1206.0}
)
EXPLORED_BYTES = 150.0


def status_bytes(robots: float) -> float:
    """Mean size of a RobotStatus where each of `robots` robots hears all others."""
    return 1110.0 + 10.0 * robots


def state_bytes(robots: float) -> float:
    """Size of a GroundState for `robots` robots, with an echo of each, at most 32."""
    return 342.0 + 24.0 * min(robots, 32.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Wifi(Bounded):
    """One channel and its access point.

    `data_rate_mbit_s` is the rate of frames to one receiver, `multicast_rate_mbit_s` the access
    point's rate to a group. `frame_loss` is the probability that one transmission of one frame is
    lost for reasons other than collisions. `queue_s` is the waiting time in full queues.
    `ground_wired`: the ground is wired to the access point; else it is one more station.

    The defaults are the assumptions of docs/network.md.

    Raises ValueError that names an impossible value.
    """

    data_rate_mbit_s: Positive = 220.0
    multicast_rate_mbit_s: Positive = 6.0
    frame_loss: Annotated[float, Meta(ge=0.0, lt=1.0)] = 0.05
    queue_s: NonNegative = 0.3
    ground_wired: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class Traffic(Bounded):
    """Traffic of a fleet in flight; sizes are those of sealed messages, before any framing.

    `message_bytes` and `message_hz` are of a robot's messages to its neighbours, `status_hz` of its
    statuses to the ground. Orders and worlds are left out, since they are rare.

    Raises ValueError that names an impossible value.
    """

    robots: AtLeastOne
    message_bytes: Positive = MESSAGE_BYTES["float16"]
    message_hz: NonNegative = MESSAGE.rate_hz
    status_hz: NonNegative = STATUS.rate_hz


@dataclass(frozen=True, slots=True)
class Airtime:
    """Share of the channel's time that the traffic needs; the channel is overloaded above 1.

    `shares` are by topic, with the idle slots and gaps of contention. `busy` is the share without
    them, as radios count it. `message_s` is the airtime of one robot's message to all its receivers
    with acknowledgements, `contenders` the mean number of stations that want to send at once, and
    `collision` the probability that a transmission collides.
    """

    shares: Mapping[str, float]
    busy: float
    message_s: float
    contenders: float
    collision: float

    @property
    def total(self) -> float:
        """Sum over all topics."""
        return math.fsum(self.shares.values())


class LinkQuality(NamedTuple):
    """Loss probability and mean delay, s, of a message from one robot to another."""

    loss: float
    delay_s: float

    @property
    def in_words(self) -> str:
        """A line of a report."""
        return (
            f"by the model {100.0 * self.loss:.3g} % of messages are lost, and the others travel "
            f"for {1e3 * self.delay_s:.3g} ms on average"
        )


def airtime(transport: Transport, wifi: Wifi, traffic: Traffic) -> Airtime:
    """Airtime of the fleet's traffic.

    Raises ValueError for another transport.
    """
    require(Transport, transport, "transport")
    return _airtime(transport, wifi, traffic, traffic.robots)


def capacity(
    transport: Transport,
    wifi: Wifi,
    traffic: Traffic,
    *,
    most: float = 0.6,
    most_robots: int = 10_000,
) -> int:
    """Greatest number of robots, up to `most_robots`, whose total airtime is at most `most`.

    Ignores `traffic.robots`. Raises ValueError for another transport, and unless `most` is finite
    and above 0.
    """
    require(Transport, transport, "transport")
    require(Positive, most, "most")

    def total(robots: int) -> float:
        return _airtime(transport, wifi, traffic, robots).total

    return bisect.bisect_right(range(1, most_robots + 1), most, key=total)


def link_quality(transport: Transport, wifi: Wifi, traffic: Traffic) -> LinkQuality:
    """Loss and delay of a robot's message to another, as for `lpac.sim.medium.Medium`.

    The wait is that of an M/D/1 queue (Pollaczek and Khinchine), in which a job is one message to
    all its receivers. In a mesh, messages that wait for one receiver are aggregated, which takes
    less time. So a channel that `airtime` finds full may still carry all messages, late. If it
    cannot, messages wait `Wifi.queue_s`, and the excess is dropped, each with the same probability.
    Multicast aggregates nothing, and loses frames by noise and collisions; a mesh repeats them, at
    the cost of time only.

    Raises ValueError for another transport.
    """
    require(Transport, transport, "transport")
    wait_s, load = _queue(transport, wifi, traffic)
    delivery = min(1.0, 1.0 / load.total)
    if transport == "multicast":
        frames = _datagrams(traffic.message_bytes).number
        delivery *= ((1.0 - wifi.frame_loss) * (1.0 - load.collision)) ** frames
    # Copies in a mesh arrive one after another, in multicast all at once.
    sending_s = load.message_s * (1.0 if transport == "multicast" else 0.5)
    return LinkQuality(1.0 - delivery, wait_s + min(sending_s, wifi.queue_s))


def noise_loss(transport: Transport, wifi: Wifi, message_bytes: float) -> float:
    """Share of messages lost to noise on a free channel: none in a mesh, which repeats frames."""
    if transport != "multicast":
        return 0.0
    delivered: float = (1.0 - wifi.frame_loss) ** _datagrams(message_bytes).number
    return 1.0 - delivered


def _queue(transport: Transport, wifi: Wifi, traffic: Traffic) -> tuple[float, Airtime]:
    """Mean wait of messages, s, and their airtime with aggregation of those that wait."""
    robots = traffic.robots
    if transport == "multicast":
        load = _airtime(transport, wifi, traffic, robots)
        if not load.message_s:
            return 0.0, load
        return min(load.message_s * _mean_wait(load.total), wifi.queue_s), load
    # Arrival rate of messages in the queue for one station.
    message = _flows(traffic, robots)[0]
    arrivals_hz = message.senders * message.rate_hz * message.robots / robots

    def load_after(wait_s: float) -> Airtime:
        return _airtime(transport, wifi, traffic, robots, 1.0 + arrivals_hz * wait_s)

    # Bisection: a longer wait aggregates more messages, which shortens the wait.
    low_s, high_s = 0.0, wifi.queue_s
    for _ in range(30):
        wait_s = (low_s + high_s) / 2.0
        load = load_after(wait_s)
        if load.message_s * _mean_wait(load.total) > wait_s:
            low_s = wait_s
        else:
            high_s = wait_s
    return high_s, load_after(high_s)


def _mean_wait(load: float) -> float:
    """Mean wait in an M/D/1 queue, in service times."""
    return load / (2.0 * (1.0 - load)) if load < 1.0 else math.inf


class _Packets(NamedTuple):
    """Number and mean size of IP packets."""

    number: float
    mean_bytes: float


_TCP_ACK = _Packets(1.0, _TCP_IP_BYTES)


def _segments(payload_bytes: float) -> _Packets:
    """Packets of a message over TLS and TCP."""
    total_bytes = payload_bytes + _ZENOH_BYTES + _TLS_BYTES
    count = math.ceil(total_bytes / (_MTU_BYTES - _TCP_IP_BYTES))
    return _Packets(count, total_bytes / count + _TCP_IP_BYTES)


def _datagrams(payload_bytes: float) -> _Packets:
    """Packets of a message in a multicast group."""
    count = frames(payload_bytes)
    header_bytes = DATAGRAM_BYTES - PART_BYTES + _UDP_BYTES + _IP_BYTES
    return _Packets(count, (payload_bytes - HEAD_BYTES) / count + header_bytes)


class _Contention(NamedTuple):
    """Idle slots and collisions per successful transmission; probability of a collision."""

    idle_slots: float
    collisions: float
    collision: float


@lru_cache(maxsize=4096)
def _contention(contenders: float) -> _Contention:
    """Bianchi's model of at least one station, each of which always has something to send."""
    low, high = 0.0, 1.0
    # Bisection for the collision probability at the model's fixed point.
    for _ in range(50):
        collision = (low + high) / 2.0
        sends = _sends(collision)
        if 1.0 - (1.0 - sends) ** (contenders - 1.0) > collision:
            low = collision
        else:
            high = collision
    collision = low
    sends = _sends(collision)
    busy = 1.0 - (1.0 - sends) ** contenders
    success = contenders * sends * (1.0 - sends) ** (contenders - 1.0)
    return _Contention((1.0 - busy) / success, busy / success - 1.0, collision)


def _sends(collision: float) -> float:
    """Probability that a station sends in a slot: Bianchi's equation 7, without its pole."""
    doubled = math.fsum((2.0 * collision) ** stage for stage in range(_DOUBLINGS))
    return 2.0 / (1.0 + _LEAST_WINDOW + collision * _LEAST_WINDOW * doubled)


class _Use(NamedTuple):
    """Channel time, us or shares, of what stations send (`up`) and the access point (`down`)."""

    up: float = 0.0
    down: float = 0.0

    @property
    def total(self) -> float:
        return self.up + self.down

    def plus(self, other: "_Use") -> "_Use":
        return _Use(self.up + other.up, self.down + other.down)

    def times(self, factor: float) -> "_Use":
        return _Use(factor * self.up, factor * self.down)


class _Channel:
    """Durations of transmissions on a channel with `contenders` stations that want to send.

    `aggregated` messages to one receiver form one A-MPDU. Without `gaps`, idle time is left out.
    """

    def __init__(
        self, wifi: Wifi, contenders: float = 1.0, aggregated: float = 1.0, *, gaps: bool = True
    ) -> None:
        self._wifi = wifi
        self._contention = _contention(contenders)
        self._aggregated = aggregated
        self._gaps = gaps

    @property
    def collision(self) -> float:
        """Probability that a transmission collides."""
        return self._contention.collision

    def from_station(self, packets: _Packets, copies: float) -> _Use:
        """Copies from one station to the access point, for any receivers."""
        return _Use(up=self._unicast_us(packets, copies) if copies else 0.0)

    def to_stations(self, packets: _Packets, copies: float) -> _Use:
        """Copies from the access point, each to another station."""
        return _Use(down=copies * self._unicast_us(packets, self._aggregated) / self._aggregated)

    def from_stations(self, packets: _Packets, copies: float) -> _Use:
        """Copies to the access point, each from another station."""
        return _Use(up=copies * self._unicast_us(packets, self._aggregated) / self._aggregated)

    def to_group(self, packets: _Packets) -> _Use:
        """Multicast from the access point, frame by frame, without acknowledgement."""
        data_us = _data_us(packets.mean_bytes, self._wifi.multicast_rate_mbit_s)
        return _Use(down=packets.number * self._exchange_us(_LEGACY_PREAMBLE_US + data_us))

    def _unicast_us(self, packets: _Packets, copies: float) -> float:
        """Duration of acknowledged transmissions with retries."""
        count = copies * packets.number
        frame_us = _data_us(packets.mean_bytes, self._wifi.data_rate_mbit_s)
        turns = max(1.0, count / _MOST_FRAMES, count * frame_us / _LONGEST_US)
        frames, loss = count / turns, self._wifi.frame_loss
        attempts = (1.0 - loss**_ATTEMPTS) / (1.0 - loss)
        # A turn is repeated with its missing frames until none is missing. Where more messages
        # wait, the missing frames go with them.
        rounds = math.fsum(1.0 - (1.0 - loss**n) ** frames for n in range(_ATTEMPTS))
        rounds = attempts + (rounds - attempts) / self._aggregated
        data_us = frames * attempts * frame_us / rounds
        return turns * rounds * self._exchange_us(_PREAMBLE_US + data_us + _ACK_US, _SIFS_US)

    def _exchange_us(self, sent_us: float, gap_us: float = 0.0) -> float:
        """Duration of an exchange with its contention. A collision lasts as long as an exchange."""
        idle_slots, collisions, _ = self._contention
        if not self._gaps:
            return (1.0 + collisions) * sent_us
        return idle_slots * _SLOT_US + (1.0 + collisions) * (_DIFS_US + sent_us + gap_us)


def _data_us(packet_bytes: float, rate_mbit_s: float) -> float:
    return 8.0 * (packet_bytes + _MAC_BYTES) / rate_mbit_s


class _Flow(NamedTuple):
    """Messages of `senders` on a topic, each to `robots` robots, and perhaps to the ground."""

    topic: str
    source: Literal["robot", "ground"]
    senders: float
    rate_hz: float
    payload_bytes: float
    robots: float
    to_ground: bool = False


def _flows(traffic: Traffic, robots: int) -> tuple[_Flow, ...]:
    others = robots - 1.0
    size, hz = traffic.message_bytes, traffic.message_hz
    return (
        _Flow("message", "robot", robots, hz, size, others),
        _Flow("status", "robot", robots, traffic.status_hz, status_bytes(robots), 0.0, True),
        _Flow("explored", "robot", robots, EXPLORED.rate_hz, EXPLORED_BYTES, 0.0, True),
        _Flow("state", "ground", 1.0, STATE.rate_hz, state_bytes(robots), robots),
    )


def _airtime(
    transport: Transport, wifi: Wifi, traffic: Traffic, robots: int, aggregated: float = 1.0
) -> Airtime:
    flows = _flows(traffic, robots)
    stations = robots + (1.0 if wifi.ground_wired else 2.0)
    uncontended = _Channel(wifi, 1.0, aggregated)
    uses = [_share(transport, wifi, uncontended, flow) for flow in flows]
    contenders = _contenders(uses, stations)
    channel = _Channel(wifi, contenders, aggregated)
    shares = {flow.topic: _share(transport, wifi, channel, flow).total for flow in flows}
    sending = _Channel(wifi, contenders, aggregated, gaps=False)
    busy = math.fsum(_share(transport, wifi, sending, flow).total for flow in flows)
    message_s = 1e-6 * _message_us(transport, wifi, channel, flows[0]).total
    return Airtime(MappingProxyType(shares), busy, message_s, contenders, channel.collision)


def _contenders(shares: Sequence[_Use], stations: float) -> float:
    """Mean number of contenders for a transmission, from the flows' uncontended shares.

    While the channel is busy, the access point is one contender, however much it has to send. A
    waiting station waits for the rest of a transmission, half of one on average, and then contends
    with the others and the access point. By Little's law, the number that waits is the number that
    arrives during a wait.
    """
    up, total = math.fsum(use.up for use in shares), math.fsum(use.total for use in shares)
    if up >= 1.0:
        return stations
    return min(stations, 1.0 + 1.5 * min(total, 1.0) * up / (1.0 - up))


def _share(transport: Transport, wifi: Wifi, channel: _Channel, flow: _Flow) -> _Use:
    rate_hz = flow.senders * flow.rate_hz
    return _message_us(transport, wifi, channel, flow).times(1e-6 * rate_hz)


def _message_us(transport: Transport, wifi: Wifi, channel: _Channel, flow: _Flow) -> _Use:
    """Airtime of one message of a flow to all its receivers."""
    if transport == "multicast" and flow.robots and flow.source != "ground":
        in_group = _multicast_us(wifi, channel, flow)
        if not flow.to_ground:
            return in_group
        return in_group.plus(_message_us(transport, wifi, channel, flow._replace(robots=0.0)))
    from_air = flow.source == "robot" or (flow.source == "ground" and not wifi.ground_wired)
    ground_on_air = flow.to_ground and not wifi.ground_wired
    on_air = flow.robots + (1.0 if ground_on_air else 0.0)
    on_wire = 1.0 if flow.to_ground and wifi.ground_wired else 0.0
    up = on_air + on_wire if from_air else 0.0
    return _connections_us(channel, _segments(flow.payload_bytes), up=up, down=on_air)


def _connections_us(channel: _Channel, segments: _Packets, *, up: float, down: float) -> _Use:
    """Copies from one sender, `up` to the access point and `down` from it, and their TCP acks."""
    acks = max(1.0, segments.number / _SEGMENTS_PER_ACK)
    return (
        channel.from_station(segments, up)
        .plus(channel.to_stations(segments, down))
        .plus(channel.from_stations(_TCP_ACK, acks * down))
        .plus(channel.to_stations(_TCP_ACK, acks * up))
    )


def _multicast_us(wifi: Wifi, channel: _Channel, flow: _Flow) -> _Use:
    datagrams = _datagrams(flow.payload_bytes)
    up = channel.from_station(datagrams, 1.0 if flow.source == "robot" else 0.0)
    return up.plus(channel.to_group(datagrams))
