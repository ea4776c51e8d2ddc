"""Notifications to systemd, which starts and restarts the robot's program and shows its status.

The protocol is sd_notify(3): datagrams of assignments to the socket named by $NOTIFY_SOCKET.
"""

import json
import os
import re
import socket
from collections.abc import Mapping
from contextlib import suppress

from edge.messages.mission import RobotStatus

READY, ALIVE, STOPPING = "READY=1", "WATCHDOG=1", "STOPPING=1"

_MOST_CHECKS, _MOST_CHARACTERS = 8, 120


class ServiceManager:
    """Sender of notifications; does nothing unless systemd started this program."""

    def __init__(self) -> None:
        """Remove the socket's name from the environment, so that child processes cannot use it."""
        name = os.environ.pop("NOTIFY_SOCKET", "")
        for variable in ("WATCHDOG_USEC", "WATCHDOG_PID"):
            os.environ.pop(variable, None)
        # An abstract name begins with a zero byte, which an environment variable cannot hold.
        self._address = "\0" + name[1:] if name.startswith("@") else name
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)

    def close(self) -> None:
        """Close the socket. May be repeated."""
        self._socket.close()

    def notify(self, *assignments: str) -> None:
        """Send assignments. Never waits or raises OSError: drops them if they cannot be sent."""
        if self._address and assignments:
            with suppress(OSError):
                data = "\n".join(assignments).encode()
                self._socket.sendto(data, socket.MSG_DONTWAIT, self._address)


def status_text(
    status: RobotStatus,
    *,
    monotonic_s: float,
    autopilot: bool,
    ages_s: Mapping[str, float | None],
    peers: int,
    insecure: bool,
) -> str:
    """`STATUS=` and one JSON object: ASCII, below 3,000 characters, since systemd's limit is 4 kB.

    `monotonic_s` lets readers compute the status's age. `autopilot`: whether its telemetry is
    fresh. `ages_s`: time since each loop's last successful tick; None before the first. `peers`:
    number of connected zenoh sessions. `insecure`: whether anyone on the network can fly the robot.
    """
    text = {
        "monotonic_s": round(monotonic_s, 3),
        "state": status.state,
        "reason": {"code": status.reason.code, "text": _short(status.reason.text)},
        "armed": status.armed,
        "mode": status.mode,
        "battery": _rounded(status.battery),
        "endurance_s": _rounded(status.endurance_s),
        "satellites": status.satellites,
        "system_id": status.system_id,
        "autopilot": autopilot,
        "loops": {
            name: {"ticks": loop.ticks, "failures": loop.failures, "age_s": _rounded(ages_s[name])}
            for name, loop in status.loops.items()
        },
        "peers": peers,
        "insecure": insecure,
        # The link opens before the loops start and closes after they end.
        "link": True,
        "bundle_id": status.bundle_id,
        "world_id": status.world_id,
        "trial": _short(status.trial),
        "robot_id": status.robot_id,
        "boot_nonce": status.boot_nonce,
        "failed_checks": [
            {
                "code": check.code,
                "text": _short(check.text),
                "settles_by_itself": check.settles_by_itself,
            }
            for check in status.failed_checks[:_MOST_CHECKS]
        ],
        "failed_checks_more": max(0, len(status.failed_checks) - _MOST_CHECKS),
    }
    return "STATUS=" + json.dumps(text, separators=(",", ":"))


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 3)


def _short(text: str) -> str:
    """Shorten `text`, and replace characters that JSON would escape at length."""
    return re.sub(r"[^ -~]", "?", text)[:_MOST_CHARACTERS]
