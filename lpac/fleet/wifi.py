"""State of the robots' radios over SSH, and a bulk stream that loads them."""

import contextlib
import ipaddress
import os
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from lpac.fleet import probes
from lpac.fleet.hold import Report
from lpac.fleet.session import UnreachableError, connect, explain, ssh_command
from lpac.fleet.settings import FleetConfig, RobotHost
from lpac.radio.checked import WifiReading

_CHUNK_BYTES = 1 << 16
_ENDS_WITHIN_S = 5.0

Interface = Mapping[str, Any]


async def read_wifi(config: FleetConfig, robot: RobotHost, report: Report) -> list[Interface]:
    """Read the robot's wireless interfaces (see `probes.wifi_of`). Raises FleetError."""
    report("connect", None)
    async with connect(config, robot) as session:
        report("radio", None)
        return [*await probes.wifi(session)]


def in_the_wifi(address: str, root: Path = Path("/")) -> bool:
    """Whether this computer reaches the IPv4 address by Wi-Fi; False where that is not known.

    `root` is the parent of /proc and /sys.
    """
    found = ipaddress.IPv4Address(address)
    routes: list[tuple[int, str]] = []
    with contextlib.suppress(OSError):
        for line in (root / "proc/net/route").read_text().splitlines()[1:]:
            interface, destination, _, _, _, _, _, mask, *_ = line.split()
            network, bits = (
                int.from_bytes(bytes.fromhex(h), "little") for h in (destination, mask)
            )
            if int(found) & bits == network:
                routes.append((bits, interface))
    if not routes:
        return False
    _, interface = max(routes)
    return (root / "sys/class/net" / interface / "phy80211").exists()


def reading(before: Sequence[Interface], after: Sequence[Interface]) -> WifiReading:
    """Rate, signal and channel use between two samples, of the connected interface."""
    now = next((one for one in after if one["connected"]), None)
    if now is None:
        return WifiReading()
    then = next((one for one in before if one["name"] == now["name"]), {})
    return WifiReading(now["rate_mbit_s"], now["signal_dbm"], _busy_share(then, now))


def _busy_share(before: Interface, after: Interface) -> float | None:
    keys = ("active_ms", "busy_ms")
    if any(one.get(key) is None for one in (before, after) for key in keys):
        return None
    active_ms, busy_ms = (float(after[key]) - float(before[key]) for key in keys)
    # Some drivers reset their counters.
    if before["frequency_mhz"] != after["frequency_mhz"] or active_ms <= 0.0 or busy_ms < 0.0:
        return None
    return min(busy_ms / active_ms, 1.0)


class BulkStream:
    """Bytes received from a bulk stream, and their rate."""

    def __init__(self, robot: str) -> None:
        self.robot = robot
        self.received_bytes = 0
        self._began_s: float | None = None

    @property
    def rate_mbit_s(self) -> float:
        """Mean rate since the first bytes, Mbit/s."""
        if self._began_s is None:
            return 0.0
        return 8e-6 * self.received_bytes / max(time.monotonic() - self._began_s, 1e-3)

    def add(self, count: int) -> None:
        """Count received bytes."""
        if self._began_s is None:
            self._began_s = time.monotonic()
        self.received_bytes += count


@contextlib.contextmanager
def bulk_stream(config: FleetConfig, robot: RobotHost) -> Iterator[BulkStream]:
    """Receive as many bytes as ssh carries, as a pull of logs would, within this context.

    Raises UnreachableError on exit if the stream broke off or nothing was received.
    """
    ssh, *options, host = ssh_command(config, robot)
    # Compressed, zeros would load nothing.
    command = [ssh, "-o", "Compression=no", *options, host, "exec cat /dev/zero"]
    stream = BulkStream(robot.name)
    # A file: a helper process from ssh's configuration may keep a pipe open after ssh has ended.
    with tempfile.TemporaryFile() as stderr:
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=stderr,
            process_group=0,
        )  # fmt: skip
        reader = threading.Thread(target=_count, args=(process, stream), daemon=True)
        reader.start()
        try:
            yield stream
            broken = process.poll() is not None or not stream.received_bytes
        finally:
            process.kill()
            process.wait()
            reader.join(_ENDS_WITHIN_S)
        if broken:
            stderr.seek(0)
            text = explain(stderr.read().decode(errors="replace"), robot.host)
            raise UnreachableError(f"bulk stream from {robot.name}: {text}")


def _count(process: "subprocess.Popen[bytes]", stream: BulkStream) -> None:
    assert process.stdout is not None
    while chunk := os.read(process.stdout.fileno(), _CHUNK_BYTES):
        stream.add(len(chunk))
