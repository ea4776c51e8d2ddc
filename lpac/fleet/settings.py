"""fleet.toml: which robots there are, how to reach them, and who flies where.

A robot is a computer with a vehicle; a slot is a place in the flight: pad, height, landing point.
A robot without a slot is a spare. Relative paths are meant from the file's own folder, "~" is the
user's. Every mistake is one line that names the file, the key, the robot and what is allowed.
"""

import itertools
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from edge.core.address import ipv4, is_loopback_endpoint, require_host, same_host
from edge.core.schema import Bounded, ConfigError, PointXY, from_mapping
from edge.core.toml import parse_toml, read_toml_text
from edge.flight.margins import Margin, places_apart
from edge.messages.bounds import RobotId
from edge.messages.mission import SlotNumber
from edge.robot.config import (
    AutopilotConfig,
    PlainName,
    RobotConfig,
    SystemId,
    port_of,
    require_group,
    require_url,
)
from lpac.radio.airtime import Transport

DEFAULT_DIRECTORY = "/opt/lpac"

# Where fleets' keys are if the file does not say: not beside it, where repositories are.
_KEYS = "~/.local/share/lpac/keys"
_MAX_CPU = 1023

_GROUP = "239.255.76.80:7450"

# These stand on the command lines of ssh, and in files of systemd.
_User = Annotated[
    str,
    Meta(
        pattern=r"\A[A-Za-z0-9_][A-Za-z0-9_.-]*\Z",
        description="letters, digits, '.', '-' and '_', and not start with '.' or '-'",
    ),
]
_Unit = Annotated[
    str,
    Meta(pattern=r"\A[A-Za-z0-9_][A-Za-z0-9_.@:-]*\Z", description="a container's or unit's name"),
]
_Directory = Annotated[
    str,
    Meta(
        pattern=r"\A(/[A-Za-z0-9_-][A-Za-z0-9_.-]*)+\Z",
        description="an absolute path of letters, digits, '.', '-' and '_', such as '/opt/lpac'",
    ),
]
_Path = Annotated[str, Meta(min_length=1, description="a path")]
_Port = Annotated[int, Meta(ge=1, le=65535)]
_CPUS = re.compile(r"([0-9]{1,4})(?:-([0-9]{1,4}))?")

# Keys of robot.toml that [robot] must not have, and where they come from.
_ELSEWHERE = {
    "fleet": "it is `fleet` at the top of the file",
    "robot_id": "it is `robot_id` in [robots.NAME]",
    "policy.bundle": "it is `bundle` at the top of the file",
    "policy.world": "it is `world` at the top of the file",
    "autopilot.system_id": "it is `system_id` in [robots.NAME]",
    "identity": "it follows from `keys` at the top of the file",
    "link": "it follows from [radio], and `address` and `zenoh_port` in [robots.NAME]; a radio of "
    "your own is `type` and `options` in [radio]",
    "flight.slot": "it is `height` in [[slots]]",
    "flight.landing_point_m": "it is `landing_point_m` in [[slots]]",
    "log.folder": "robots log to /var/lib/lpac/logs",
}
_OF_ONE_ROBOT_ELSEWHERE = _ELSEWHERE | {
    "autopilot.url": "it is `mavlink_url` in [robots.NAME]",
}


@dataclass(frozen=True, slots=True)
class SshConfig(Bounded):
    """`config` is the file for `ssh -F`; empty: OpenSSH's own files."""

    config: str = ""
    connect_timeout_s: Annotated[float, Meta(ge=1.0, le=300.0)] = 5.0


@dataclass(frozen=True, slots=True)
class RadioConfig(Bounded):
    """How robots' messages get to the others.

    "mesh": each robot is connected to each, and sends to them one by one. "multicast": robots send
    to all at once, in `group` (multicast address and port). In both each ground is connected to all
    robots. `type` and `options` are robot.toml's `link.type` and `link.options`: a radio of your
    own, which is told all of this too.
    """

    transport: Transport = "mesh"
    group: str = _GROUP
    type: Annotated[
        str, Meta(min_length=1, description="'zenoh', or the name of a radio of your own")
    ] = "zenoh"
    options: dict[str, object] = field(default_factory=dict, hash=False)

    def check_rules(self) -> None:
        require_group("group", self.group)
        if self.transport == "mesh" and self.group != _GROUP:
            raise ValueError(f"transport = 'mesh': group = {self.group!r}: must be left out")
        if self.options and self.type == "zenoh":
            raise ValueError(f"options = {self.options}: type = 'zenoh' takes none")


@dataclass(frozen=True, slots=True)
class Slot(Bounded):
    """A place in the flight; `robot` is None where it is free.

    `height` is robot.toml's `flight.slot`; `pad_m` and `landing_point_m` are (x, y) of the mission
    frame.
    """

    height: SlotNumber
    pad_m: PointXY
    landing_point_m: PointXY
    robot: str | None = None


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
    def has_computer(self) -> bool:
        """Whether it is on a computer that ssh could reach; those of `lpac sim` are not."""
        return not self.host.endswith(".invalid")

    @property
    def mavlink_port(self) -> int:
        """The UDP port of `mavlink_url`."""
        return port_of(self.mavlink_url)


@dataclass(frozen=True, slots=True)
class Places:
    """A robot's paths (bundle, world, identity, logs), and the address it listens on."""

    bundle: str
    world: str
    identity: str
    logs: str
    listen: str


# A release lies at /release in the sandbox of the robot's unit.
# At power-up, or while the access point is away, it may not have its own address yet: it listens on
# whatever it has.
IN_RELEASE = Places(
    "bundle", "world.env", "/var/lib/lpac/identity", "/var/lib/lpac/logs", "0.0.0.0"
)


@dataclass(frozen=True, slots=True)
class FleetConfig:
    """All of fleet.toml, checked as a whole; `shared` is what all robots' robot.toml have.

    `directory` is the robots' folder of releases; `predecessors` are containers and units that must
    not run beside ours. `keys` is the folder of this computer's own identity in the fleet; None if
    nobody has one: all of it is on this computer, or it is `insecure`, and whoever reaches the
    radio can fly it.
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
    keys: Path | None
    insecure: bool
    radio: RadioConfig = field(default_factory=RadioConfig)

    def endpoint(self, robot: RobotHost) -> str:
        """Zenoh endpoint of the robot."""
        return f"{self.scheme}/{robot.address}:{robot.zenoh_port}"

    @property
    def endpoints(self) -> tuple[str, ...]:
        """Zenoh endpoints of the robots."""
        return tuple(map(self.endpoint, self.robots.values()))

    @property
    def scheme(self) -> str:
        """Of zenoh's endpoints."""
        return "tcp" if self.keys is None else "tls"

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

    def values_of(self, robot: RobotHost) -> dict[str, Any]:
        """Settings of the robot's robot.toml: [robot], and its own values over them."""
        return _merged(self.shared, robot.overrides)

    def robot_mapping(self, name: str, places: Places) -> dict[str, Any]:
        """The robot's robot.toml, as a mapping. Raises ConfigError for who has none."""
        (robot,) = select(self, name)
        slot = self.slot_of(name)
        if slot is None:
            raise ConfigError(f"{self.path}: robots.{name}: is a spare: it sits in no slot")
        return _robot_mapping(self, robot, slot, places)

    def robot_config(self, name: str) -> RobotConfig:
        """Configuration that the robot flies by. Raises ConfigError for a stranger or a spare."""
        return from_mapping(RobotConfig, self.robot_mapping(name, IN_RELEASE), str(self.path))


def load_fleet(path: Path) -> FleetConfig:
    """The fleet in the file, its paths made absolute. Raises ConfigError."""
    return parse_fleet(path, read_fleet(path))


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


# Reading


@dataclass(frozen=True, slots=True)
class RobotTable(Bounded):
    """[robots.NAME] as it is written."""

    host: str
    robot_id: RobotId
    user: _User = "root"
    port: _Port | None = None
    address: str | None = None
    zenoh_port: _Port = 7447
    system_id: SystemId | None = None
    mavlink_url: str | None = None
    cpus: str = ""
    robot: dict = field(default_factory=dict)  # type: ignore[type-arg]

    def check_rules(self) -> None:
        require_host("host", self.host)
        if self.system_id is None and not 1 <= self.robot_id <= 255:
            raise ValueError(
                f"system_id is missing: robot_id = {self.robot_id} is not from 1 to 255"
            )
        if self.address is not None and not is_of_computer(self.address):
            raise ValueError(f"address = {self.address!r}: must be a computer's own IPv4 address")
        if self.address is None and not is_of_computer(self.host):
            raise ValueError(
                f"address is missing: host = {self.host!r} is no IPv4 address, by which the other "
                "robots could reach it"
            )
        if self.mavlink_url is not None:
            require_url("mavlink_url", self.mavlink_url)
        _cpus(self.cpus)


@dataclass(frozen=True, slots=True)
class FleetTable(Bounded):
    """fleet.toml as it is written."""

    fleet: PlainName
    image: _Path
    bundle: _Path
    world: _Path
    directory: _Directory = DEFAULT_DIRECTORY
    predecessors: tuple[_Unit, ...] = ()
    keys: str = ""
    insecure: bool = False
    ssh: SshConfig = field(default_factory=SshConfig)
    radio: RadioConfig = field(default_factory=RadioConfig)
    robot: dict = field(default_factory=dict)  # type: ignore[type-arg]
    robots: dict[PlainName, object] = field(default_factory=dict)
    slots: tuple[Slot, ...] = ()

    def check_rules(self) -> None:
        if self.insecure and self.keys:
            raise ValueError("insecure = true: not with keys: leave one of them out")


def read_fleet(path: Path) -> str:
    """The file's text, its ends of lines as they are. Raises ConfigError."""
    if not path.exists():
        raise ConfigError(
            f"{path}: cannot be read: there is no such file: give --fleet, or set LPAC_FLEET"
        )
    return read_toml_text(path)


def parse_fleet(path: Path, text: str) -> FleetConfig:
    """The fleet that a file of this text would describe. Raises ConfigError."""
    mapping = parse_toml(text, path)
    slots = mapping.get("slots")
    if isinstance(slots, list) and all(isinstance(slot, dict) for slot in slots):
        mapping["slots"] = [{"height": i} | _without_empty(slot) for i, slot in enumerate(slots)]
    table = from_mapping(FleetTable, mapping, str(path))
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
        keys=None,
        insecure=table.insecure,
        radio=table.radio,
    )
    needs_keys = not table.insecure and not _is_all_here(config)
    if table.keys or needs_keys:
        config = replace(config, keys=place(table.keys or f"{_KEYS}/{table.fleet}"))
    for mistake in itertools.chain(_shared_by_two(config), _sittings(config)):
        raise ConfigError(f"{path}: {mistake}")
    _check_flights(config)
    return config


def _is_all_here(config: FleetConfig) -> bool:
    """Whether it is a fleet that this computer simulates."""
    return bool(config.robots) and all(map(is_loopback_endpoint, config.endpoints))


def _without_empty(slot: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in slot.items() if (key, value) != ("robot", "")}


def _robot(name: str, mapping: object, shared: Mapping[str, Any], where: str) -> RobotHost:
    table = from_mapping(RobotTable, mapping, where)
    _check_keys(table.robot, _OF_ONE_ROBOT_ELSEWHERE, f"{where}.robot")
    autopilot = from_mapping(
        AutopilotConfig,
        {
            **_merged(shared, table.robot).get("autopilot", {}),
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


def is_of_computer(text: str) -> bool:
    """Whether it is an IPv4 address by which others can reach one: not 0.0.0.0, no multicast."""
    address = ipv4(text)
    return address is not None and 1 <= address.packed[0] <= 223


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
            raise ConfigError(f"{where}: {head} = {inner!r}: must be a table")
        if (rest in inner) if rest else (head in table):
            raise ConfigError(f"{where}: {key} must not be set here: {place}")


def _shared_by_two(config: FleetConfig) -> Iterator[str]:
    owners: dict[str, str] = {}
    for robot in config.robots.values():
        for value in (
            f"robot_id = {robot.robot_id}",
            f"system_id = {robot.system_id}",
            f"host = {same_host(robot.host)!r}, port = {robot.port or 22}",
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


def _robot_mapping(
    config: FleetConfig, robot: RobotHost, slot: Slot, places: Places
) -> dict[str, Any]:
    """The robot's robot.toml, in that slot."""
    # A fleet that is all on this computer needs no keys, and nobody else reaches it.
    listen = places.listen if config.keys or config.insecure else "127.0.0.1"
    link: dict[str, Any] = {
        "listen": [f"{config.scheme}/{listen}:{robot.zenoh_port}"],
    }
    if config.radio.transport == "mesh":
        earlier = (other for other in config.robots.values() if other.robot_id < robot.robot_id)
        link["connect"] = list(map(config.endpoint, sorted(earlier, key=lambda r: r.robot_id)))
    else:
        link |= {"group": config.radio.group, "interface": robot.address}
    if config.radio.type != "zenoh":
        link |= {"type": config.radio.type, "options": config.radio.options}
    own = {
        "fleet": config.fleet,
        "robot_id": robot.robot_id,
        "policy": {"bundle": places.bundle, "world": places.world},
        "autopilot": {"url": robot.mavlink_url, "system_id": robot.system_id},
        "link": {
            **link,
            **({"insecure": True} if config.insecure else {}),
        },
        "flight": {"slot": slot.height, "landing_point_m": list(slot.landing_point_m)},
        "log": {"folder": places.logs},
        **({} if config.keys is None else {"identity": {"folder": places.identity}}),
    }
    return _merged(config.values_of(robot), own)


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
    return from_mapping(RobotConfig, _robot_mapping(config, robot, slot, IN_RELEASE), where)
