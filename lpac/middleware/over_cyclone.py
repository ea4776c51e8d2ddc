"""Adapter for Cyclone DDS, with ROS 2's default quality of service."""

import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from threading import Event, Thread
from typing import Self

from cyclonedds.core import (
    DDSException,
    InstanceState,
    Policy,
    Qos,
    ReadCondition,
    SampleState,
    ViewState,
    WaitSet,
)
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import sequence, uint8
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from edge.core.address import is_loopback
from edge.messages.topics import MESSAGE, TOPICS
from lpac.middleware.kinds import Peer

# Domain ports lie below those of `lpac.sim.ports`, in a block per process: fleets of two
# measurements on one loopback do not discover each other.
_DOMAINS, _PORTS_OF_A_BLOCK = 50, 200
_QOS = Qos(
    Policy.Reliability.Reliable(duration(milliseconds=100)),
    Policy.History.KeepLast(10),
    Policy.Durability.Volatile,
)
_MOST_AT_ONCE = 100
_WAIT_TIMEOUT = duration(milliseconds=200)
# On Wi-Fi, Cyclone DDS discovers by multicast and sends data to each peer, but it does not
# recognise the interface of a network namespace as Wi-Fi.
_WIFI = """<CycloneDDS><Domain><General>
<Interfaces><NetworkInterface address="{address}"/></Interfaces>
<AllowMulticast>spdp</AllowMulticast></General></Domain></CycloneDDS>"""
# The loopback has no multicast: peers are discovered by trying ports.
_LOOPBACK = """<CycloneDDS><Domain><General>
<Interfaces><NetworkInterface address="{address}"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex>
<MaxAutoParticipantIndex>60</MaxAutoParticipantIndex>
<Peers><Peer address="{address}"/></Peers></Discovery></Domain></CycloneDDS>"""


@dataclass
class Bytes(IdlStruct):  # type: ignore[misc]
    """Message as a DDS type."""

    data: sequence[uint8]


class _CyclonePeer:
    def __init__(self, domain: int, config: str, receive: Callable[[bytes], None]) -> None:
        self._receive = receive
        self._domain = Domain(domain, config)
        self._participant = DomainParticipant(domain)
        # All topics of a robot are declared, as on real robots; only MESSAGE is used.
        topics = {
            topic: Topic(self._participant, topic.name, Bytes)
            for topic in TOPICS
            if topic.sender == "robot"
        }
        self._writers = {
            topic: DataWriter(self._participant, named, qos=_QOS) for topic, named in topics.items()
        }
        self._reader = DataReader(self._participant, topics[MESSAGE], qos=_QOS)
        self._closed = Event()
        # A thread instead of a listener: DDS calls listeners with its locks held. `write` would
        # wait for these locks while it holds the GIL, a deadlock.
        self._receiving = Thread(target=self._take, daemon=True)

    def __enter__(self) -> Self:
        self._receiving.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closed.set()
        self._receiving.join()
        # Deleting the last reference announces the end to the others; there is no call for it.
        del self._reader
        self._writers.clear()
        del self._participant
        del self._domain

    def publish(self, data: bytes) -> None:
        try:
            self._writers[MESSAGE].write(Bytes(data))
        except DDSException as error:
            sys.stderr.write(f"write: {error}\n")

    def _take(self) -> None:
        arrivals = WaitSet(self._participant)
        news = SampleState.NotRead | ViewState.Any | InstanceState.Any
        arrivals.attach(ReadCondition(self._reader, news))
        while not self._closed.is_set():
            arrivals.wait(_WAIT_TIMEOUT)
            for sample in self._reader.take(_MOST_AT_ONCE):
                # Otherwise a sample announces the end of a writer.
                if isinstance(sample, Bytes):
                    self._receive(bytes(sample.data))


def open_peer(
    index: int, endpoints: Sequence[str], receive: Callable[[bytes], None]
) -> AbstractContextManager[Peer]:
    """See `OpenPeer`. Robots discover each other on ports chosen by DDS."""
    address = endpoints[index].rpartition(":")[0]
    domain = int(endpoints[0].rpartition(":")[2]) // _PORTS_OF_A_BLOCK % _DOMAINS
    config = _LOOPBACK if is_loopback(address) else _WIFI
    return _CyclonePeer(domain, config.format(address=address), receive)
