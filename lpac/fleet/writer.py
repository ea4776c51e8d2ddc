"""The only writer of fleet.toml and robot.toml.

What it writes of a fleet is read back before it counts, so that nothing is written that
`lpac.fleet.settings` would refuse.
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
from lpac.fleet.settings import IN_RELEASE, FleetConfig, Places, parse_fleet, read_fleet


def robot_toml(config: FleetConfig, name: str, places: Places = IN_RELEASE) -> str:
    """The text of the robot's robot.toml. The same fleet.toml gives the same text.

    Raises ConfigError for an unknown robot or a spare.
    """
    text = tomlkit.dumps(config.robot_mapping(name, places), sort_keys=True)
    return f"# Generated from fleet.toml for robot {name}: changes belong there.\n{text}"


def write_robot(path: Path, config: FleetConfig, name: str, places: Places) -> None:
    """Write the robot's robot.toml. Raises ConfigError or OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(robot_toml(config, name, places))


def write_fleet(path: Path, heading: str, tables: Mapping[str, Any]) -> FleetConfig:
    """Write a new fleet.toml below a line that says where it is from; the fleet in it.

    Raises ConfigError if it would not be right; OSError.
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
    """Add a spare to the file; nothing happens if it has this very robot.

    Raises ConfigError if the file would not be right then, or has another robot of this name;
    the file is then as it was.
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
                f"{path}: robots.{name}: is there already, with host = {there.host!r}, user = "
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

    Raises ConfigError if the file would not be right then; it is then as it was.
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
            # tomlkit would put it behind the comments that head the next table.
            slot.value.body.insert(0, (tomlkit.key("robot"), tomlkit.item(robot)))
        return tomlkit.dumps(document)

    _edit(path, change)


def _before_slots(text: str) -> tuple[str, str]:
    """The text up to the first slot and the comment right above it, and the rest."""
    match = re.search(r"^(?:#.*\n)*\[\[\s*slots\s*\]\]", text, re.MULTILINE)
    at = match.start() if match else len(text)
    before = text[:at]
    gap = "" if before.endswith("\n\n") else "\n" if before.endswith("\n") else "\n\n"
    return before + gap, text[at:]


def _edit(path: Path, change: Callable[[str], str]) -> None:
    """Replace the file's text, if it is right afterwards, at once and for good."""
    path = path.resolve()
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    new = path.with_name(f".{path.name}.new")
    try:
        # Two commands at once would each write the file without the other's change.
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
