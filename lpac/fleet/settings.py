"""fleet.toml: the fleet's robots, how to reach them, and their slots.

A robot is a computer with a vehicle; a slot is a place in the flight: pad, height, landing point.
A robot without a slot is a spare. Paths are relative to the file's folder; "~" is the user's home.
An error is one line that names the file, the key, the robot and what is allowed.
"""

import itertools
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from edge.core.address import ipv4, is_loopback, require_host, same_host
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

# Default folder of keys: not beside the file, which may be in a repository.
_KEYS = "~/.local/share/lpac/keys"
_MAX_CPU = 1023

_GROUP = "239.255.76.80:7450"

# These get on ssh's command lines and into systemd's files.
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

# Keys of robot.toml that [robot] must not have, and where they are set instead.
_SET_ELSEWHERE = {
    "fleet": "it is `fleet` at the top of the file",
    "robot_id": "it is `robot_id` in [robots.NAME]",
    "policy.bundle": "it is `bundle` at the top of the file",
    "policy.world": "it is `world` at the top of the file",
    "autopilot.system_id": "it is `system_id` in [robots.NAME]",
    "identity": "it follows from `keys` at the top of the file",
    "link": "it follows from [radio], and `address` and `zenoh_port` in [robots.NAME]; for your "
    "own radio set `type` and `options` in [radio]",
    "flight.slot": "it is `height` in [[slots]]",
    "flight.landing_point_m": "it is `landing_point_m` in [[slots]]",
    "log.folder": "robots log to /var/lib/lpac/logs",
}
_SET_ELSEWHERE_FOR_ONE = _SET_ELSEWHERE | {
    "autopilot.url": "it is `mavlink_url` in [robots.NAME]",
}


@dataclass(frozen=True, slots=True)
class SshConfig(Bounded):
    """Options of ssh. `config` is the file for `ssh -F`; empty for OpenSSH's own files."""

    config: str = ""
    connect_timeout_s: Annotated[float, Meta(ge=1.0, le=300.0)] = 5.0


@dataclass(frozen=True, slots=True)
class RadioConfig(Bounded):
    """How messages travel between robots.

    "mesh": every robot connects to every other and sends to each. "multicast": a robot sends to all
    at once, in `group` (multicast address and port). A ground connects to all robots either way.
    `type` and `options` are robot.toml's `link.type` and `link.options`, for your own radio, which
    gets the other settings too.
    """

    transport: Transport = "mesh"
    group: str = _GROUP
    type: Annotated[
        str, Meta(min_length=1, description="'zenoh', or the name of your own radio")
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
    """A place in the flight; `robot` is None if it is free.

    `height` is robot.toml's `flight.slot`. `pad_m` and `landing_point_m` are (x, y), mission frame.
    """

    height: SlotNumber
    pad_m: PointXY
    landing_point_m: PointXY
    robot: str | None = None


@dataclass(frozen=True, slots=True)
class RobotHost:
    """A robot, and how to reach it.

    `host`, `user` and `port` are for ssh; `host` may be a name from ssh's configuration, which also
    applies if `port` is None. The other robots connect to `address` (IPv4) and `zenoh_port`. PX4
    sends MAVLink to `mavlink_url`; `system_id` is its MAV_SYS_ID. The program runs on `cpus`, empty
    for all. `overrides` are the robot's own values of robot.toml.
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
        """Whether ssh can reach its computer; False for robots of `lpac sim`."""
        return not self.host.endswith(".invalid")

    @property
    def mavlink_port(self) -> int:
        """The UDP port of `mavlink_url`."""
        return port_of(self.mavlink_url)


@dataclass(frozen=True, slots=True)
class RobotPaths:
    """Paths in a robot.toml, and the address that the robot listens on."""

    bundle: str
    world: str
    identity: str
    logs: str
    listen: str


# In the unit's sandbox, whose working directory is /release. The robot listens on all addresses,
# since it may not have its own one yet at boot or without the access point.
IN_RELEASE = RobotPaths(
    "bundle", "world.env", "/var/lib/lpac/identity", "/var/lib/lpac/logs", "0.0.0.0"
)


@dataclass(frozen=True, slots=True)
class FleetConfig:
    """A checked fleet.toml; `shared` are the values of robot.toml that all robots have.

    `directory` is the robots' folder of releases; `predecessors` are containers and units that must
    not run beside the robot's program. `keys` is the folder of this computer's identity in the
    fleet. It is None without keys: in a fleet that is all on this computer, or is `insecure`
    (anyone who reaches the radio can fly it).
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
        """Zenoh endpoints of all robots."""
        return tuple(map(self.endpoint, self.robots.values()))

    @property
    def scheme(self) -> str:
        """Protocol of the zenoh endpoints."""
        return "tcp" if self.keys is None else "tls"

    def slot_of(self, name: str) -> Slot | None:
        """Slot of the robot; None for a spare."""
        return next((slot for slot in self.slots if slot.robot == name), None)

    def free_ground(self) -> Margin | None:
        """Distance around the fence that must be free of people, whatever fails.

        The greatest of all robots' margins, each from its own fence; None if no robot has a slot.
        """
        flying = [(i, self.robots[s.robot]) for i, s in enumerate(self.slots) if s.robot]
        margins = [_robot_config(self, robot, i).free_ground for i, robot in flying]
        return max(margins, default=None)

    def values_of(self, robot: RobotHost) -> dict[str, Any]:
        """The robot's values of robot.toml: [robot], overridden by its own."""
        return _merged(self.shared, robot.overrides)

    def robot_mapping(self, name: str, paths: RobotPaths) -> dict[str, Any]:
        """The robot's robot.toml as a mapping.

        Raises ConfigError for an unknown robot or a spare.
        """
        (robot,) = select(self, name)
        slot = self.slot_of(name)
        if slot is None:
            raise ConfigError(f"{self.path}: robots.{name}: is a spare: it has no slot")
        return _robot_mapping(self, robot, slot, paths)

    def robot_config(self, name: str) -> RobotConfig:
        """The robot's configuration. Raises ConfigError for an unknown robot or a spare."""
        return from_mapping(RobotConfig, self.robot_mapping(name, IN_RELEASE), str(self.path))


def load_fleet(path: Path) -> FleetConfig:
    """Load a fleet.toml, with absolute paths. Raises ConfigError."""
    return parse_fleet(path, read_fleet(path))


def select(config: FleetConfig, names: str | None) -> list[RobotHost]:
    """Robots of a list such as "r1,r3" (None: all), in the order of the slots, then the spares.

    Raises ConfigError for an unknown name or if there is no robot.
    """
    flying = [slot.robot for slot in config.slots if slot.robot is not None]
    order = list(dict.fromkeys([*flying, *config.robots]))
    known = f"known are {', '.join(order)}" if order else "the file has no robots yet"
    asked = order if names is None else [n for n in map(str.strip, names.split(",")) if n]
    for name in asked:
        if name not in config.robots:
            raise ConfigError(f"{config.path}: robots: {name!r} is unknown; {known}")
    if not asked:
        raise ConfigError(f"{config.path}: robots: none is chosen; {known}")
    return [config.robots[name] for name in order if name in asked]


@dataclass(frozen=True, slots=True)
class RobotTable(Bounded):
    """Table [robots.NAME] of the file."""

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
        if self.address is not None and not is_host_address(self.address):
            raise ValueError(f"address = {self.address!r}: must be a computer's own IPv4 address")
        if self.address is None and not is_host_address(self.host):
            raise ValueError(
                f"address is missing: host = {self.host!r} is not an IPv4 address, which the other "
                "robots need"
            )
        if self.mavlink_url is not None:
            require_url("mavlink_url", self.mavlink_url)
        _cpus(self.cpus)


@dataclass(frozen=True, slots=True)
class FleetTable(Bounded):
    """The whole file."""

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
            raise ValueError("insecure = true: excludes keys: remove one of them")


def read_fleet(path: Path) -> str:
    """Text of the file with its own line endings. Raises ConfigError."""
    if not path.exists():
        raise ConfigError(f"{path}: cannot be read: no such file: give --fleet, or set LPAC_FLEET")
    return read_toml_text(path)


def parse_fleet(path: Path, text: str) -> FleetConfig:
    """Parse the text of a fleet.toml at `path`. Raises ConfigError."""
    mapping = parse_toml(text, path)
    slots = mapping.get("slots")
    if isinstance(slots, list) and all(isinstance(slot, dict) for slot in slots):
        mapping["slots"] = [{"height": i} | _without_empty(slot) for i, slot in enumerate(slots)]
    table = from_mapping(FleetTable, mapping, str(path))
    _check_keys(table.robot, _SET_ELSEWHERE, f"{path}: robot")
    folder = path.resolve().parent

    def place(text: str) -> Path:
        try:
            return folder / Path(text).expanduser()
        except RuntimeError:
            raise ConfigError(f"{path}: {text!r}: unknown user: no home folder") from None

    robots = {
        name: _robot(name, robot, table.robot, f"{path}: robots.{name}")
        for name, robot in table.robots.items()
    }
    # As in a simulation.
    all_here = bool(robots) and all(is_loopback(robot.address) for robot in robots.values())
    keys = table.keys or ("" if table.insecure or all_here else f"{_KEYS}/{table.fleet}")
    config = FleetConfig(
        path=path,
        fleet=table.fleet,
        image=place(table.image),
        bundle=place(table.bundle),
        world=place(table.world),
        directory=table.directory,
        predecessors=table.predecessors,
        ssh=replace(table.ssh, config=table.ssh.config and str(place(table.ssh.config))),
        robots=robots,
        slots=table.slots,
        shared=table.robot,
        keys=place(keys) if keys else None,
        insecure=table.insecure,
        radio=table.radio,
    )
    for mistake in itertools.chain(_duplicates(config), _slot_mistakes(config)):
        raise ConfigError(f"{path}: {mistake}")
    _check_flights(config)
    return config


def _without_empty(slot: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in slot.items() if (key, value) != ("robot", "")}


def _robot(name: str, mapping: object, shared: Mapping[str, Any], where: str) -> RobotHost:
    table = from_mapping(RobotTable, mapping, where)
    _check_keys(table.robot, _SET_ELSEWHERE_FOR_ONE, f"{where}.robot")
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


def is_host_address(text: str) -> bool:
    """Whether it is an IPv4 address of a host: not 0.0.0.0, not multicast."""
    address = ipv4(text)
    return address is not None and 1 <= address.packed[0] <= 223


def _cpus(text: str) -> tuple[int, ...]:
    """Parse a list of CPUs such as "0,4-6"."""
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
    """Raises ConfigError for a key of robot.toml that is set elsewhere."""
    for key, place in elsewhere.items():
        head, _, rest = key.partition(".")
        inner = table.get(head, {})
        if rest and not isinstance(inner, dict):
            raise ConfigError(f"{where}: {head} = {inner!r}: must be a table")
        if (rest in inner) if rest else (head in table):
            raise ConfigError(f"{where}: {key} must not be set here: {place}")


def _duplicates(config: FleetConfig) -> Iterator[str]:
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


def _slot_mistakes(config: FleetConfig) -> Iterator[str]:
    for i, slot in enumerate(config.slots):
        if slot.robot is not None and slot.robot not in config.robots:
            known = ", ".join(config.robots) or "none"
            yield f"slots[{i}]: robot = {slot.robot!r}: is not in [robots]; known are {known}"
        for j, other in enumerate(config.slots[:i]):
            if slot.robot is not None and slot.robot == other.robot:
                yield f"slots[{i}]: robot = {slot.robot!r}: slots[{j}] has it too"
            if slot.height == other.height:
                yield (
                    f"slots[{i}]{_occupant(slot)}: height = {slot.height}: slots[{j}]"
                    f"{_occupant(other)} has it too"
                )


def _occupant(slot: Slot) -> str:
    return f" (robot {slot.robot})" if slot.robot is not None else ""


def _robot_mapping(
    config: FleetConfig, robot: RobotHost, slot: Slot, paths: RobotPaths
) -> dict[str, Any]:
    """The robot's robot.toml if it had that slot."""
    # A local fleet without keys must not be reachable from elsewhere.
    listen = paths.listen if config.keys or config.insecure else "127.0.0.1"
    link: dict[str, Any] = {"listen": [f"{config.scheme}/{listen}:{robot.zenoh_port}"]}
    if config.radio.transport == "mesh":
        earlier = (other for other in config.robots.values() if other.robot_id < robot.robot_id)
        link["connect"] = list(map(config.endpoint, sorted(earlier, key=lambda r: r.robot_id)))
    else:
        link |= {"group": config.radio.group, "interface": robot.address}
    if config.radio.type != "zenoh":
        link |= {"type": config.radio.type, "options": config.radio.options}
    if config.insecure:
        link["insecure"] = True
    own: dict[str, Any] = {
        "fleet": config.fleet,
        "robot_id": robot.robot_id,
        "policy": {"bundle": paths.bundle, "world": paths.world},
        "autopilot": {"url": robot.mavlink_url, "system_id": robot.system_id},
        "link": link,
        "flight": {"slot": slot.height, "landing_point_m": list(slot.landing_point_m)},
        "log": {"folder": paths.logs},
    }
    if config.keys is not None:
        own["identity"] = {"folder": paths.identity}
    return _merged(config.values_of(robot), own)


def _merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Merge two tables recursively; `above` takes precedence."""
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
    """Raises ConfigError unless every robot can fly in its slot, and a spare in the first."""
    if not (config.robots and config.slots):
        return
    first = next(iter(config.robots.values()))
    flights = []
    for i, slot in enumerate(config.slots):
        robot = first if slot.robot is None else config.robots[slot.robot]
        flights.append(_robot_config(config, robot, i))
    for robot in config.robots.values():
        if config.slot_of(robot.name) is None:
            _robot_config(config, robot, 0)
    for i, (slot, flight) in enumerate(zip(config.slots, flights, strict=True)):
        where = f"{config.path}: slots[{i}]{_occupant(slot)}"
        fence = flight.fence
        if not fence.distance_m(*slot.pad_m) >= fence.buffer_m:
            raise ConfigError(
                f"{where}: pad_m = {list(slot.pad_m)}: must be inside the fence, at least "
                f"buffer_m = {fence.buffer_m:g} from its line"
            )
        for j, (other, its) in enumerate(zip(config.slots[:i], flights[:i], strict=True)):
            neighbour = f"slots[{j}]{_occupant(other)}"
            separation_m = max(flight.flight.min_separation_m, its.flight.min_separation_m)
            margin = places_apart(flight.errors.position_m, its.errors.position_m)
            margin = margin.or_at_least(separation_m, "min_separation_m")
            # Pads count too: a robot that did not take off stays there while the others land.
            for name, its_name in itertools.product(("pad_m", "landing_point_m"), repeat=2):
                apart_m = math.dist(getattr(slot, name), getattr(other, its_name))
                if not margin.holds(apart_m):
                    raise ConfigError(
                        f"{where}: {name} = {list(getattr(slot, name))}: is {apart_m:.1f} m from "
                        f"{its_name} of {neighbour}, {margin}"
                    )
            margin = max(flight.errors.slot_spacing, its.errors.slot_spacing)
            margin = margin.or_at_least(separation_m, "min_separation_m")
            apart_m = abs(flight.flight.slot_height_m - its.flight.slot_height_m)
            if not margin.holds(apart_m):
                raise ConfigError(
                    f"{where}: height = {slot.height}: is {flight.flight.slot_height_m:g} m, "
                    f"{apart_m:.1f} m from that of {neighbour}, {margin}"
                )


def _robot_config(config: FleetConfig, robot: RobotHost, index: int) -> RobotConfig:
    slot = config.slots[index]
    sits = "in" if slot.robot == robot.name else "if it took"
    where = f"{config.path}: robots.{robot.name}, {sits} slots[{index}]"
    return from_mapping(RobotConfig, _robot_mapping(config, robot, slot, IN_RELEASE), where)
