"""One robot's configuration: TOML into frozen dataclasses.

Relative paths start at the file's folder. An error is one line with the file, the key, the value
and what is allowed.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta

from edge.core.address import (
    host_and_port,
    ipv4,
    is_loopback,
    is_loopback_endpoint,
    require_endpoint,
    require_host,
)
from edge.core.fence import Fence
from edge.core.frames import ModelScale
from edge.core.position import PositionLimits
from edge.core.schema import MAX_FLOAT, Bounded, ConfigError, NonNegative, Positive, from_mapping
from edge.core.toml import read_toml
from edge.core.wire import PAYLOAD_TYPES, PayloadType
from edge.flight.energy import EnergyParameters
from edge.flight.failsafe import required
from edge.flight.margins import ErrorBudget, Margin
from edge.flight.preflight import PreflightLimits
from edge.flight.reach import Reach
from edge.flight.safety import MotionLimits
from edge.flight.state import FlightParameters, RemoteControlLost, Robot
from edge.messages.bounds import RobotId
from edge.robot.pac import PacParameters

# Also of fleet.toml. Each function raises ValueError, one line that says what is allowed.

# Name of a fleet, robot or site: a part of radio keys and file names.
PlainName = Annotated[
    str,
    Meta(
        pattern=r"\A[A-Za-z0-9_][A-Za-z0-9_-]{0,31}\Z",
        description="1 to 32 letters, digits, '-' and '_', and not start with '-'",
    ),
]
# PX4's MAV_SYS_ID.
SystemId = Annotated[int, Meta(ge=1, le=255)]
_LoopRate = Annotated[float, Meta(ge=0.1, le=100.0)]


def require_url(key: str, url: str) -> None:
    """Raise ValueError unless `url` is udpin://ADDRESS:PORT, where PX4's datagrams arrive."""
    match = re.fullmatch(r"udpin://([^:/]+):([0-9]{1,5})", url)
    if match is None:
        raise ValueError(f"{key} = {url!r}: must be udpin://ADDRESS:PORT")
    require_host(key, match[1])
    if not 1 <= int(match[2]) <= 65535:
        raise ValueError(f"{key} = {url!r}: its port must be from 1 to 65535")


def require_group(key: str, group: str) -> tuple[str, int]:
    """Return the address and the port of a multicast group."""
    found = host_and_port(key, group)
    address = None if found is None else ipv4(found[0])
    # 224.0.0.0/24 is reserved for network protocols.
    is_group = (
        address is not None and address.is_multicast and address.packed[:3] != b"\xe0\x00\x00"
    )
    if found is None or not is_group or found[1] == 0:
        raise ValueError(
            f"{key} = {group!r}: must be an IPv4 multicast address, none of 224.0.0.0/24, and a "
            "port from 1 to 65535, such as '239.255.76.80:7450'"
        )
    return found


@dataclass(frozen=True, slots=True)
class SensorConfig:
    """The sensor: a `type` of `edge.drivers.registry`, and its `options`."""

    type: str = "world"
    options: dict[str, object] = field(default_factory=dict, hash=False)


@dataclass(frozen=True, slots=True)
class AutopilotConfig(Bounded):
    """The vehicle: a `type` of `edge.drivers.registry`, and its `options`.

    `url` receives PX4's datagrams, e.g. udpin://127.0.0.1:14551; `system_id` is PX4's. Any other
    address than 127.0.0.1 requires `insecure`, since anybody on its network can pose as the
    vehicle.
    """

    url: str
    system_id: SystemId
    type: str = "px4"
    insecure: bool = False
    options: dict[str, object] = field(default_factory=dict, hash=False)

    def check_rules(self) -> None:
        if self.type == "px4":
            require_url("url", self.url)
            if not (self.insecure or is_loopback(self.url[len("udpin://") :].rpartition(":")[0])):
                raise ValueError(
                    f"url = {self.url!r}: anybody on that network could pose as the vehicle: must "
                    "be at 127.0.0.1; where PX4 has a wire of its own, set insecure = true"
                )


def port_of(url: str) -> int:
    """The UDP port of an URL that `require_url` accepts."""
    return int(url.rpartition(":")[2])


@dataclass(frozen=True, slots=True)
class LinkConfig:
    """The radio: zenoh endpoints to listen on and connect to, or scouting.

    Members of a fleet ([identity]) use TLS endpoints, such as tls/192.168.8.10:7447; others use
    tcp. Without an identity, anybody on the network can fly the robot: beyond this machine that
    requires `insecure`. With `group`, robots send to each other by multicast to that IPv4 address
    and port, in the network of their own address `interface`, and grounds connect to them. `type`
    is one of `edge.drivers.registry`; `options` are another type's.
    """

    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    scouting: bool = False
    group: str = ""
    interface: str = ""
    insecure: bool = False
    type: str = "zenoh"
    options: dict[str, object] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        if self.type != "zenoh":
            return
        if not (self.listen or self.connect or self.scouting):
            raise ValueError("listen, connect and scouting: one of them must be set")
        for name in ("listen", "connect"):
            for endpoint in getattr(self, name):
                require_endpoint(name, endpoint, "tls", "tcp")
        if self.group:
            require_group("group", self.group)
        has_interface = ipv4(self.interface) is not None
        if bool(self.group) != has_interface or (self.interface and not has_interface):
            raise ValueError(
                f"interface = {self.interface!r}: must be the robot's own IPv4 address with group, "
                "and empty without"
            )

    @property
    def leaves_machine(self) -> bool:
        """Whether messages from other computers may arrive."""
        if self.type != "zenoh" or self.scouting or not self.listen:
            return True
        if self.group and not self.interface.startswith("127."):
            return True
        return not all(map(is_loopback_endpoint, (*self.listen, *self.connect)))


@dataclass(frozen=True, slots=True)
class IdentityConfig:
    """Folder with the identity that `lpac fleet enroll` wrote; "": not a member of a fleet."""

    folder: str = ""


@dataclass(frozen=True, slots=True)
class Rates(Bounded):
    """Rates of the three loops, Hz."""

    perception_hz: _LoopRate = 5.0
    policy_hz: _LoopRate = 2.5
    control_hz: Annotated[
        float,
        Meta(ge=4.0, le=100.0, description="from 4 to 100: PX4 needs setpoints at 4 Hz or more"),
    ] = 10.0


@dataclass(frozen=True, slots=True)
class PolicyConfig(Bounded):
    """The bundle, the world it flies over, and the paper's scales.

    `payload` is the encoding of its messages, by default the smallest that the policy was judged
    with.
    """

    bundle: str
    world: str
    env_scale: Positive = 16.0
    velocity_scale: Positive = 0.25
    max_message_age_s: NonNegative = 0.8
    max_input_age_s: Positive = 1.0
    payload: Literal["smallest", PayloadType] = "smallest"

    def payload_of(self, judged: Sequence[PayloadType]) -> PayloadType:
        """Encoding of messages, one of those that the policy was `judged` with.

        Raises ConfigError if the configured one is not among them.
        """
        if self.payload == "smallest":
            return max(judged, key=PAYLOAD_TYPES.index)
        if self.payload not in judged:
            raise ConfigError(
                f"policy: payload = {self.payload!r}: {self.bundle} was judged with "
                f"{', '.join(judged)} alone (`lpac evaluate --payload`)"
            )
        return self.payload


@dataclass(frozen=True, slots=True)
class FailsafeConfig(Bounded):
    """PX4's failsafes, with an RC pilot or without.

    `parameters`: whether the program sets wrong PX4 parameters, also in flight after somebody
    changed them, or refuses to arm. PX4's fence is `fence_margin_m` outside the robot's. `rc_lost`
    is the reaction in flight to the loss of the pilot's remote control.
    """

    rc: Literal["pilot", "none"]
    rc_lost: RemoteControlLost = "alarm"
    parameters: Literal["set", "refuse"] = "refuse"
    fence_margin_m: NonNegative = 5.0


@dataclass(frozen=True, slots=True)
class LogConfig(Bounded):
    """The flight log's folder and size, MB."""

    folder: str = "logs"
    max_total_mb: Annotated[float, Meta(ge=50.0, le=MAX_FLOAT)] = 2000.0


@dataclass(frozen=True, slots=True)
class RobotConfig(Bounded):
    """All of robot.toml. `on_stop` is a flying vehicle's action when the program stops."""

    fleet: PlainName
    robot_id: RobotId
    policy: PolicyConfig
    autopilot: AutopilotConfig
    link: LinkConfig
    flight: FlightParameters
    fence: Fence
    limits: MotionLimits
    failsafe: FailsafeConfig
    identity: IdentityConfig = field(default_factory=IdentityConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    energy: EnergyParameters = field(default_factory=EnergyParameters)
    errors: ErrorBudget = field(default_factory=ErrorBudget)
    reach: Reach = field(default_factory=Reach)
    rates: Rates = field(default_factory=Rates)
    preflight: PreflightLimits = field(default_factory=PreflightLimits)
    position: PositionLimits = field(default_factory=PositionLimits)
    log: LogConfig = field(default_factory=LogConfig)
    on_stop: Literal["hold", "land"] = "hold"

    def check_rules(self) -> None:
        if self.identity.folder and self.link.insecure:
            raise ValueError("link.insecure = true: not with [identity] folder")
        if self.link.leaves_machine and not (self.identity.folder or self.link.insecure):
            raise ValueError(
                "[identity] folder is missing: anybody on the network could fly this robot: enroll "
                "it (`lpac fleet enroll`), or set link.insecure = true"
            )
        if self.flight.command_timeout_s * self.rates.control_hz < 2.0:
            raise ValueError(
                f"flight: command_timeout_s = {self.flight.command_timeout_s}: must be at least "
                f"two periods of rates: control_hz = {self.rates.control_hz}"
            )
        self._check_schemes()
        # Errors that only show when the tables are combined.
        required(self.failsafe.rc, self.fence.ceiling_m, self.flight.command_timeout_s)
        self.robot(boot_nonce=0)
        beyond = self.errors.px4_fence(self.limits)
        if not beyond.holds(self.failsafe.fence_margin_m):
            raise ValueError(f"failsafe: fence_margin_m = {self.failsafe.fence_margin_m}: {beyond}")

    def _check_schemes(self) -> None:
        if self.link.type != "zenoh":
            return
        is_member = bool(self.identity.folder)
        for name in ("listen", "connect"):
            for endpoint in getattr(self.link, name):
                if endpoint.startswith("tls/") != is_member:
                    must = "tls, with [identity]" if is_member else "tcp, without [identity]"
                    raise ValueError(f"link: {name} = {endpoint!r}: must be {must}")

    def robot(self, boot_nonce: int) -> Robot:
        """The configured robot, for this start of its program."""
        return Robot(
            self.robot_id,
            boot_nonce,
            self.flight,
            self.fence,
            self.limits,
            None if self.failsafe.rc == "none" else self.failsafe.rc_lost,
            self.errors,
            self.reach,
        )

    @property
    def free_ground(self) -> Margin:
        """Distance around its fence that people must keep clear of, whatever fails."""
        beyond_m, ceiling_m = self.failsafe.fence_margin_m, self.fence.ceiling_m
        return self.errors.free_ground(self.limits, beyond_m, ceiling_m)

    def pac(self, judged: Sequence[PayloadType]) -> PacParameters:
        """Parameters of the perception-action-communication loop; see `PolicyConfig.payload_of`."""
        policy = self.policy
        return PacParameters(
            scale=ModelScale(policy.env_scale, policy.velocity_scale),
            max_speed_m_s=self.limits.max_speed_m_s,
            max_message_age_s=policy.max_message_age_s,
            max_input_age_s=policy.max_input_age_s,
            payload=policy.payload_of(judged),
        )


def load_config(path: Path) -> RobotConfig:
    """The configuration in the file, with absolute paths. Raises ConfigError."""
    mapping = read_toml(path)
    folder = path.resolve().parent
    for table, key in (
        ("policy", "bundle"), ("policy", "world"), ("log", "folder"), ("identity", "folder"),
    ):  # fmt: skip
        section = mapping.get(table)
        if isinstance(section, dict) and isinstance(section.get(key), str) and section[key]:
            section[key] = str(folder / section[key])
    mapping.setdefault("log", {})
    if isinstance(mapping["log"], dict):
        mapping["log"].setdefault("folder", str(folder / "logs"))
    return from_mapping(RobotConfig, mapping, str(path))
