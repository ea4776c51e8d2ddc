"""Namespaces for robot hosts: separate processes, mounts and networks.

One process owns them all. When it or its parent ends, in whatever way, the kernel ends the hosts
and removes their disks and networks; only empty control groups remain.
"""

import contextlib
import ctypes
import ipaddress
import json
import os
import socket
import subprocess
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Self

from lpac.sim.hosts.base import NoHostsError

MAX_RACKS = 100
_CLONE_NEWNET = 0x40000000
_CGROUPS = Path("/sys/fs/cgroup")

# In the rack's own mounts. `air` is the network that all hosts and this machine are on.
_SET_UP = """
mount -t tmpfs rack /run
mkdir /run/netns /run/base
mount --bind "$1" /run/base
ip netns add air
ip -n air link add bridge type bridge
ip -n air link set bridge up
ip link add "$2" type veth peer name laptop netns air
ip -n air link set laptop master bridge up
ip address add "$3" dev "$2"
ip link set "$2" up
"""


class Rack:
    """A context in which hosts can be mounted, wired and run.

    `number` and `network` are unique among the running racks of this machine; `laptop_address` is
    this machine's address in the network.
    """

    def __init__(self, base: Path) -> None:
        """`base` is the tree mounted as /run/base in the rack."""
        self._base = base
        self._stack = ExitStack()
        self._pid = 0

    def __enter__(self) -> Self:
        """Raise NoHostsError if this machine does not allow new namespaces or networks."""
        with ExitStack() as stack:
            self.number, self.network = self._claim(stack)
            self.laptop_address = str(self.network[1])
            self._remove_cgroups()
            stack.callback(self._remove_cgroups)
            # Leaving it closes its input and waits.
            process = stack.enter_context(
                subprocess.Popen(
                    ["unshare", "--pid", "--mount", "--fork", "--kill-child", "--mount-proc",
                     "sh", "-c", "echo made; exec cat"],
                    # However this program ends, cat's input is closed.
                    stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                    # Ctrl-C goes to the caller alone.
                    process_group=0, text=True,
                )
            )  # fmt: skip
            assert process.stdout and process.stderr
            if process.stdout.readline() != "made\n":
                raise NoHostsError(f"no namespaces here: {process.stderr.read().strip()}")
            [self._pid] = children(process.pid)
            try:
                self.sh(
                    _SET_UP, str(self._base), f"lpac{self.number}",
                    f"{self.laptop_address}/{self.network.prefixlen}",
                )  # fmt: skip
            except OSError as error:
                raise NoHostsError(f"no place for robot hosts here: {error}") from None
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def path(self, path: str) -> Path:
        """Path of a file in the rack's mounts, as seen from outside."""
        return Path(f"/proc/{self._pid}/root/{path.lstrip('/')}")

    def sh(self, script: str, *arguments: str) -> None:
        """Run a shell script in the rack's mounts. Raises OSError that says what failed."""
        done = subprocess.run(
            self._entered("sh", "-euc", script, "sh", *arguments),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            raise OSError(done.stderr.strip() or f"{script!r} failed")

    def start(self, name: str, output: Path, *command: str) -> subprocess.Popen[bytes]:
        """Start a program in the rack, in new control groups of that name."""
        script = "exec "
        for folder in self._cgroups():
            group = folder / name
            _remove_cgroup(group)
            group.mkdir(parents=True)
            script = f"echo 0 > '{group}/cgroup.procs'; {script}"
        with output.open("ab") as file:
            return subprocess.Popen(
                self._entered("sh", "-euc", f'{script}"$@"', "sh", *command),
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                process_group=0,
            )

    @contextlib.contextmanager
    def in_network(self, name: str) -> Iterator[None]:
        """Enter a network namespace of the rack with the calling thread, to make sockets in it."""
        with (
            Path(f"/proc/{os.getpid()}/task/{threading.get_native_id()}/ns/net").open() as own,
            self.path(f"run/netns/{name}").open() as other,
        ):
            _enter_network(other.fileno())
            try:
                yield
            finally:
                _enter_network(own.fileno())

    def _entered(self, *command: str) -> list[str]:
        return ["nsenter", f"--target={self._pid}", "--mount", "--pid", *command]

    def _claim(self, stack: ExitStack) -> tuple[int, ipaddress.IPv4Network]:
        """Claim a number that no other rack uses, and a network free on this machine."""
        used = _used_networks()
        for number in range(1, MAX_RACKS + 1):
            claim = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
            try:
                claim.bind(f"\0lpac-rack-{number}")
            except OSError:
                continue
            for text in (f"10.97.{number}.0/24", f"172.29.{number}.0/24", f"192.168.{number}.0/24"):
                network = ipaddress.IPv4Network(text)
                if not any(network.overlaps(other) for other in used):
                    return number, network
        raise NoHostsError("no private network for robot hosts is free on this machine")

    def _cgroups(self) -> list[Path]:
        """Paths of systemd's control groups: one hierarchy, or two on older systems."""
        hierarchies = [
            path for path in (_CGROUPS / "systemd", _CGROUPS / "unified") if path.exists()
        ]
        return [path / f"lpac-rack-{self.number}" for path in hierarchies or [_CGROUPS]]

    def _remove_cgroups(self) -> None:
        for group in self._cgroups():
            _remove_cgroup(group)


def children(pid: int) -> list[int]:
    """Running child processes."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            state, parent = stat.read_text().rpartition(")")[2].split()[:2]
            if parent == str(pid) and state != "Z":
                found.append(int(stat.parent.name))
    return found


def _remove_cgroup(group: Path) -> None:
    for folder in sorted((p for p in group.rglob("*") if p.is_dir()), reverse=True):
        folder.rmdir()
    if group.exists():
        group.rmdir()


def _used_networks() -> list[ipaddress.IPv4Network]:
    done = subprocess.run(
        ["ip", "-4", "-json", "route", "show", "table", "all"],
        capture_output=True,
        text=True,
        check=True,
    )
    texts = [route["dst"] for route in json.loads(done.stdout)]
    return [ipaddress.IPv4Network(text, strict=False) for text in texts if text != "default"]


def _enter_network(descriptor: int) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.setns(descriptor, _CLONE_NEWNET) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
