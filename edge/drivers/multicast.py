"""Multicast: datagrams by which a robot tells something to all others at once.

On Wi-Fi the access point sends such a frame once, at its slow basic rate and without an
acknowledgement: some are lost, which the policy takes, and ten times as many robots fit into a
channel. Everything else goes over zenoh, to and from the grounds, each of which is connected to all
robots.
"""

import math
import select
import socket
import time
from collections import Counter
from contextlib import suppress
from threading import Event, Lock, Thread
from typing import Self

from edge.core.logger import log
from edge.core.wire import MAX_ROBOT_ID
from edge.drivers.zenoh_link import MAX_CERTIFIED_ID, ZenohLink
from edge.identity.envelope import read_head
from edge.identity.group import (
    Assembly,
    Fragment,
    GroupKey,
    datagrams,
    open_datagram,
)
from edge.identity.replay_window import NO_NUMBER
from edge.messages.admission import Admission
from edge.messages.topics import MESSAGE, Group, GroupKeys, ReceiveCallback, Topic

# Of a hundred robots' messages those of a second, where the kernel allows as much (rmem_max).
_BUFFER_BYTES = 2**19
# How soon it looks whether it is to end; and tries again to join, where there is no network yet.
_WAKES_S, _JOINS_AGAIN_S = 0.25, 0.5
_FORGETS_AFTER_S = 5.0
# An interface that went, or an access point that forgot who listens, takes a membership away. What
# this robot says itself comes back all the same, and is no sign of one.
_REJOINS_AFTER_S = 5.0
_CLOSE_TIMEOUT_S = 1.0
_CLAIMED_FOR_S = 3.0
# A thread that wakes for each datagram finds its caches cold: where more than so many come in a
# second, as of thirty robots, it takes those of such a time together. Where far more come, somebody
# floods the group, and no buffer holds that for as long.
_MANY_HZ, _FLOOD_HZ, _COUNTS_FOR_S, _TOGETHER_S = 100.0, 1000.0, 1.0, 0.1
# By the present and by the former key: whoever claims them all takes no other's place.
_MOST_PLACES = 2 * (MAX_CERTIFIED_ID + 1)


class MulticastLink:
    """A robot's radio: a group for what robots tell each other, and zenoh for the rest.

    Every method may be called from any thread. Close it, or use it as a context manager.
    """

    def __init__(
        self,
        group: Group,
        *,
        robot_id: int | None,
        on_message: ReceiveCallback | None,
        zenoh: ZenohLink,
    ) -> None:
        """Join the group, and stay in it; without a network it joins once there is one.

        `on_message` is told the others' messages; `zenoh` is closed with it. What this link says
        does not come back; with `robot_id` None it only listens.
        """
        self._group = group
        self._robot_id = robot_id
        self._zenoh = zenoh
        self._on_message = on_message
        self._known: GroupKeys | None = None
        self._keys: tuple[GroupKey, ...] = ()
        self._own_start = -1  # Of this program, once it has spoken.
        self._said_as_this_one_s = -math.inf
        # No robot with a certificate has a greater one.
        self._greatest_id = MAX_CERTIFIED_ID if group.is_secret else MAX_ROBOT_ID
        self._admission = Admission(_MOST_PLACES)
        self._lock = Lock()
        self._problems: Counter[str] = Counter()
        self._strangers = 0
        self._sender = _sending()
        self._closed = Event()
        self._hearing = Thread(target=self._hear, name="multicast", daemon=True)
        self._hearing.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def publish(self, topic: Topic, data: bytes) -> None:
        """Send to whoever listens; it may be lost. Raises KeyError for a topic of the ground's."""
        if topic != MESSAGE or self._robot_id is None:
            self._zenoh.publish(topic, data)
            return
        head = read_head(data)
        if head is not None:
            self._own_start = head.number.start
        sending = GroupKey.of(self._group.keys().sending)
        try:
            self._sender.setsockopt(
                socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(self._group.interface)
            )
            for datagram in datagrams(data, sender=self._robot_id, key=sending):
                self._sender.sendto(datagram, (self._group.address, self._group.port))
        except (OSError, ValueError) as error:  # No network, a full queue, or too large a message.
            self._failed("publish", error)

    def is_claimed(self, robot_id: int) -> bool:
        """Whether another session says that it is that robot."""
        said_s = self._said_as_this_one_s
        is_said = robot_id == self._robot_id and time.monotonic() - said_s < _CLAIMED_FOR_S
        return is_said or self._zenoh.is_claimed(robot_id)

    def peers(self) -> int:
        """How many grounds it is connected to."""
        return self._zenoh.peers()

    def refused(self) -> int:
        """How many messages it did not look at: too many at once, too large, or of strangers."""
        return self._zenoh.refused() + self._admission.refused + self._strangers

    def close(self) -> None:
        """Leave the radio, within a second or so; again is no error."""
        self._closed.set()
        self._hearing.join(_CLOSE_TIMEOUT_S)
        self._sender.close()
        self._zenoh.close()

    # Hearing

    def _hear(self) -> None:
        while not self._closed.is_set():
            try:
                with _joined(self._group) as receiver:
                    self._hear_from(receiver)
            except Exception as error:  # No network yet; whatever it is, the next try may hear.
                self._failed("hear the group", error)
                self._closed.wait(_JOINS_AGAIN_S)

    def _hear_from(self, receiver: socket.socket) -> None:
        """Until all have been silent for so long that it may be this membership that is lost."""
        poll = select.poll()
        poll.register(receiver, select.POLLIN)
        heard_at_s = counts_since_s = time.monotonic()
        came, many_come = 0, False
        while not self._closed.is_set() and time.monotonic() - heard_at_s < _REJOINS_AFTER_S:
            if many_come and not poll.poll(0):
                self._closed.wait(_TOGETHER_S)
            with suppress(TimeoutError):
                data = receiver.recv(2048)
                came += 1
                self._follow_keys()
                fragment = open_datagram(data, self._keys)
                if fragment is None or fragment.sender > self._greatest_id:
                    self._strangers += 1
                    continue
                if not self._is_own(fragment):
                    heard_at_s = time.monotonic()
                    if fragment.sender == self._robot_id and not self._group.is_secret:
                        self._said_as_this_one_s = heard_at_s
                    self._take(fragment, heard_at_s)
            counted_s = time.monotonic() - counts_since_s
            if counted_s >= _COUNTS_FOR_S:
                many_come = _MANY_HZ * counted_s < came < _FLOOD_HZ * counted_s
                came, counts_since_s = 0, time.monotonic()

    def _follow_keys(self) -> None:
        """Hear by the keys as they are now; what was told of a sender's key is over with them."""
        keys = self._group.keys()
        if keys != self._known:
            self._known, self._keys = keys, tuple(map(GroupKey.of, keys.receiving))
            self._assembly = Assembly(math.inf if self._group.is_secret else _FORGETS_AFTER_S)

    def _take(self, fragment: Fragment, now_s: float) -> None:
        # Of an envelope of another version only the sender is known.
        is_known = fragment.number != NO_NUMBER
        message = self._assembly.add(fragment, now_s, time.time()) if is_known else fragment.head
        if message is None or self._on_message is None:
            return
        key = f"robot/{fragment.sender}/{MESSAGE.name}"
        # Who has a former key alone takes nothing from those who have the present one.
        share = f"{fragment.key}/{key}"
        if not self._admission.admits(MESSAGE, share, len(message), now_s):
            return
        try:
            is_theirs = self._on_message(key, message)
        except Exception as error:
            self._failed("callback", error)
            return
        if is_theirs is not False:
            self._assembly.confirm(fragment, now_s)

    def _is_own(self, fragment: Fragment) -> bool:
        """Whether it comes back, or a stranger says it again, even from before this program began.

        Of two members with one id the other hears this one, which began later.
        """
        start = fragment.number.start
        is_start = start <= self._own_start if self._group.is_secret else start == self._own_start
        return fragment.sender == self._robot_id and is_start

    def _failed(self, what: str, error: Exception) -> None:
        with self._lock:
            self._problems[what] += 1
            first = self._problems[what] == 1
        if first:
            log.error("link failure", exc_info=error, what=what)


def _sending() -> socket.socket:
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sender.setblocking(False)
    sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 1)
    # A simulated fleet's other robots are on this computer.
    sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 1)
    return sender


def _joined(group: Group) -> socket.socket:
    """Raises OSError where there is no such network now."""
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
        # To the group's own address, so that nothing else comes in.
        receiver.bind((group.address, group.port))
        membership = socket.inet_aton(group.address) + socket.inet_aton(group.interface)
        receiver.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
        receiver.settimeout(_WAKES_S)
    except OSError:
        receiver.close()
        raise
    return receiver
