"""Registry of drivers, chosen by name in robot.toml and in a bundle's manifest.

A package adds a type by an entry point that has the type's name:

    [project.entry-points."lpac_edge.sensors"]
    camera = "my_package.camera:camera_sensor"

The groups are `lpac_edge.policies` (`edge.policy.family.PolicyFamily`), `lpac_edge.sensors`
(`edge.core.ports.SensorDriver`), `lpac_edge.vehicles` (`edge.core.ports.VehicleDriver`) and
`lpac_edge.links` (`edge.messages.topics.LinkDriver`); on a workstation that trains also
`lpac_edge.learnable` (`lpac.train.family.LearnableFamily`).
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import partial
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, TypeVar

from edge.core.ports import (
    Camera,
    OpenVehicle,
    Sensor,
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
_ID_BYTES = 32
_T = TypeVar("_T")
# No package can replace these.
_BUILT_IN = {
    (entry.group, entry.name): entry
    for entry in (
        EntryPoint("lpac", "edge.policy.lpac.policy:LpacPolicy", _POLICIES),
        EntryPoint("network", "edge.policy.network.policy:NetworkPolicy", _POLICIES),
        EntryPoint("world", "edge.drivers.world_sensor:world_sensor", _SENSORS),
        EntryPoint("px4", "edge.drivers.px4.driver:px4_vehicle", _VEHICLES),
        EntryPoint("zenoh", "edge.drivers.link:zenoh_link", _LINKS),
        EntryPoint("lpac", "lpac.train.lpac:lpac_network", _LEARNABLE),
        EntryPoint("network", "lpac.train.network:module_network", _LEARNABLE),
        EntryPoint("attention", "lpac.train.attention:attention_network", _LEARNABLE),
    )
}


def load_policy(bundle: Bundle) -> Policy:
    """Load the bundle's policy. Raises ConfigError for an unknown family, or BundleError."""
    key, name = "policy: family", bundle.manifest.family
    family: PolicyFamily = _load(_POLICIES, name, key)
    with _as_one_line(_POLICIES, name, key):
        policy = family(bundle)
        _require(policy, "a policy", "agent", "verify")
        if not (isinstance(policy.bundle_id, bytes) and len(policy.bundle_id) == _ID_BYTES):
            raise TypeError(f"bundle_id = {policy.bundle_id!r}: must be {_ID_BYTES} bytes")
        if not (isinstance(policy.message_size, int) and policy.message_size >= 0):
            raise TypeError(f"message_size = {policy.message_size!r}: must be 0 or more")
    return policy


def load_verified_policy(path: Path) -> VerifiedPolicy:
    """Load a bundle's policy, and verify it on this CPU.

    Raises ConfigError, BundleError or OSError.
    """
    bundle = load_bundle(path)
    if bundle.manifest.perception is None:
        raise BundleError(f"{path}: the bundle has no perception: it cannot fly")
    policy = load_policy(bundle)
    with _as_one_line(_POLICIES, bundle.manifest.family, "policy: family"):
        _require(policy.agent(), "an agent", "observe", "step", "reset")
        return verified(policy)


def load_learnable(family: str) -> Any:
    """Load the `LearnableFamily` of that name. Raises ConfigError for an unknown one."""
    return _load(_LEARNABLE, family, "network: family")


def open_sensor(
    type_: str, options: Mapping[str, object], manifest: Manifest
) -> AbstractContextManager[SensorOver]:
    """Open the sensor of [sensor] for a policy that can fly. Raises ConfigError."""
    assert manifest.perception is not None  # checked by load_verified_policy
    driver: SensorDriver = _load(_SENSORS, type_, "sensor: type")
    training = manifest.training
    setting = SensorSetting(
        manifest.perception, training.idf_truncation, training.idf_norm, options
    )
    return _opened(
        _SENSORS, type_, "sensor: type", partial(driver, setting), partial(_checked_sensor, type_)
    )


def open_vehicle(type_: str, setting: VehicleSetting) -> AbstractContextManager[OpenVehicle]:
    """Open the vehicle of [autopilot]. Raises ConfigError for an unknown type."""
    driver: VehicleDriver = _load(_VEHICLES, type_, "autopilot: type")
    return _opened(_VEHICLES, type_, "autopilot: type", partial(driver, setting), _checked_vehicle)


def open_link(type_: str, setting: LinkSetting) -> AbstractContextManager[Link]:
    """Open the link of [link]. Raises ConfigError for an unknown type."""
    driver: LinkDriver = _load(_LINKS, type_, "link: type")
    return _opened(_LINKS, type_, "link: type", partial(driver, setting), _checked_link)


def _checked_sensor(type_: str, opened: SensorOver) -> SensorOver:
    if not callable(opened):
        raise TypeError(f"it must open a SensorOver, not a {type(opened).__name__}")

    def over(text: str, source: str) -> Sensor | Camera:
        with _as_one_line(_SENSORS, type_, "sensor: type"):
            sensor = opened(text, source)
            if not isinstance(sensor, Camera):
                _require(sensor, "a sensor without look", "view")
        return sensor

    return over


def _checked_vehicle(opened: OpenVehicle) -> OpenVehicle:
    if not isinstance(opened, OpenVehicle):
        raise TypeError(f"it must open an OpenVehicle, not a {type(opened).__name__}")
    _require(opened.vehicle, "a vehicle", "state", "send", "command")
    _require(
        opened.setup, "a vehicle's setup",
        "read_parameters", "set_parameter", "upload_fence", "has_fence",
    )  # fmt: skip
    return opened


def _checked_link(opened: Link) -> Link:
    _require(opened, "a link", "publish", "is_claimed", "peers", "refused")
    return opened


@contextmanager
def _opened(
    group: str,
    name: str,
    key: str,
    driver: Callable[[], AbstractContextManager[_T]],
    checked: Callable[[_T], _T],
) -> Iterator[_T]:
    with ExitStack() as stack:
        with _as_one_line(group, name, key):
            opened = checked(stack.enter_context(driver()))
        yield opened


@contextmanager
def _as_one_line(group: str, name: str, key: str) -> Iterator[None]:
    """Convert any error of a package to a one-line error that names its type."""
    try:
        yield
    except ValueError:
        raise
    except OSError as error:
        if (group, name) in _BUILT_IN:
            raise
        raise OSError(f"{key} = {name!r}: {error}") from error
    except Exception as error:
        raise ConfigError(f"{key} = {name!r}: {type(error).__name__}: {error}") from error


def _require(thing: object, what: str, *methods: str) -> None:
    missing = [name for name in methods if not callable(getattr(thing, name, None))]
    if missing:
        raise TypeError(f"{what} must have {', '.join(methods)}: has no {', '.join(missing)}")


def _load(group: str, name: str, key: str) -> Any:
    entry = _BUILT_IN.get((group, name))
    if entry is None:
        # Slow: this reads the metadata of all installed packages.
        found = entry_points(group=group)
        if name not in found.names:
            built_in = {known for its, known in _BUILT_IN if its == group}
            known = ", ".join(repr(each) for each in sorted(built_in | found.names))
            raise ConfigError(
                f"{key} = {name!r}: is not installed here (entry points {group!r}): install the "
                f"package that has it; known are {known}"
            )
        entry = found[name]
    try:
        return entry.load()
    except Exception as error:  # an import may raise anything
        raise ConfigError(
            f"{key} = {name!r}: {entry.value} cannot be loaded: {type(error).__name__}: {error}"
        ) from error
