"""The only writer of fleet.toml and robot.toml.

A fleet.toml is parsed before it is written, so that `lpac.fleet.settings` never refuses it.
"""

import fcntl
import os
import re
import stat
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.items import InlineTable

from edge.core.schema import ConfigError
from lpac.fleet.settings import IN_RELEASE, FleetConfig, RobotPaths, parse_fleet, read_fleet


def robot_toml(config: FleetConfig, name: str, paths: RobotPaths = IN_RELEASE) -> str:
    """Text of the robot's robot.toml; the same fleet.toml always gives the same text.

    Raises ConfigError for an unknown robot or a spare.
    """
    text = tomlkit.dumps(config.robot_mapping(name, paths), sort_keys=True)
    return f"# Generated from fleet.toml for robot {name}: changes belong there.\n{text}"


def write_robot(path: Path, config: FleetConfig, name: str, paths: RobotPaths) -> None:
    """Write the robot's robot.toml. Raises ConfigError or OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(robot_toml(config, name, paths))


def write_fleet(path: Path, heading: str, tables: Mapping[str, Any]) -> FleetConfig:
    """Write a new fleet.toml, headed by a comment, and return its fleet.

    Raises ConfigError if it would not be valid, or OSError.
    """
    text = f"# {heading}\n{tomlkit.dumps(tables)}"
    config = parse_fleet(path, text)
    path.write_text(text)
    return config


def add_robot(
    path: Path,
    name: str,
    host: str,
    robot_id: int,
    *,
    user: str = "root",
    port: int | None = None,
    address: str | None = None,
) -> None:
    """Add a spare to the file, unless it has this robot already.

    Raises ConfigError, and leaves the file unchanged, if it would not be valid then or has another
    robot of this name.
    """
    entry: dict[str, Any] = {"host": host, "robot_id": robot_id}
    entry |= {"user": user} if user != "root" else {}
    entry |= {"port": port} if port is not None else {}
    entry |= {"address": address} if address is not None else {}

    def change(text: str) -> str:
        there = parse_fleet(path, text).robots.get(name)
        if there is not None:
            same = (there.host, there.robot_id, there.user) == (host, robot_id, user)
            if same and port in (None, there.port) and address in (None, there.address):
                return text
            raise ConfigError(
                f"{path}: robots.{name}: exists already, with host = {there.host!r}, user = "
                f"{there.user!r}, robot_id = {there.robot_id}: change it in the file, or take "
                "another name"
            )
        before, after = _before_slots(text)
        table = tomlkit.dumps({"robots": {name: entry}})
        changed = f"{before}{table}\n{after}" if after else f"{before}{table}"
        expected = tomllib.loads(text)
        expected.setdefault("robots", {})[name] = entry
        try:
            right = tomllib.loads(changed) == expected
        except tomllib.TOMLDecodeError:
            right = False
        if not right:
            raise ConfigError(
                f"{path}: robots.{name}: can only be added where robots are [robots.NAME] tables"
            )
        return changed

    _edit(path, change)


def assign(path: Path, slot_index: int, robot: str | None) -> None:
    """Give the slot, counted from 0, to the robot, or free it.

    Raises ConfigError, and leaves the file unchanged, if it would not be valid then.
    """

    def change(text: str) -> str:
        config = parse_fleet(path, text)
        if not 0 <= slot_index < len(config.slots):
            raise ConfigError(f"{path}: slots[{slot_index}]: there are {len(config.slots)} slots")
        if config.slots[slot_index].robot == robot:
            return text
        document = tomlkit.parse(text)
        slot: Any = document["slots"][slot_index]
        if "robot" in slot or isinstance(slot, InlineTable):
            slot["robot"] = robot or ""
        else:
            # tomlkit would insert it after the comments that belong to the next table.
            slot.value.body.insert(0, (tomlkit.key("robot"), tomlkit.item(robot)))
        return tomlkit.dumps(document)

    _edit(path, change)


def _before_slots(text: str) -> tuple[str, str]:
    """Split the text before the first slot and the comment directly above it."""
    match = re.search(r"^(?:#.*\n)*\[\[\s*slots\s*\]\]", text, re.MULTILINE)
    at = match.start() if match else len(text)
    before = text[:at]
    gap = "" if before.endswith("\n\n") else "\n" if before.endswith("\n") else "\n\n"
    return before + gap, text[at:]


def _edit(path: Path, change: Callable[[str], str]) -> None:
    """Replace the file atomically, if it is valid after the change."""
    path = path.resolve()
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    new = path.with_name(f".{path.name}.new")
    try:
        # Two concurrent commands would overwrite each other's change.
        fcntl.flock(folder, fcntl.LOCK_EX)
        text = read_fleet(path)
        changed = change(text)
        if changed == text:
            return
        parse_fleet(path, changed)
        try:
            with new.open("wb") as file:
                file.write(changed.encode())
                file.flush()
                os.fsync(file.fileno())
            new.chmod(stat.S_IMODE(path.stat().st_mode))
            new.replace(path)
        finally:
            new.unlink(missing_ok=True)
        os.fsync(folder)
    finally:
        os.close(folder)
