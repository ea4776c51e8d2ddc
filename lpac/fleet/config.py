"""fleet.toml: which robots there are, how to reach them, and who flies where.

A robot is a computer with a vehicle; a slot is a place in the flight: pad, height, landing point.
A robot without a slot is a spare. Relative paths are meant from the file's own folder, "~" is the
user's. Every mistake is one line that names the file, the key, the robot and what is allowed.
"""

import fcntl
import ipaddress
import itertools
import math
import os
import re
import stat
import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.items import InlineTable

from edge.core.schema import ConfigError, from_mapping
from edge.core.wire import MAX_ROBOT_ID
from edge.flight.margins import Margin, places_apart
from edge.robot.config import AutopilotConfig, RobotConfig

DEFAULT_DIRECTORY = "/opt/lpac"
_MAX_CPU = 1023

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_-]{0,31}")
# These stand on the command lines of ssh, and in files of systemd.
_HOST = re.compile(r"[A-Za-z0-9_:][A-Za-z0-9_.:-]*")
_USER = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")
_UNIT = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.@:-]*")
_DIRECTORY = re.compile(r"(/[A-Za-z0-9_-][A-Za-z0-9_.-]*)+")
_CPUS = re.compile(r"([0-9]{1,4})(?:-([0-9]{1,4}))?")

# Keys of robot.toml that [robot] must not have, and where they come from.
_ELSEWHERE = {
    "fleet": "it is `fleet` at the top of the file",
    "robot_id": "it is `robot_id` in [robots.NAME]",
    "policy.bundle": "it is `bundle` at the top of the file",
    "policy.world": "it is `world` at the top of the file",
    "autopilot.system_id": "it is `system_id` in [robots.NAME]",
    "link": "it follows from `address` and `zenoh_port` in [robots.NAME]",
    "flight.slot": "it is `height` in [[slots]]",
    "flight.landing_point_m": "it is `landing_point_m` in [[slots]]",
    "log.folder": "robots log to /var/lib/lpac/logs",
}
_OF_ONE_ROBOT_ELSEWHERE = _ELSEWHERE | {
    "autopilot.url": "it is `mavlink_url` in [robots.NAME]",
}


@dataclass(frozen=True, slots=True)
class SshConfig:
    """`config` is the file for `ssh -F`; empty: OpenSSH's own files."""

    config: str = ""
    connect_timeout_s: float = 5.0

    def __post_init__(self) -> None:
        if not 1.0 <= self.connect_timeout_s <= 300.0:
            raise ValueError(f"connect_timeout_s = {self.connect_timeout_s}: must be from 1 to 300")


@dataclass(frozen=True, slots=True)
class Slot:
    """A place in the flight; `robot` is None where it is free.

    `height` is robot.toml's `flight.slot`; `pad_m` and `landing_point_m` are (x, y) of the mission
    frame.
    """

    height: int
    pad_m: tuple[float, ...]
    landing_point_m: tuple[float, ...]
    robot: str | None = None

    def __post_init__(self) -> None:
        if self.height < 0:
            raise ValueError(f"height = {self.height}: must be 0 or above")
        for name in ("pad_m", "landing_point_m"):
            place_m = getattr(self, name)
            if len(place_m) != 2 or not all(map(math.isfinite, place_m)):
                raise ValueError(f"{name} = {list(place_m)}: must be [x, y]")


@dataclass(frozen=True, slots=True)
class RobotHost:
    """A robot, and how to reach it.

    `host`, `user` and `port` are for ssh; `host` may be a name from its configuration, which also
    decides where `port` is None. `address` (IPv4) and `zenoh_port` are where the other robots reach
    it. `mavlink_url` is where PX4's datagrams come in, `system_id` its MAV_SYS_ID. `cpus` are where
    its program may run, empty: on all. `overrides` are its own values of robot.toml.
    """

    name: str
    host: str
    user: str
    port: int | None
    address: str
    robot_id: int
    zenoh_port: int
    system_id: int
    mavlink_url: str
    cpus: tuple[int, ...]
    overrides: Mapping[str, Any] = field(hash=False)

    @property
    def mavlink_port(self) -> int:
        """The UDP port of `mavlink_url`."""
        return AutopilotConfig(self.mavlink_url, self.system_id).port


@dataclass(frozen=True, slots=True)
class FleetConfig:
    """All of fleet.toml, checked as a whole; `shared` is what all robots' robot.toml have.

    `directory` is the robots' folder of releases; `predecessors` are containers and units that must
    not run beside ours.
    """

    path: Path
    fleet: str
    image: Path
    bundle: Path
    world: Path
    directory: str
    predecessors: tuple[str, ...]
    ssh: SshConfig
    robots: Mapping[str, RobotHost]
    slots: tuple[Slot, ...]
    shared: Mapping[str, Any]

    def slot_of(self, name: str) -> Slot | None:
        """The robot's slot; None for a spare."""
        return next((slot for slot in self.slots if slot.robot == name), None)

    def free_ground(self) -> Margin | None:
        """How far around the fence nobody may be, whatever fails; None if no robot flies.

        The greatest of all robots' margins, each from its own fence.
        """
        flying = [(i, self.robots[s.robot]) for i, s in enumerate(self.slots) if s.robot]
        margins = [_robot_config(self, robot, i).free_ground for i, robot in flying]
        return max(margins, default=None)

    def robot_toml(self, name: str) -> str:
        """The text of the robot's robot.toml, with the paths that its release has in the sandbox.

        The same fleet.toml gives the same text. Raises ConfigError for an unknown robot or a spare.
        """
        (robot,) = select(self, name)
        slot = self.slot_of(name)
        if slot is None:
            raise ConfigError(f"{self.path}: robots.{name}: is a spare: it sits in no slot")
        text = tomlkit.dumps(_robot_mapping(self, robot, slot), sort_keys=True)
        return f"# Generated from fleet.toml for robot {name}: changes belong there.\n{text}"

    def robot_config(self, name: str) -> RobotConfig:
        """What the robot flies by. Raises ConfigError for an unknown robot or a spare."""
        return from_mapping(RobotConfig, tomllib.loads(self.robot_toml(name)), str(self.path))

    def drop_ins(self, robot: RobotHost) -> dict[str, str]:
        """What differs from the units: the texts of lpac-robot.conf and lpac-land.conf, if any."""
        unit, place = [], []
        if self.directory != DEFAULT_DIRECTORY:
            current = f"{self.directory}/current"
            unit = ["ConditionPathExists=", f"ConditionPathExists={current}/robot.toml"]
            place = [
                f"RootDirectory={self.directory}/sandbox",
                # It empties BindPaths too.
                "BindReadOnlyPaths=",
                f"BindReadOnlyPaths={current}/root:/",
                f"BindReadOnlyPaths={current}:/release",
            ]
        flies = list(place)
        if place:
            flies += [
                "BindReadOnlyPaths=/run/systemd/notify",
                "BindPaths=/var/lib/private/lpac:/var/lib/lpac",
            ]
        if robot.cpus:
            flies += ["CPUAffinity=", f"CPUAffinity={' '.join(map(str, robot.cpus))}"]
        texts = {}
        for name, service in (("lpac-robot.conf", flies), ("lpac-land.conf", place)):
            sections = {"[Unit]": unit, "[Service]": service}
            written = ["\n".join([head, *lines, ""]) for head, lines in sections.items() if lines]
            if written:
                texts[name] = "\n".join(written)
        return texts


def load_fleet(path: Path) -> FleetConfig:
    """The fleet in the file, its paths made absolute. Raises ConfigError."""
    return _fleet(path, _read(path))


def select(config: FleetConfig, names: str | None) -> list[RobotHost]:
    """The robots of a list such as "r1,r3", or all: in the order of the slots, then the spares.

    Raises ConfigError for a name that is unknown, or if there is no robot.
    """
    flying = [slot.robot for slot in config.slots if slot.robot is not None]
    order = list(dict.fromkeys([*flying, *config.robots]))
    known = f"known are {', '.join(order)}" if order else "it has no robots yet"
    asked = order if names is None else [n for n in map(str.strip, names.split(",")) if n]
    for name in asked:
        if name not in config.robots:
            raise ConfigError(f"{config.path}: robots: {name!r} is unknown; {known}")
    if not asked:
        raise ConfigError(f"{config.path}: robots: none is chosen; {known}")
    return [config.robots[name] for name in order if name in asked]


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
        there = _fleet(path, text).robots.get(name)
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
        config = _fleet(path, text)
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


# Reading


@dataclass(frozen=True, slots=True)
class _RobotTable:
    """[robots.NAME] as it is written."""

    host: str
    robot_id: int
    user: str = "root"
    port: int | None = None
    address: str | None = None
    zenoh_port: int = 7447
    system_id: int | None = None
    mavlink_url: str | None = None
    cpus: str = ""
    robot: dict = field(default_factory=dict)  # type: ignore[type-arg]

    def __post_init__(self) -> None:
        for name, pattern in (("host", _HOST), ("user", _USER)):
            if pattern.fullmatch(getattr(self, name)) is None:
                raise ValueError(
                    f"{name} = {getattr(self, name)!r}: must be letters, digits, '.', '-' and "
                    "'_', and not start with '.' or '-'"
                )
        for name in ("port", "zenoh_port"):
            value = getattr(self, name)
            if value is not None and not 1 <= value <= 65535:
                raise ValueError(f"{name} = {value}: must be from 1 to 65535")
        if not 0 <= self.robot_id <= MAX_ROBOT_ID:
            raise ValueError(f"robot_id = {self.robot_id}: must be from 0 to {MAX_ROBOT_ID}")
        if self.system_id is None and not 1 <= self.robot_id <= 255:
            raise ValueError(
                f"system_id is missing: robot_id = {self.robot_id} is not from 1 to 255"
            )
        if self.system_id is not None and not 1 <= self.system_id <= 255:
            raise ValueError(f"system_id = {self.system_id}: must be from 1 to 255")
        if self.address is not None and not _is_ipv4(self.address):
            raise ValueError(f"address = {self.address!r}: must be an IPv4 address")
        if self.address is None and not _is_ipv4(self.host):
            raise ValueError(
                f"address is missing: host = {self.host!r} is no IPv4 address, by which the other "
                "robots could reach it"
            )
        if self.mavlink_url is not None:
            try:
                AutopilotConfig(self.mavlink_url, system_id=1)
            except ValueError as error:
                raise ValueError(f"mavlink_{error}") from None  # its key is `url`
        _cpus(self.cpus)


@dataclass(frozen=True, slots=True)
class _FleetTable:
    """fleet.toml as it is written."""

    fleet: str
    image: str
    bundle: str
    world: str
    directory: str = DEFAULT_DIRECTORY
    predecessors: tuple[str, ...] = ()
    ssh: SshConfig = field(default_factory=SshConfig)
    robot: dict = field(default_factory=dict)  # type: ignore[type-arg]
    robots: dict = field(default_factory=dict)  # type: ignore[type-arg]
    slots: tuple[Slot, ...] = ()

    def __post_init__(self) -> None:
        _check_name("fleet = ", self.fleet)
        for name in ("image", "bundle", "world"):
            if not getattr(self, name):
                raise ValueError(f"{name} = '': must be a path")
        if _DIRECTORY.fullmatch(self.directory) is None:
            raise ValueError(
                f"directory = {self.directory!r}: must be an absolute path of letters, digits, "
                "'.', '-' and '_', such as '/opt/lpac'"
            )
        for name in self.predecessors:
            if _UNIT.fullmatch(name) is None:
                raise ValueError(f"predecessors: {name!r}: must be a container's or unit's name")
        for name in self.robots:
            _check_name("robots: ", name)


def _read(path: Path) -> str:
    try:
        # Not read_text, which would change the ends of lines.
        return path.read_bytes().decode()
    except FileNotFoundError as error:
        raise ConfigError(
            f"{path}: cannot be read: {error.strerror}: give --fleet, or set LPAC_FLEET"
        ) from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: no TOML: {error}") from None


def _fleet(path: Path, text: str) -> FleetConfig:
    try:
        mapping = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: no TOML: {error}") from None
    slots = mapping.get("slots")
    if isinstance(slots, list) and all(isinstance(slot, dict) for slot in slots):
        mapping["slots"] = [{"height": i} | _without_empty(slot) for i, slot in enumerate(slots)]
    table = from_mapping(_FleetTable, mapping, str(path))
    _check_keys(table.robot, _ELSEWHERE, f"{path}: robot")
    folder = path.resolve().parent

    def place(text: str) -> Path:
        try:
            return folder / Path(text).expanduser()
        except RuntimeError:
            raise ConfigError(f"{path}: {text!r}: whose home folder that is is not known") from None

    config = FleetConfig(
        path=path,
        fleet=table.fleet,
        image=place(table.image),
        bundle=place(table.bundle),
        world=place(table.world),
        directory=table.directory,
        predecessors=table.predecessors,
        ssh=SshConfig(
            str(place(table.ssh.config)) if table.ssh.config else "",
            table.ssh.connect_timeout_s,
        ),
        robots={
            name: _robot(name, robot, table.robot, f"{path}: robots.{name}")
            for name, robot in table.robots.items()
        },
        slots=table.slots,
        shared=table.robot,
    )
    for mistake in itertools.chain(_shared_by_two(config), _sittings(config)):
        raise ConfigError(f"{path}: {mistake}")
    _check_flights(config)
    return config


def _without_empty(slot: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in slot.items() if (key, value) != ("robot", "")}


def _robot(name: str, mapping: object, shared: Mapping[str, Any], where: str) -> RobotHost:
    table = from_mapping(_RobotTable, mapping, where)
    _check_keys(table.robot, _OF_ONE_ROBOT_ELSEWHERE, f"{where}.robot")
    autopilot = from_mapping(
        AutopilotConfig,
        {
            **shared.get("autopilot", {}),
            **({} if table.mavlink_url is None else {"url": table.mavlink_url}),
            "system_id": table.robot_id if table.system_id is None else table.system_id,
        },
        f"{where}: autopilot",
    )
    return RobotHost(
        name=name,
        host=table.host,
        user=table.user,
        port=table.port,
        address=table.address or table.host,
        robot_id=table.robot_id,
        zenoh_port=table.zenoh_port,
        system_id=autopilot.system_id,
        mavlink_url=autopilot.url,
        cpus=_cpus(table.cpus),
        overrides=table.robot,
    )


def _check_name(what: str, name: str) -> None:
    if _NAME.fullmatch(name) is None:
        raise ValueError(
            f"{what}{name!r}: must be 1 to 32 letters, digits, '-' and '_', and not start with '-'"
        )


def _is_ipv4(text: str) -> bool:
    try:
        ipaddress.IPv4Address(text)
    except ValueError:
        return False
    return True


def _cpus(text: str) -> tuple[int, ...]:
    """The processors of a list such as "0,4-6"."""
    cpus: set[int] = set()
    for part in text.replace(" ", "").split(",") if text else ():
        match = _CPUS.fullmatch(part)
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
        if not first <= last <= _MAX_CPU:
            raise ValueError(
                f"cpus = {text!r}: must be like '4-6' or '4,5,7', from 0 to {_MAX_CPU}"
            )
        cpus.update(range(first, last + 1))
    return tuple(sorted(cpus))


def _check_keys(table: Mapping[str, Any], elsewhere: Mapping[str, str], where: str) -> None:
    """Raises ConfigError for a key of robot.toml that comes from elsewhere."""
    for key, place in elsewhere.items():
        head, _, rest = key.partition(".")
        inner = table.get(head, {})
        if rest and not isinstance(inner, dict):
            raise ConfigError(f"{where}: {head} = {inner!r}: expected a table")
        if (rest in inner) if rest else (head in table):
            raise ConfigError(f"{where}: {key} must not be set here: {place}")


def _shared_by_two(config: FleetConfig) -> Iterator[str]:
    owners: dict[str, str] = {}
    for robot in config.robots.values():
        for value in (
            f"robot_id = {robot.robot_id}",
            f"system_id = {robot.system_id}",
            f"host = {robot.host!r}, port = {robot.port or 22}",
            f"address = {robot.address!r}, zenoh_port = {robot.zenoh_port}",
        ):
            owner = owners.setdefault(value, robot.name)
            if owner != robot.name:
                yield f"robots.{robot.name}: {value}: robot {owner} has it too"


def _sittings(config: FleetConfig) -> Iterator[str]:
    for i, slot in enumerate(config.slots):
        if slot.robot is not None and slot.robot not in config.robots:
            known = ", ".join(config.robots) or "none"
            yield f"slots[{i}]: robot = {slot.robot!r}: is not in [robots]; known are {known}"
        for j, other in enumerate(config.slots[:i]):
            if slot.robot is not None and slot.robot == other.robot:
                yield f"slots[{i}]: robot = {slot.robot!r}: slots[{j}] has it too"
            if slot.height == other.height:
                yield (
                    f"slots[{i}]{_sitting(slot)}: height = {slot.height}: slots[{j}]"
                    f"{_sitting(other)} has it too"
                )


def _sitting(slot: Slot) -> str:
    return f" (robot {slot.robot})" if slot.robot is not None else ""


# What robots read, and whether they can fly so


def _robot_mapping(config: FleetConfig, robot: RobotHost, slot: Slot) -> dict[str, Any]:
    """The robot's robot.toml, in that slot. The release lies at /release in the sandbox."""
    earlier = (other for other in config.robots.values() if other.robot_id < robot.robot_id)
    own = {
        "fleet": config.fleet,
        "robot_id": robot.robot_id,
        "policy": {"bundle": "bundle", "world": "world.env"},
        "autopilot": {"url": robot.mavlink_url, "system_id": robot.system_id},
        "link": {
            "listen": [f"tcp/0.0.0.0:{robot.zenoh_port}"],
            "connect": [
                f"tcp/{other.address}:{other.zenoh_port}"
                for other in sorted(earlier, key=lambda other: other.robot_id)
            ],
        },
        "flight": {"slot": slot.height, "landing_point_m": list(slot.landing_point_m)},
        "log": {"folder": "/var/lib/lpac/logs"},
    }
    return _merged(_merged(config.shared, robot.overrides), own)


def _merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Both tables and the tables in them; what is in both comes from `above`."""
    merged = dict(below)
    for key, value in above.items():
        inner = merged.get(key)
        merged[key] = (
            _merged(inner, value)
            if isinstance(inner, Mapping) and isinstance(value, Mapping)
            else value
        )
    return merged


def _check_flights(config: FleetConfig) -> None:
    """Raises ConfigError unless every robot could fly, a spare in the first slot."""
    if not (config.robots and config.slots):
        return
    anyone = next(iter(config.robots.values()))
    flights = []
    for i, slot in enumerate(config.slots):
        robot = anyone if slot.robot is None else config.robots[slot.robot]
        flights.append(_robot_config(config, robot, i))
    for robot in config.robots.values():
        if config.slot_of(robot.name) is None:
            _robot_config(config, robot, 0)
    for i, (slot, flight) in enumerate(zip(config.slots, flights, strict=True)):
        where = f"{config.path}: slots[{i}]{_sitting(slot)}"
        fence = flight.fence
        if not fence.distance_m(*slot.pad_m) >= fence.buffer_m:
            raise ConfigError(
                f"{where}: pad_m = {list(slot.pad_m)}: must be inside the fence, at least "
                f"buffer_m = {fence.buffer_m:g} from its line"
            )
        for j, (other, its) in enumerate(zip(config.slots[:i], flights[:i], strict=True)):
            beside = f"slots[{j}]{_sitting(other)}"
            separation_m = max(flight.flight.min_separation_m, its.flight.min_separation_m)
            places = places_apart(flight.errors.position_m, its.errors.position_m)
            places = places.or_at_least(separation_m, "min_separation_m")
            # Who does not take off stands on his pad while the others land.
            for name, beside_name in itertools.product(("pad_m", "landing_point_m"), repeat=2):
                apart_m = math.dist(getattr(slot, name), getattr(other, beside_name))
                if not places.holds(apart_m):
                    raise ConfigError(
                        f"{where}: {name} = {list(getattr(slot, name))}: is {apart_m:.1f} m from "
                        f"{beside_name} of {beside}, {places}"
                    )
            heights = max(flight.errors.slot_spacing, its.errors.slot_spacing)
            heights = heights.or_at_least(separation_m, "min_separation_m")
            apart_m = abs(flight.flight.slot_height_m - its.flight.slot_height_m)
            if not heights.holds(apart_m):
                raise ConfigError(
                    f"{where}: height = {slot.height}: is {flight.flight.slot_height_m:g} m, "
                    f"{apart_m:.1f} m from that of {beside}, {heights}"
                )


def _robot_config(config: FleetConfig, robot: RobotHost, index: int) -> RobotConfig:
    slot = config.slots[index]
    sits = "in" if slot.robot == robot.name else "if it took"
    where = f"{config.path}: robots.{robot.name}, {sits} slots[{index}]"
    return from_mapping(RobotConfig, _robot_mapping(config, robot, slot), where)


# Editing


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
        text = _read(path)
        changed = change(text)
        if changed == text:
            return
        _fleet(path, changed)
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
