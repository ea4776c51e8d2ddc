"""What robot.toml and a bundle's manifest choose by name; installed packages can add to it.

A package adds a type by an entry point, named as the type, of the group of its kind:

    [project.entry-points."lpac_edge.sensors"]
    camera = "my_package.camera:camera_sensor"

The groups are `lpac_edge.policies` (`edge.policy.family.PolicyFamily`), `lpac_edge.sensors`
(`edge.core.ports.SensorDriver`), `lpac_edge.vehicles` (`edge.core.ports.VehicleDriver`) and
`lpac_edge.links` (`edge.messages.topics.LinkDriver`); on a workstation that trains also
`lpac_edge.learnable` (`lpac.train.family.LearnableFamily`).
"""

from collections.abc import Mapping
from contextlib import AbstractContextManager
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from edge.core.ports import (
    OpenVehicle,
    SensorDriver,
    SensorOver,
    SensorSetting,
    VehicleDriver,
    VehicleSetting,
)
from edge.core.schema import ConfigError
from edge.messages.topics import Link, LinkDriver, LinkSetting
from edge.policy.bundle import Bundle, BundleError, Manifest, load_bundle
from edge.policy.family import Policy, PolicyFamily, VerifiedPolicy, verified

_POLICIES, _SENSORS = "lpac_edge.policies", "lpac_edge.sensors"
_VEHICLES, _LINKS = "lpac_edge.vehicles", "lpac_edge.links"
_LEARNABLE = "lpac_edge.learnable"
# What every installation has, and no package can replace.
_BUILT_IN = {
    (entry.group, entry.name): entry
    for entry in (
        EntryPoint("lpac", "edge.policy.lpac.policy:LpacPolicy", _POLICIES),
        EntryPoint("world", "edge.drivers.world_sensor:world_sensor", _SENSORS),
        EntryPoint("px4", "edge.drivers.px4.driver:px4_vehicle", _VEHICLES),
        EntryPoint("zenoh", "edge.drivers.radio:zenoh_radio", _LINKS),
        EntryPoint("lpac", "lpac.train.lpac:lpac_network", _LEARNABLE),
    )
}


def load_policy(bundle: Bundle) -> Policy:
    """The bundle's policy. Raises ConfigError for an unknown family; BundleError."""
    family: PolicyFamily = _load(_POLICIES, bundle.manifest.family, "policy: family")
    return family(bundle)


def load_verified_policy(path: Path) -> VerifiedPolicy:
    """The policy of a bundle, tried on this CPU. Raises ConfigError, BundleError or OSError."""
    bundle = load_bundle(path)
    if bundle.manifest.perception is None:
        raise BundleError(f"{path}: the bundle has no perception: it cannot fly")
    return verified(load_policy(bundle))


def load_learnable(family: str) -> Any:
    """The `LearnableFamily` of that name. Raises ConfigError for an unknown one."""
    return _load(_LEARNABLE, family, "network: family")


def open_sensor(
    type_: str, options: Mapping[str, object], manifest: Manifest
) -> AbstractContextManager[SensorOver]:
    """What [sensor] says, for a policy that can fly. Raises ConfigError for an unknown type."""
    assert manifest.perception is not None  # without it no policy is loaded
    driver: SensorDriver = _load(_SENSORS, type_, "sensor: type")
    training = manifest.training
    setting = SensorSetting(
        manifest.perception, training.idf_truncation, training.idf_norm, options
    )
    return driver(setting)


def open_vehicle(type_: str, setting: VehicleSetting) -> AbstractContextManager[OpenVehicle]:
    """What [autopilot] says. Raises ConfigError for an unknown type."""
    driver: VehicleDriver = _load(_VEHICLES, type_, "autopilot: type")
    return driver(setting)


def open_link(type_: str, setting: LinkSetting) -> AbstractContextManager[Link]:
    """What [link] says. Raises ConfigError for an unknown type."""
    driver: LinkDriver = _load(_LINKS, type_, "link: type")
    return driver(setting)


def _load(group: str, name: str, key: str) -> Any:
    entry = _BUILT_IN.get((group, name))
    if entry is None:
        # Read only if asked for: it takes all packages' metadata.
        found = entry_points(group=group)
        if name not in found.names:
            built_in = {known for its, known in _BUILT_IN if its == group}
            known = ", ".join(repr(each) for each in sorted(built_in | found.names))
            raise ConfigError(
                f"{key} = {name!r}: is not installed here (entry points {group!r}); known are "
                f"{known}"
            )
        entry = found[name]
    try:
        return entry.load()
    except Exception as error:  # whatever a package raises while it is imported
        raise ConfigError(
            f"{key} = {name!r}: {entry.value} cannot be loaded: {type(error).__name__}: {error}"
        ) from error
