"""What is chosen by name: what is built in, what packages add, and what is not there."""

from pathlib import Path

import pytest

from edge.core.ports import VehicleSetting
from edge.core.schema import ConfigError
from edge.drivers.registry import (
    load_learnable,
    load_policy,
    load_verified_policy,
    open_link,
    open_sensor,
    open_vehicle,
)
from edge.messages.topics import LinkSetting
from edge.policy.bundle import Bundle, make_bundle, write_bundle
from edge.policy.lpac.policy import LpacPolicy
from tests.conftest import SHIPPED

LINK = LinkSetting("demo", None, (), (), True, {}, {}, None)
VEHICLE = VehicleSetting("udpin://127.0.0.1:14999", 1, {})

TYPES = ("added", "opened", "no_context", "raises", "no_device", "blind", "named", "forgetful")
PACKAGE = '''
from contextlib import nullcontext
from edge.core.ports import OpenVehicle

class All:
    """Whatever is asked for."""
    def __init__(self, setting): self.setting = setting
    def view(self, position): pass
    state = send = command = read_parameters = set_parameter = upload_fence = has_fence = view
    publish = is_claimed = peers = refused = view

def added(setting):
    if type(setting).__name__ == "VehicleSetting":
        return nullcontext(OpenVehicle(All(setting), All(setting), nullcontext))
    if type(setting).__name__ == "LinkSetting":
        return nullcontext(All(setting))
    return nullcontext(lambda text, source: All(setting))

def opened(setting): return nullcontext(setting)
def no_context(setting): yield setting
def raises(setting): raise KeyError("hops")
def no_device(setting): raise OSError("no /dev/video7")
def blind(setting): return nullcontext(lambda text, source: object())

class named:
    def __init__(self, bundle): self.manifest = bundle.manifest
    bundle_id, message_size = "x", 2
    def agent(self): return self
    def verify(self): return iter(())
    def observe(self): pass
    step = observe

class forgetful(named):
    bundle_id = bytes(32)
'''


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An installed package that adds a type of each kind, one that is broken, and one of ours."""
    (tmp_path / "added_here.py").write_text(PACKAGE)
    metadata = tmp_path / "added_here-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: added-here\nVersion: 1.0\n")
    groups = ("sensors", "vehicles", "links", "policies", "learnable")
    (metadata / "entry_points.txt").write_text(
        "".join(
            f"[lpac_edge.{group}]\nbroken = added_here:missing\nworld = added_here:opened\n"
            + "".join(f"{name} = added_here:{name}\n" for name in TYPES)
            for group in groups
        )
    )
    monkeypatch.syspath_prepend(str(tmp_path))


@pytest.mark.usefixtures("package")
def test_a_package_adds_types(shipped_bundle: Bundle) -> None:
    with open_vehicle("added", VEHICLE) as vehicle:
        assert vehicle.vehicle.setting == VEHICLE  # type: ignore[attr-defined]
    with open_link("added", LINK) as link:
        assert link.setting == LINK  # type: ignore[attr-defined]
    with open_sensor("added", {"mast_m": 2.0}, shipped_bundle.manifest) as over:
        setting = over("", "").setting  # type: ignore[union-attr]
        assert setting.options == {"mast_m": 2.0}
        assert setting.perception.sensor_size == 64
    assert load_learnable("opened")(VEHICLE).__enter__() == VEHICLE


@pytest.mark.usefixtures("package")
@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("no_context", "TypeError: "),
        ("opened", "TypeError: "),
        ("raises", "KeyError: 'hops'"),
        ("no_device", "no /dev/video7"),
    ],
)
def test_what_a_package_does_wrong_is_one_line(
    shipped_bundle: Bundle, name: str, said: str
) -> None:
    for key, opened in (
        ("sensor: type", lambda: open_sensor(name, {}, shipped_bundle.manifest)),
        ("autopilot: type", lambda: open_vehicle(name, VEHICLE)),
        ("link: type", lambda: open_link(name, LINK)),
    ):
        with pytest.raises((ConfigError, OSError)) as error, opened():
            pass
        assert str(error.value).startswith(f"{key} = {name!r}: {said}")


@pytest.mark.usefixtures("package")
@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("opened", "TypeError: a policy must have agent, verify: has no agent, verify"),
        ("raises", "KeyError: 'hops'"),
        ("named", "TypeError: bundle_id = 'x': must be 32 bytes"),
        ("forgetful", "TypeError: an agent must have observe, step, reset: has no reset"),
    ],
)
def test_what_a_family_does_wrong_is_one_line(
    shipped_bundle: Bundle, tmp_path: Path, name: str, said: str
) -> None:
    manifest = shipped_bundle.manifest
    bundle = make_bundle(
        type(manifest)(
            schema=1, name="x", perception=manifest.perception, training=manifest.training,
            provenance={}, files={}, family=name,
        ),
        {},
    )  # fmt: skip
    write_bundle(bundle, tmp_path / "bundle")
    with pytest.raises(ConfigError) as error:
        load_verified_policy(tmp_path / "bundle")
    assert str(error.value) == f"policy: family = {name!r}: {said}"


@pytest.mark.usefixtures("package")
def test_a_sensor_that_shows_nothing_is_named(shipped_bundle: Bundle) -> None:
    with (
        open_sensor("blind", {}, shipped_bundle.manifest) as over,
        pytest.raises(
            ConfigError,
            match=r"^sensor: type = 'blind': TypeError: a sensor without look must have view: has",
        ),
    ):
        over("", "")


@pytest.mark.usefixtures("package")
def test_what_is_built_in_is_not_replaced(shipped_bundle: Bundle) -> None:
    text = (Path(__file__).parents[3] / "docs" / "robot.toml").read_text()
    with (
        pytest.raises(ValueError, match="robot"),
        open_sensor("world", {}, shipped_bundle.manifest) as over,
    ):
        over(text, "robot.toml")


@pytest.mark.usefixtures("package")
def test_what_is_not_there_or_cannot_be_loaded_is_one_line(shipped_bundle: Bundle) -> None:
    for name, why in (
        ("other", "is not installed here"),
        ("broken", "added_here:missing cannot be loaded: AttributeError: "),
    ):
        bundle = make_bundle(
            type(shipped_bundle.manifest)(
                schema=1, name="x", perception=None, training=shipped_bundle.manifest.training,
                provenance={}, files={}, family=name,
            ),
            {},
        )  # fmt: skip
        for key, choose in (
            ("sensor: type", lambda name=name: open_sensor(name, {}, shipped_bundle.manifest)),
            ("autopilot: type", lambda name=name: open_vehicle(name, VEHICLE)),
            ("link: type", lambda name=name: open_link(name, LINK)),
            ("policy: family", lambda bundle=bundle: load_policy(bundle)),
        ):
            with pytest.raises(ConfigError) as error:
                choose()
            assert str(error.value).startswith(f"{key} = {name!r}: {why}")
            assert "\n" not in str(error.value)
            if name == "other":
                assert "install the package that has it; known are 'added', " in str(error.value)


def test_built_in_types_have_no_options(shipped_bundle: Bundle) -> None:
    options = {"colour": "red"}
    for table, context in (
        ("sensor", open_sensor("world", options, shipped_bundle.manifest)),
        ("autopilot", open_vehicle("px4", VEHICLE._replace(options=options))),
        ("link", open_link("zenoh", LINK._replace(options=options))),
    ):
        with pytest.raises(ConfigError, match=f"{table}: options: unknown key 'colour'"), context:
            pass


def test_the_shipped_policy_is_of_the_family_that_a_manifest_need_not_name(
    shipped_bundle: Bundle,
) -> None:
    policy = load_policy(shipped_bundle)
    assert isinstance(policy, LpacPolicy) and policy.message_size == 3 * (34 + 256)
    assert load_verified_policy(SHIPPED).problem is None
