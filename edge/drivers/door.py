"""Guard of the radio's TCP port: members get in, strangers seldom, and in a flood not at all.

zenoh's acceptor pauses for 100 ms after each connection that fails its TLS handshake, and keeps
those that never finish it: twenty a second from anybody on the network would keep all members out.
The kernel's socket filter (classic BPF, in every kernel, needs no privilege) drops a stranger's SYN
before anything comes of it. It belongs to the listening socket alone: it ends with the program, and
touches no other port.

A member is known by its address, once it has knocked: it sends a signed datagram to the UDP port of
the same number (`knock`, until it is connected), as does everybody who is connected. Of strangers'
connections one in sixteen gets in, for members that cannot knock, unless too many come.
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

# So many refused within a second are a flood; one member that cannot knock calls twice.
_MANY, _WITHIN_S = 8, 1.0
# After a start all others call at once, and are strangers until they have knocked: fifty of them,
# twice a second each, are fewer than that.
_SETTLES_S, _MOST_AT_START = 2.0, 200
# It is over once so few came for so long.
_FEW, _CALM_S = 30, 10.0
_ONE_IN = 16
_LOOKS_S, _LEARNS_S = 0.05, 1.0
# Of those who knock, a second; whoever floods that as well delays only who is not known yet.
_MOST_KNOCKS_HZ = 400.0
_KNOCK_BYTES = 2048
_MOST_USED = 0.8
# The filter jumps to its end from each address, by 8 bits.
_MOST_ADDRESSES = 240

_SO_ATTACH_FILTER, _SO_DETACH_FILTER, _SO_MEMINFO = 26, 27, 55
_DROPS = 8  # of SO_MEMINFO's numbers
_PKTINFO, _PKTINFO_BYTES = 8, 12  # IP_PKTINFO, which ends with the address that a datagram was for
_BACKLOG, _MOST_BACKLOG = 6, 7  # of TCP_INFO's 32-bit words, for a socket that listens
_SOURCE = 0xFFF00000 + 12  # SKF_NET_OFF; behind it, the source address of IPv4
_RANDOM = 0xFFFFF000 + 56  # SKF_AD_OFF + SKF_AD_RANDOM
_FLAGS, _SYN, _ACK = 13, 0x02, 0x10  # of the TCP header, at which a socket's filter begins
_LOAD, _LOAD_BYTE, _AND, _EQUAL, _RETURN = 0x20, 0x30, 0x54, 0x15, 0x06


def allow_most_descriptors() -> None:
    """Let this program open as many files and connections as the system lets it."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    with contextlib.suppress(OSError, ValueError):  # In a sandbox, where its unit says how many.
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))


def descriptors_short() -> str:
    """Warning that nearly all file descriptors of this process are in use; "" if not."""
    used = sum(1 for _ in Path("/proc/self/fd").iterdir())
    most, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return f"{used} of {most} descriptors are in use" if used > _MOST_USED * most else ""


class DoorStatus(NamedTuple):
    """Whether it is flooded, how many connections it has refused, whether its queue is full."""

    flooded: bool
    refused: int
    queue_full: bool


class Flood:
    """Whether strangers flood a port that is open since `began_s`, by how many were refused."""

    def __init__(self, began_s: float) -> None:
        """Times are a monotonic clock's."""
        self._settled_s = began_s + _SETTLES_S
        self._recent: deque[tuple[float, int]] = deque()
        self._flooded = False

    def look(self, now_s: float, refused: int) -> bool:
        """So many were refused until now: whether it is flooded."""
        recent = self._recent
        recent.append((now_s, refused))
        while now_s - recent[0][0] > _CALM_S:
            recent.popleft()
        since_s = max(now_s - _WITHIN_S, self._settled_s)
        lately = refused - next((count for at_s, count in recent if at_s >= since_s), refused)
        is_long = now_s - recent[0][0] > _CALM_S - _WITHIN_S
        is_over = is_long and refused - recent[0][1] < _FEW
        begins = lately >= _MANY or (now_s < self._settled_s and refused >= _MOST_AT_START)
        self._flooded = begins or (self._flooded and not is_over)
        return self._flooded


class Door:
    """Watches a socket of this process that listens, in a thread of its own."""

    def __init__(
        self, listening: socket.socket, members: Knocking, met: Callable[[], Iterable[str]]
    ) -> None:
        """Whoever knocks as one of `members` gets in, and whoever is among `met`.

        It closes `listening`, which is a descriptor of its own. Raises OSError if the UDP port of
        that number is taken, or the kernel has no such filter.
        """
        self._listening = listening
        listening.setblocking(False)
        self._knocks = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._knocks.setsockopt(socket.IPPROTO_IP, _PKTINFO, 1)
        self._knocks.bind(listening.getsockname())
        self._knocks.setblocking(False)
        self._members = members
        self._met = met
        # The last that was heard of is the last.
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
        """Stop watching."""
        self._end.set()
        self._thread.join(1.0)

    @property
    def status(self) -> DoorStatus:
        """From any thread."""
        return self._status

    def _run(self) -> None:
        with self._listening, self._knocks:
            while not self._end.is_set():
                try:
                    self._attach()
                    self._watch()
                except Exception as error:
                    # Unwatched, it would learn of no member any more: better open to all.
                    with contextlib.suppress(OSError):
                        self._listening.setsockopt(socket.SOL_SOCKET, _SO_DETACH_FILTER, 0)
                    with contextlib.suppress(Exception):
                        log.error("the radio's port is not watched", exc_info=error)
                    self._end.wait(_CALM_S)

    def _watch(self) -> None:
        learns_s, looks_s, allowed = 0.0, 0.0, _MOST_KNOCKS_HZ
        counted_s = time.monotonic()
        poll = select.poll()
        poll.register(self._knocks, select.POLLIN)
        while not self._end.is_set():
            if allowed < 1.0:
                # Those beyond the rate stay in the kernel's buffer, which drops what it cannot
                # hold at no cost here.
                self._end.wait(_LOOKS_S)
            knocks = bool(poll.poll(1e3 * _LOOKS_S))
            now_s = time.monotonic()
            allowed = min(allowed + _MOST_KNOCKS_HZ * (now_s - counted_s), _MOST_KNOCKS_HZ)
            counted_s = now_s
            if knocks:
                with contextlib.suppress(BlockingIOError):
                    data, place, address = self._next_knock()
                    allowed -= 1.0
                    if self._members.is_knock(data, place):
                        self._let_in([address])
            if now_s >= learns_s:
                learns_s = now_s + _LEARNS_S
                self._let_in(self._met())
            if now_s < looks_s:
                continue
            looks_s = now_s + _LOOKS_S
            self._look(now_s)

    def _next_knock(self) -> tuple[bytes, str, str]:
        """Receive a knock: its data, its destination's address:port, and its sender's address."""
        data, [(_, _, info)], _, (address, _) = self._knocks.recvmsg(
            _KNOCK_BYTES, socket.CMSG_SPACE(_PKTINFO_BYTES)
        )
        to = socket.inet_ntoa(info[_PKTINFO_BYTES - 4 : _PKTINFO_BYTES])
        return data, f"{to}:{self._knocks.getsockname()[1]}", address

    def _look(self, now_s: float) -> None:
        was, refused = self._status.flooded, _drops(self._listening) - self._drops_before
        flooded = self._flood.look(now_s, refused)
        self._status = DoorStatus(flooded, refused, _queue_is_full(self._listening))
        if flooded == was:
            return
        self._attach()
        if flooded:
            log.warning("strangers flood the radio's port: members alone get in")
            # Those that wait are strangers', nearly all; a member among them calls again at once.
            with contextlib.suppress(OSError):
                while not self._end.is_set():
                    self._listening.accept()[0].close()
        else:
            log.warning("strangers flood the radio's port no more", refused=refused)

    def _let_in(self, addresses: Iterable[str]) -> None:
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
        """Let a SYN pass from who is known and from this computer, and of others now and then."""
        known = list(self._known)
        code = [
            # What is no first SYN passes, also to the connections, which inherit this.
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
            (_AND, 0, 0, _ONE_IN - 1),
            # Never, if flooded: it is less than that.
            (_EQUAL, 0, 1, _ONE_IN if self._status.flooded else 0),
            (_RETURN, 0, 0, 0xFFFFFFFF),
            (_RETURN, 0, 0, 0),
        ]
        text = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *each) for each in code))
        program = struct.pack("HL", len(code), ctypes.addressof(text))
        self._listening.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, program)


def listening() -> dict[int, socket.socket]:
    """This process's IPv4 TCP sockets that listen, in descriptors of their own, by inode."""
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


def _drops(listens: socket.socket) -> int:
    numbers = array.array("I", listens.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, 36))
    return numbers[_DROPS]


def _queue_is_full(listens: socket.socket) -> bool:
    words = array.array("I", listens.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 32))
    return words[_BACKLOG] >= words[_MOST_BACKLOG]
