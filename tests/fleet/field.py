"""What the tests of the field's commands share: the `lpac fleet` command, and enrolled robots."""

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

from sim.hosts import RobotHost, RobotHosts
from tests.conftest import ROOT


def lpac_fleet(
    fleet: Path, *arguments: object, environment: Mapping[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """`lpac fleet ... --fleet FLEET` until it ends, where nobody can be asked."""
    return subprocess.run(
        [sys.executable, "-m", "cli.main", "fleet", *map(str, arguments), "--fleet", str(fleet)],
        env={**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "200", **(environment or {})},
        stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=120.0, check=False,
        start_new_session=True,
    )  # fmt: skip


def name_robot(hosts: RobotHosts, host: RobotHost) -> None:
    """Give the host its identity, as `enroll` does."""
    identity = {"fleet": hosts.fleet, "robot": host.name, "robot_id": host.robot_id}
    host.run(f"mkdir -p /etc/lpac; echo '{json.dumps(identity)}' > /etc/lpac/robot.json")
