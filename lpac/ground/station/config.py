"""Configuration of `lpac ground`."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from edge.core.schema import ConfigError
from edge.core.world import parse_world
from edge.drivers.identity_folder import Identity, load_identity
from edge.identity.members import Role
from edge.messages.mission import Place, world_id
from edge.policy.bundle import load_bundle
from lpac.analysis.snapshot import FleetSetup, FleetSlot
from lpac.fleet.settings import FleetConfig, load_fleet


@dataclass(frozen=True, slots=True)
class GroundConfig:
    """The fleet's `setup`, the robots' zenoh endpoints, and this station's identity.

    `identity` is None in a fleet without keys.
    """

    setup: FleetSetup
    connect: tuple[str, ...]
    identity: Identity | None = None


def load_ground(
    path: Path, operator: str | None, *, default_name: Callable[[], str] = lambda: ""
) -> GroundConfig:
    """Load the ground station's configuration from a fleet.toml. Raises ValueError or OSError.

    In a fleet with keys, the station's name is the one in the list of members; `operator` must be
    None or equal it.
    """
    config = load_fleet(path)
    identity = load_own_identity(config, operator)
    name = operator or default_name() if identity is None else identity.membership.own.name
    seated = next((slot.robot for slot in config.slots if slot.robot), None)
    if seated is None:
        raise ValueError(f"{path}: slots: no robot has one")
    robot = config.robot_config(seated)
    bundle = load_bundle(config.bundle)
    perception, training = bundle.manifest.perception, bundle.manifest.training
    if perception is None:
        raise ValueError(f"{config.bundle}: the bundle has no perception: it cannot fly")
    world = config.world.read_text("utf-8-sig")
    parse_world(world, str(config.world))
    return GroundConfig(
        setup=FleetSetup(
            fleet=config.fleet,
            operator=name,
            robots={name: host.robot_id for name, host in config.robots.items()},
            slots=tuple(
                FleetSlot(Place(slot.height, slot.landing_point_m), slot.pad_m, slot.robot or "")
                for slot in config.slots
            ),
            fence=robot.fence,
            world=world,
            world_id=world_id(world),
            bundle_id=bundle.id,
            world_size=perception.world_size,
            sensor_size=perception.sensor_size,
            communication_range=perception.communication_range,
            env_scale=robot.policy.env_scale,
            truncation=training.idf_truncation,
            norm=training.idf_norm,
            base_height_m=robot.flight.base_height_m,
            slot_spacing_m=robot.flight.slot_spacing_m,
            errors=robot.errors,
            battery_critical=robot.flight.battery_critical,
            ground_timeout_s=robot.flight.ground_timeout_s,
            ground_lost_land_s=robot.flight.ground_lost_land_s,
            insecure=config.insecure,
        ),
        connect=config.endpoints,
        identity=identity,
    )


def load_own_identity(config: FleetConfig, operator: str | None) -> Identity | None:
    """Identity of this computer; None in a fleet without keys. Raises ConfigError or OSError.

    `operator` is the name that it must have, if given.
    """
    if config.keys is None:
        return None
    identity = load_identity(config.keys, fleet=config.fleet, unix_s=time.time())
    own = identity.membership.own
    if own.role is Role.ROBOT:
        raise ConfigError(f"{config.keys}: belongs to robot {own.name}, not to a ground station")
    if operator not in (None, own.name):
        raise ConfigError(
            f"--name {operator!r}: this station is {own.name!r} in the list of members: leave "
            "--name out"
        )
    return identity
