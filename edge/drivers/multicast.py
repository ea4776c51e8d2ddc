"""Multicast link: robots exchange their messages in a multicast group, all else goes over zenoh.

On Wi-Fi the access point sends a multicast frame once, at its slow basic rate and without
acknowledgement. Some frames are lost, which the policy tolerates, and ten times as many robots fit
into a channel. The zenoh connections are those between each ground and each robot.
"""

import math
import select
import socket
import time
from contextlib import suppress
from threading import Event, Thread
from typing import Self

from edge.core.wire import MAX_ROBOT_ID
from edge.drivers.zenoh_link import MAX_CERTIFIED_ID, ZenohLink
from edge.identity.envelope import read_head
from edge.identity.group import Assembly, Fragment, GroupKey, datagrams, open_datagram
from edge.identity.replay_window import NO_NUMBER
from edge.messages.admission import Admission
from edge.messages.topics import MESSAGE, Group, GroupKeys, ReceiveCallback, Topic

# One second of messages of a hundred robots, if the kernel allows it (rmem_max).
_BUFFER_BYTES = 2**19
_RECEIVE_TIMEOUT_S, _JOIN_RETRY_S = 0.25, 0.5
# Without keys, a sender silent for this long may have restarted with an earlier clock.
_FORGET_SENDER_S = 5.0
# A membership ends unnoticed when the interface goes down or the access point forgets it. The
# robot's own datagrams still loop back then.
_REJOIN_AFTER_S = 5.0
_CLOSE_TIMEOUT_S = 1.0
_CLAIMED_FOR_S = 3.0
# A thread that wakes for each datagram runs with cold caches. At a rate above _BATCH_HZ, as of
# thirty robots, it reads the datagrams of _BATCH_S together. Above _FLOOD_HZ it does not wait,
# since the buffer would overflow.
_BATCH_HZ, _FLOOD_HZ, _RATE_WINDOW_S, _BATCH_S = 100.0, 1000.0, 1.0, 0.1
# One budget for each robot id and each of two keys, so that a member that claims all ids takes no
# other's budget.
_MOST_BUDGETS = 2 * (MAX_CERTIFIED_ID + 1)


class MulticastLink:
    """A robot's radio: a multicast group for robots' messages, and zenoh for all other topics.

    Thread-safe. Close it, or use it as a context manager.
    """

    def __init__(
        self,
        group: Group,
        *,
        robot_id: int | None,
        on_message: ReceiveCallback | None,
        zenoh: ZenohLink,
    ) -> None:
        """Join the group and stay in it; without a network, join once there is one.

        `on_message` gets the others' messages, never this link's own. With `robot_id` None the link
        only receives. Closing it closes `zenoh`, too.
        """
        self._group = group
        self._robot_id = robot_id
        self._zenoh = zenoh
        self._on_message = on_message
        self._known: GroupKeys | None = None
        self._keys: tuple[GroupKey, ...] = ()
        self._own_start = -1  # this program's, from its first message on
        self._claimed_at_s = -math.inf
        self._greatest_id = MAX_CERTIFIED_ID if group.is_secret else MAX_ROBOT_ID
        self._admission = Admission(_MOST_BUDGETS)
        self._strangers = 0
        self._sender = _sender()
        self._closed = Event()
        self._receiving = Thread(target=self._receive_until_closed, name="multicast", daemon=True)
        self._receiving.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def publish(self, topic: Topic, data: bytes) -> None:
        """Send a message, which may be lost. Raises KeyError for a topic of the ground."""
        if topic != MESSAGE or self._robot_id is None:
            self._zenoh.publish(topic, data)
            return
        head = read_head(data)
        if head is not None:
            self._own_start = head.number.start
        key = GroupKey.of(self._group.keys().sending)
        try:
            self._sender.setsockopt(
                socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(self._group.interface)
            )
            for datagram in datagrams(data, sender=self._robot_id, key=key):
                self._sender.sendto(datagram, (self._group.address, self._group.port))
        except (OSError, ValueError) as error:  # no network, a full queue, or too large a message
            self._zenoh.report_failure("publish", error)

    def is_claimed(self, robot_id: int) -> bool:
        """Whether another program uses that robot id."""
        claimed = time.monotonic() - self._claimed_at_s < _CLAIMED_FOR_S
        return (claimed and robot_id == self._robot_id) or self._zenoh.is_claimed(robot_id)

    def peers(self) -> int:
        """Number of connected grounds."""
        return self._zenoh.peers()

    def refused(self) -> int:
        """Number of messages dropped unread: above the rate, too large, or of non-members."""
        return self._zenoh.refused() + self._admission.refused + self._strangers

    def close(self) -> None:
        """Close the link, within about a second. May be repeated."""
        self._closed.set()
        self._receiving.join(_CLOSE_TIMEOUT_S)
        self._sender.close()
        self._zenoh.close()

    def _receive_until_closed(self) -> None:
        while not self._closed.is_set():
            try:
                with _receiver(self._group) as receiver:
                    self._receive(receiver)
            except Exception as error:  # no network yet, or anything else: try again
                self._zenoh.report_failure("receive from the group", error)
                self._closed.wait(_JOIN_RETRY_S)

    def _receive(self, receiver: socket.socket) -> None:
        """Receive until no other member has sent for so long that the membership may be lost."""
        poll = select.poll()
        poll.register(receiver, select.POLLIN)
        received_at_s = window_began_s = time.monotonic()
        count, in_batches = 0, False
        while not self._closed.is_set() and time.monotonic() - received_at_s < _REJOIN_AFTER_S:
            if in_batches and not poll.poll(0):
                self._closed.wait(_BATCH_S)
            with suppress(TimeoutError):
                data = receiver.recv(2048)
                count += 1
                self._update_keys()
                fragment = open_datagram(data, self._keys)
                if fragment is None or fragment.sender > self._greatest_id:
                    self._strangers += 1
                    continue
                if not self._is_own(fragment):
                    received_at_s = time.monotonic()
                    if fragment.sender == self._robot_id and not self._group.is_secret:
                        self._claimed_at_s = received_at_s
                    self._receive_fragment(fragment, received_at_s)
            window_s = time.monotonic() - window_began_s
            if window_s >= _RATE_WINDOW_S:
                in_batches = _BATCH_HZ * window_s < count < _FLOOD_HZ * window_s
                count, window_began_s = 0, time.monotonic()

    def _update_keys(self) -> None:
        keys = self._group.keys()
        if keys != self._known:
            self._known, self._keys = keys, tuple(map(GroupKey.of, keys.receiving))
            # The old assembly refers to keys by their places in the old list.
            self._assembly = Assembly(math.inf if self._group.is_secret else _FORGET_SENDER_S)

    def _receive_fragment(self, fragment: Fragment, now_s: float) -> None:
        # An envelope of another version reveals only its sender.
        is_known = fragment.number != NO_NUMBER
        message = self._assembly.add(fragment, now_s, time.time()) if is_known else fragment.head
        if message is None or self._on_message is None:
            return
        key = f"robot/{fragment.sender}/{MESSAGE.name}"
        # A sender that has only the former key must not use up the budget of the present key.
        budget = f"{fragment.key}/{key}"
        if not self._admission.admits(MESSAGE, budget, len(message), now_s):
            return
        try:
            is_authentic = self._on_message(key, message)
        except Exception as error:
            self._zenoh.report_failure("callback", error)
            return
        if is_authentic is not False:
            self._assembly.confirm(fragment, now_s)

    def _is_own(self, fragment: Fragment) -> bool:
        """Whether it is this robot's own: looped back, or replayed, even from an earlier start.

        If two members share an id, the one that started earlier receives the other's messages.
        """
        start = fragment.number.start
        is_start = start <= self._own_start if self._group.is_secret else start == self._own_start
        return fragment.sender == self._robot_id and is_start


def _sender() -> socket.socket:
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sender.setblocking(False)
    sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 1)
    # The other robots of a simulated fleet are on this computer.
    sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 1)
    return sender


def _receiver(group: Group) -> socket.socket:
    """A socket that has joined the group. Raises OSError without a network."""
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
        # Bound to the group's address, so that it receives no other datagrams.
        receiver.bind((group.address, group.port))
        membership = socket.inet_aton(group.address) + socket.inet_aton(group.interface)
        receiver.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
        receiver.settimeout(_RECEIVE_TIMEOUT_S)
    except OSError:
        receiver.close()
        raise
    return receiver
