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
from edge.policy.bundle import Bundle, make_bundle
from edge.policy.lpac.policy import LpacPolicy
from tests.conftest import SHIPPED

LINK = LinkSetting("demo", None, "peer", (), (), True, {}, {}, None)
VEHICLE = VehicleSetting("udpin://127.0.0.1:14999", 1, {})


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An installed package that adds a type of each kind, one that is broken, and one of ours."""
    (tmp_path / "added_here.py").write_text(
        "from contextlib import nullcontext\n\ndef opened(setting): return nullcontext(setting)\n"
    )
    metadata = tmp_path / "added_here-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: added-here\nVersion: 1.0\n")
    groups = ("sensors", "vehicles", "links", "policies", "learnable")
    (metadata / "entry_points.txt").write_text(
        "".join(
            f"[lpac_edge.{group}]\nadded = added_here:opened\nbroken = added_here:missing\n"
            "world = added_here:opened\n"
            for group in groups
        )
    )
    monkeypatch.syspath_prepend(str(tmp_path))


@pytest.mark.usefixtures("package")
def test_a_package_adds_types(shipped_bundle: Bundle) -> None:
    with open_vehicle("added", VEHICLE) as vehicle:
        assert vehicle == VEHICLE  # type: ignore[comparison-overlap]
    with open_link("added", LINK) as link:
        assert link == LINK  # type: ignore[comparison-overlap]
    with open_sensor("added", {"mast_m": 2.0}, shipped_bundle.manifest) as setting:
        assert setting.options == {"mast_m": 2.0}  # type: ignore[attr-defined]
        assert setting.perception.sensor_size == 64  # type: ignore[attr-defined]
    assert load_learnable("added")(VEHICLE).__enter__() == VEHICLE


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
                assert "known are 'added', 'broken', '" in str(error.value)


def test_built_in_types_have_no_options(shipped_bundle: Bundle) -> None:
    options = {"colour": "red"}
    for table, context in (
        ("sensor", open_sensor("world", options, shipped_bundle.manifest)),
        ("autopilot", open_vehicle("px4", VEHICLE._replace(options=options))),
    ):
        with pytest.raises(ConfigError, match=f"{table}: options: unknown key 'colour'"), context:
            pass
    with pytest.raises(ConfigError, match="link: options: unknown key 'colour'"):
        open_link("zenoh", LINK._replace(options=options))


def test_the_shipped_policy_is_of_the_family_that_a_manifest_need_not_name(
    shipped_bundle: Bundle,
) -> None:
    policy = load_policy(shipped_bundle)
    assert isinstance(policy, LpacPolicy) and policy.message_size == 3 * (34 + 256)
    assert load_verified_policy(SHIPPED).problem is None
