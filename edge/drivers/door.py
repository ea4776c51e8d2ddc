"""Port knocking for the radio's TCP port, so that a flood of connections cannot keep members out.

zenoh's acceptor pauses for 100 ms after each connection that fails its TLS handshake, and keeps
those that never finish it. Twenty connections a second from anyone on the network would therefore
keep all members out. A `Door` attaches a socket filter (classic BPF, in every kernel, without
privileges) to the listening socket, which drops a stranger's SYN in the kernel. The filter affects
no other port, and ends with the program.

The filter admits addresses. To knock, a member sends a signed datagram to the UDP port of the same
number, again and again until it is connected. Its address is then known, as are those of all
connected peers. One in sixteen connections from unknown addresses passes, too, for members that
cannot knock; none does during a flood.
"""

import array
import contextlib
import ctypes
import ipaddress
import os
import resource
import select
import socket
import struct
import time
from collections import deque
from collections.abc import Callable, Iterable
from pathlib import Path
from threading import Event, Thread
from typing import NamedTuple

from edge.core.logger import log
from edge.messages.topics import Knocking

Address = ipaddress.IPv4Address

# A flood begins with this many refused connections within the window. A single member that cannot
# knock is refused about twice a second.
_FLOOD_REFUSED, _FLOOD_WINDOW_S = 8, 1.0
# After a start, all others connect at once and are unknown until they have knocked. Fifty robots
# at two attempts a second stay below this number.
_SETTLE_S, _MOST_AT_START = 2.0, 200
# A flood ends with fewer than this many refused connections within the time.
_CALM_REFUSED, _CALM_S = 30, 10.0
_ADMIT_ONE_IN = 16
_UPDATE_PERIOD_S, _PEERS_PERIOD_S = 0.05, 1.0
# A flood of knocks delays only members whose addresses are not known yet.
_MOST_KNOCKS_HZ = 400.0
_KNOCK_BYTES = 2048
_MOST_USED = 0.8
# The filter jumps from each address to its end, by at most 255 instructions.
_MOST_ADDRESSES = 240

_SO_ATTACH_FILTER, _SO_DETACH_FILTER, _SO_MEMINFO = 26, 27, 55
_DROPS = 8  # index in SO_MEMINFO
_PKTINFO, _PKTINFO_BYTES = 8, 12  # IP_PKTINFO; its last 4 bytes are the destination address
_BACKLOG, _MOST_BACKLOG = 6, 7  # indices of TCP_INFO's 32-bit words, for a listening socket
_SOURCE = 0xFFF00000 + 12  # SKF_NET_OFF + offset of the IPv4 source address
_RANDOM = 0xFFFFF000 + 56  # SKF_AD_OFF + SKF_AD_RANDOM
_FLAGS, _SYN, _ACK = 13, 0x02, 0x10  # in the TCP header, where a socket filter's data begins
_LOAD, _LOAD_BYTE, _AND, _EQUAL, _RETURN = 0x20, 0x30, 0x54, 0x15, 0x06


def allow_most_descriptors() -> None:
    """Raise this process's limit of open files and connections to the system's."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    with contextlib.suppress(OSError, ValueError):  # in a sandbox, where the unit sets the limit
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))


def descriptors_short() -> str:
    """Warning if more than 80 % of this process's file descriptors are in use, else ""."""
    used = sum(1 for _ in Path("/proc/self/fd").iterdir())
    most, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return f"{used} of {most} descriptors are in use" if used > _MOST_USED * most else ""


class DoorStatus(NamedTuple):
    """State of a port; `refused` counts connections, `queue_full` is its queue of new ones."""

    flooded: bool
    refused: int
    queue_full: bool


class Flood:
    """Detects a flood by the number of refused connections."""

    def __init__(self, began_s: float) -> None:
        """`began_s` is when the port was opened; times are by a monotonic clock."""
        self._settled_s = began_s + _SETTLE_S
        self._recent: deque[tuple[float, int]] = deque()
        self._flooded = False

    def update(self, now_s: float, refused: int) -> bool:
        """Add the total number of refused connections; returns whether there is a flood."""
        recent = self._recent
        recent.append((now_s, refused))
        while now_s - recent[0][0] > _CALM_S:
            recent.popleft()
        since_s = max(now_s - _FLOOD_WINDOW_S, self._settled_s)
        lately = refused - next((count for at_s, count in recent if at_s >= since_s), refused)
        is_long = now_s - recent[0][0] > _CALM_S - _FLOOD_WINDOW_S
        is_over = is_long and refused - recent[0][1] < _CALM_REFUSED
        begins = lately >= _FLOOD_REFUSED or (now_s < self._settled_s and refused >= _MOST_AT_START)
        self._flooded = begins or (self._flooded and not is_over)
        return self._flooded


class Door:
    """Filters the connections to a listening socket of this process, in a thread of its own."""

    def __init__(
        self, listening: socket.socket, members: Knocking, peers: Callable[[], Iterable[str]]
    ) -> None:
        """Admit the addresses of members that knock, and those of connected `peers`.

        `listening` is a descriptor of its own, which the door closes. Raises OSError if the UDP
        port of the same number is taken, or if the kernel refuses the filter.
        """
        self._listening = listening
        listening.setblocking(False)
        self._knocks = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._knocks.setsockopt(socket.IPPROTO_IP, _PKTINFO, 1)
        self._knocks.bind(listening.getsockname())
        self._knocks.setblocking(False)
        self._members = members
        self._peers = peers
        # The address seen last is the last key.
        self._known: dict[Address, None] = {}
        self._status = DoorStatus(flooded=False, refused=0, queue_full=False)
        try:
            self._drops_before = _drops(listening)
            self._attach()
        except OSError:
            self._knocks.close()
            raise
        self._flood = Flood(time.monotonic())
        self._end = Event()
        self._thread = Thread(target=self._run, name="door", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop updating the filter, and end the thread."""
        self._end.set()
        self._thread.join(1.0)

    @property
    def status(self) -> DoorStatus:
        """State of the port. Thread-safe."""
        return self._status

    def _run(self) -> None:
        with self._listening, self._knocks:
            while not self._end.is_set():
                try:
                    self._attach()
                    self._watch()
                except Exception as error:
                    # Without updates, the filter would keep new members out: open the port to all.
                    with contextlib.suppress(OSError):
                        self._listening.setsockopt(socket.SOL_SOCKET, _SO_DETACH_FILTER, 0)
                    with contextlib.suppress(Exception):
                        log.error("the radio's port is not watched", exc_info=error)
                    self._end.wait(_CALM_S)

    def _watch(self) -> None:
        peers_due_s, update_due_s, allowed = 0.0, 0.0, _MOST_KNOCKS_HZ
        allowed_at_s = time.monotonic()
        poll = select.poll()
        poll.register(self._knocks, select.POLLIN)
        while not self._end.is_set():
            if allowed < 1.0:
                # Knocks above the rate wait in the kernel's buffer, which drops the excess without
                # cost to this process.
                self._end.wait(_UPDATE_PERIOD_S)
            knocks = bool(poll.poll(1e3 * _UPDATE_PERIOD_S))
            now_s = time.monotonic()
            allowed = min(allowed + _MOST_KNOCKS_HZ * (now_s - allowed_at_s), _MOST_KNOCKS_HZ)
            allowed_at_s = now_s
            if knocks:
                with contextlib.suppress(BlockingIOError):
                    data, place, address = self._receive_knock()
                    allowed -= 1.0
                    if self._members.is_knock(data, place):
                        self._admit([address])
            if now_s >= peers_due_s:
                peers_due_s = now_s + _PEERS_PERIOD_S
                self._admit(self._peers())
            if now_s >= update_due_s:
                update_due_s = now_s + _UPDATE_PERIOD_S
                self._update(now_s)

    def _receive_knock(self) -> tuple[bytes, str, str]:
        """Receive a knock: its data, its destination as address:port, its sender's address."""
        data, [(_, _, info)], _, (address, _) = self._knocks.recvmsg(
            _KNOCK_BYTES, socket.CMSG_SPACE(_PKTINFO_BYTES)
        )
        to = socket.inet_ntoa(info[_PKTINFO_BYTES - 4 : _PKTINFO_BYTES])
        return data, f"{to}:{self._knocks.getsockname()[1]}", address

    def _update(self, now_s: float) -> None:
        was, refused = self._status.flooded, _drops(self._listening) - self._drops_before
        flooded = self._flood.update(now_s, refused)
        self._status = DoorStatus(flooded, refused, _queue_is_full(self._listening))
        if flooded == was:
            return
        self._attach()
        if flooded:
            log.warning("a flood of connections to the radio's port: only members are admitted")
            # Drop the queue: nearly all of it is the flood's, and a member connects again at once.
            with contextlib.suppress(OSError):
                while not self._end.is_set():
                    self._listening.accept()[0].close()
        else:
            log.warning("the flood of connections has ended", refused=refused)

    def _admit(self, addresses: Iterable[str]) -> None:
        new = False
        for address in map(Address, addresses):
            new |= address not in self._known
            self._known.pop(address, None)
            self._known[address] = None
        while len(self._known) > _MOST_ADDRESSES:
            del self._known[next(iter(self._known))]
        if new:
            self._attach()

    def _attach(self) -> None:
        """Attach the filter: admit SYNs of known addresses and of this computer, few of others."""
        known = list(self._known)
        code = [
            # Accepted connections inherit the filter: it passes all but the first SYN.
            (_LOAD_BYTE, 0, 0, _FLAGS),
            (_AND, 0, 0, _SYN | _ACK),
            (_EQUAL, 0, len(known) + 6, _SYN),
            (_LOAD, 0, 0, _SOURCE),
        ]
        code += [(_EQUAL, len(known) + 4 - at, 0, int(each)) for at, each in enumerate(known)]
        code += [
            (_AND, 0, 0, 0xFF000000),
            (_EQUAL, 3, 0, 127 << 24),
            (_LOAD, 0, 0, _RANDOM),
            (_AND, 0, 0, _ADMIT_ONE_IN - 1),
            # In a flood never equal, since the number is smaller.
            (_EQUAL, 0, 1, _ADMIT_ONE_IN if self._status.flooded else 0),
            (_RETURN, 0, 0, 0xFFFFFFFF),
            (_RETURN, 0, 0, 0),
        ]
        text = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *each) for each in code))
        program = struct.pack("HL", len(code), ctypes.addressof(text))
        self._listening.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, program)


def listening_sockets() -> dict[int, socket.socket]:
    """This process's listening IPv4 TCP sockets by inode, each as a new descriptor."""
    found = {}
    for entry in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):
            if not str(entry.readlink()).startswith("socket:"):
                continue
            one = socket.socket(fileno=os.dup(int(entry.name)))
            kind = one.family, one.type & 0xF
            listens = one.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN)
            if kind == (socket.AF_INET, socket.SOCK_STREAM) and listens:
                found[os.fstat(one.fileno()).st_ino] = one
            else:
                one.close()
    return found


def _drops(listening: socket.socket) -> int:
    numbers = array.array("I", listening.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, 36))
    return numbers[_DROPS]


def _queue_is_full(listening: socket.socket) -> bool:
    words = array.array("I", listening.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 32))
    return words[_BACKLOG] >= words[_MOST_BACKLOG]
