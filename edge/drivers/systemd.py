"""Talks to systemd, which starts the robot's program, restarts it and shows its state.

The protocol is sd_notify(3): datagrams of assignments to the socket that $NOTIFY_SOCKET names.
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
    """systemd, or nobody if it did not start this program; then nothing is told to anyone."""

    def __init__(self) -> None:
        """Takes the socket's name out of the environment: no child may speak for this program."""
        name = os.environ.pop("NOTIFY_SOCKET", "")
        for variable in ("WATCHDOG_USEC", "WATCHDOG_PID"):
            os.environ.pop(variable, None)
        # An abstract name begins with a zero byte, which an environment variable cannot hold.
        self._address = "\0" + name[1:] if name.startswith("@") else name
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)

    def close(self) -> None:
        """Nothing more is told; again is no error."""
        self._socket.close()

    def tell(self, *assignments: str) -> None:
        """Send them, as far as somebody takes them now: never waits, never raises OSError."""
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
    """`STATUS=` and one JSON object: ASCII, below 3,000 characters, since systemd takes 4 kB.

    `monotonic_s` tells readers how old it is. `autopilot`: its telemetry is fresh. `ages_s`: since
    each loop's last tick that succeeded. `peers`: zenoh sessions connected to this one.
    `insecure`: whoever is on the network can fly it.
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
            name: {
                "ticks": loop.ticks,
                "failures": loop.failures,
                "age_s": _rounded(ages_s[name]),
            }
            for name, loop in status.loops.items()
        },
        "peers": peers,
        "insecure": insecure,
        # It is opened before the loops start, and closed after they ended.
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
    """In characters that JSON needs no long escapes for."""
    return re.sub(r"[^ -~]", "?", text)[:_MOST_CHARACTERS]
