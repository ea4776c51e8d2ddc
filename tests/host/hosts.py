"""Robot computers on this machine, and what may befall them: see `lpac.sim.hosts`."""

import contextlib
import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import overload

from lpac.sim.hosts.host import SimulatedHost
from lpac.sim.hosts.hosts import SimulatedHosts
from lpac.sim.hosts.rack import children

RUN_WITHIN_S = 60.0


class FrailHost(SimulatedHost):
    """A computer that can be looked into, cut off, filled up and switched off."""

    _connected = True

    def run(self, command: str, *, timeout_s: float = RUN_WITHIN_S) -> str:
        """What a shell command prints on the host, as root, through its systemd, not its network.

        Raises RuntimeError with what it printed unless it returns 0; TimeoutExpired.
        """
        # Its own systemd runs it: what merely enters its namespaces keeps this machine's
        # privileges, and could set this machine's clock.
        done = subprocess.run(
            [
                "nsenter", f"--target={self._leader()}", "--all", "env", "-i",
                "PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin",
                "systemd-run", "--quiet", "--wait", "--pipe", "--property=KillMode=process",
                "--property=WorkingDirectory=/root", "--setenv=HOME=/root",
                # systemd-run would put its own variables in.
                "/bin/sh", "-c", command.replace("$", "$$"),
            ],
            stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=timeout_s,
            check=False,
        )  # fmt: skip
        if done.returncode:
            said = (done.stdout + done.stderr).strip()
            raise RuntimeError(f"{self.name}: {command!r} returned {done.returncode}: {said}")
        return done.stdout

    def cut(self) -> None:
        """Nothing passes between the host and the network any more, also after `power_on`."""
        self._connect(connected=False)

    def heal(self) -> None:
        """The network is there again."""
        self._connect(connected=True)

    def fill_disk(self) -> None:
        """No block is free any more."""
        disk = self._disk()
        with (disk / "filler").open("wb") as file:
            size = 0
            while free := (found := os.statvfs(disk)).f_bavail * found.f_frsize:
                # Whoever writes just now may have taken some of it.
                with contextlib.suppress(OSError):
                    os.posix_fallocate(file.fileno(), size, free)
                    size += free

    def free_disk(self) -> None:
        """Undo `fill_disk`."""
        (self._disk() / "filler").unlink(missing_ok=True)

    def power_off(self) -> None:
        """All that runs on it, and its PX4, is gone at once; others hear nothing of that.

        Raises RuntimeError if it is off.
        """
        if self._process is None:
            raise RuntimeError(f"{self.name} is off")
        self._set_port("down")
        self._parameters = dict(self.vehicle.parameters)
        self.stop_vehicle()
        with contextlib.suppress(RuntimeError):
            os.kill(self._leader(), signal.SIGKILL)
        self.await_end()
        self._rack.sh('ip -n air link delete "$1"; ip netns delete "$1"', self.name)

    def power_on(self) -> None:
        """Boot from the same disk; returns once the system is up. Raises OSError if it is not."""
        self.switch_on()
        self.await_boot()

    def reset(self) -> None:
        """A new disk, a new PX4 and a network that works, as at the start. It reboots for that."""
        if self._process is not None:
            self.power_off()
        self._connected = True
        self._parameters = {"MAV_SYS_ID": self.robot_id}
        self.format()
        self.power_on()

    def switch_on(self) -> None:
        """Begin to boot, on the network unless it was cut off."""
        if self._process is not None:
            raise RuntimeError(f"{self.name} is on")
        super().switch_on()
        if not self._connected:
            self._set_port("down")

    def _disk(self) -> Path:
        return self._rack.path(f"run/{self.name}")

    def _connect(self, *, connected: bool) -> None:
        self._connected = connected
        if self._process is not None:
            self._set_port("up" if connected else "down")

    def _set_port(self, state: str) -> None:
        self._rack.sh('ip -n air link set "$1" "$2"', self.name, state)

    def _leader(self) -> int:
        """The host's process 1. Raises RuntimeError while the host is off."""
        containers = children(self._process.pid) if self._process else []
        leaders = [leader for container in containers for leader in children(container)]
        if len(leaders) != 1:
            raise RuntimeError(f"{self.name} is off")
        return leaders[0]


class FrailHosts(SimulatedHosts):
    """Hosts that may suffer."""

    host_type = FrailHost

    @overload
    def __getitem__(self, index: int) -> FrailHost: ...
    @overload
    def __getitem__(self, index: slice) -> list[FrailHost]: ...
    def __getitem__(self, index: int | slice) -> FrailHost | list[FrailHost]:
        return list(self)[index]

    def __iter__(self) -> Iterator[FrailHost]:
        return (host for host in self._hosts if isinstance(host, FrailHost))

    def __len__(self) -> int:
        return len(self._hosts)
