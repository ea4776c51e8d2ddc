"""The flight log of one start of a robot's program."""

import dataclasses
import json
from importlib.metadata import version
from pathlib import Path

from edge.drivers.flight_log import FlightLog, FlightMetadata
from edge.robot.config import RobotConfig


def open_log(config: RobotConfig, bundle_id: str, boot_nonce: int) -> FlightLog:
    """Begin it where the configuration says; `bundle_id` is in hexadecimal."""
    metadata = FlightMetadata(
        robot_id=config.robot_id,
        boot_nonce=boot_nonce,
        bundle_id=bundle_id,
        bundle_path=config.policy.bundle,
        configuration=json.dumps(dataclasses.asdict(config), default=str),
        version=version("lpac-edge"),
    )
    max_total_bytes = int(config.log.max_total_mb * 1e6)
    return FlightLog(Path(config.log.folder), metadata, max_total_bytes=max_total_bytes)
