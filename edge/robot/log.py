"""The flight log of one start of a robot's program."""

import dataclasses
import json
from importlib.metadata import version
from pathlib import Path

from edge.drivers.flight_log import ROBOT_TOPICS, FlightLog, FlightMetadata
from edge.flight.record import FlightTick, TickWriter
from edge.robot.config import RobotConfig


def open_log(config: RobotConfig, bundle_id: str, boot_nonce: int) -> FlightLog:
    """Open the log in the configured folder; `bundle_id` is in hexadecimal."""
    metadata = FlightMetadata(
        robot_id=config.robot_id,
        boot_nonce=boot_nonce,
        bundle_id=bundle_id,
        bundle_path=config.policy.bundle,
        configuration=json.dumps(dataclasses.asdict(config), default=str),
        version=version("lpac-edge"),
    )
    # The log's thread makes the messages, so that they can neither delay nor end a control tick.
    ticks = TickWriter()
    flight = ROBOT_TOPICS["flight"]._replace(
        convert=lambda _, tick: ticks.message(FlightTick(**tick))
    )
    return FlightLog(
        Path(config.log.folder),
        metadata,
        {**ROBOT_TOPICS, "flight": flight},
        max_total_bytes=int(config.log.max_total_mb * 1e6),
    )
