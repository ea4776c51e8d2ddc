"""`lpac fleet swap` between real robot computers."""

from dataclasses import replace
from pathlib import Path

import pytest

from lpac.fleet.settings import load_fleet
from lpac.fleet.swap import _callers
from lpac.fleet.writer import assign
from tests.conftest import ROOT
from tests.host.fleet.field import SILENT, armed, await_said, deploy_to, lpac_fleet
from tests.host.hosts import FrailHost, FrailHosts


@pytest.fixture(scope="module")
def deployed(hosts: FrailHosts) -> FrailHosts:
    """r3, which flies, and r4, a spare, have the release."""
    deploy_to(hosts, "r3", "r4")
    return hosts


@pytest.fixture
def fleet_file(deployed: FrailHosts, tmp_path: Path) -> Path:
    """As it was at first, in a folder of its own."""
    for name in ("ssh_config", "world.env"):
        (tmp_path / name).symlink_to(deployed.folder / name)
    path = tmp_path / "fleet.toml"
    path.write_text(deployed.fleet_toml.read_text())
    return path


def runs(host: FrailHost) -> tuple[str, str]:
    """Whether the program runs, and whether it starts at boot."""
    return tuple(  # type: ignore[return-value]
        host.run(f"systemctl {ask} lpac-robot || true").strip()
        for ask in ("is-active", "is-enabled")
    )


def test_nothing_is_touched_where_there_is_nothing_to_swap(
    hosts: FrailHosts, fleet_file: Path
) -> None:
    for failed, spare, why in (
        ("r3", "r2", "r2 is not a spare: it has slots[1]"),
        ("r4", "r4", "r4 has no slot for r4 to take"),
        ("r9", "r4", "'r9' is unknown; known are"),
    ):
        done = lpac_fleet(fleet_file, "swap", failed, spare)
        assert done.returncode == 1
        assert why in done.stderr
    hosts[3].cut()
    try:
        done = lpac_fleet(fleet_file, "swap", "r3", "r4")
        assert done.returncode == 1
        assert "it does not answer" in done.stderr
    finally:
        hosts[3].heal()
    assert runs(hosts[2]) == ("active", "enabled")
    assert fleet_file.read_text() == hosts.fleet_toml.read_text()


def test_robots_with_larger_ids_may_not_know_a_spare() -> None:
    config = load_fleet(ROOT / "docs" / "fleet.toml")
    assert _callers(config, config.robots["r11"]) == ()
    assert _callers(config, replace(config.robots["r11"], robot_id=0)) == ("r1", "r2", "r3")


def test_a_spare_flies_instead_of_a_robot_that_answers(hosts: FrailHosts, fleet_file: Path) -> None:
    r3, r4 = hosts[2], hosts[3]
    before = load_fleet(fleet_file).slots[2]
    text = fleet_file.read_text()
    with armed(r3):
        # It counts what the program itself says.
        await_said(r3, '"armed":true')
        done = lpac_fleet(fleet_file, "swap", "r3", "r4")
    assert done.returncode == 1
    assert "the vehicle is armed: stopping is refused" in done.stderr
    assert fleet_file.read_text() == text
    assert runs(r3) == ("active", "enabled")
    await_said(r3, '"armed":false')

    done = lpac_fleet(fleet_file, "swap", "r3", "r4")
    assert done.returncode == 0, done.stderr
    assert runs(r3) == ("inactive", "disabled")
    assert runs(r4) == ("active", "enabled")
    config = load_fleet(fleet_file)
    slot = config.slot_of("r4")
    assert slot is not None
    assert config.slot_of("r3") is None
    assert (slot.height, slot.pad_m, slot.landing_point_m) == (
        before.height, before.pad_m, before.landing_point_m,
    )  # fmt: skip
    toml = (r4.root / "opt/lpac/current/robot.toml").read_text()
    assert f"landing_point_m = {list(before.landing_point_m)}" in toml
    assert "(0.0 MB sent)" in done.stdout or "(0.1 MB sent)" in done.stdout
    assert "no other robot needs a deploy" in done.stdout

    done = lpac_fleet(fleet_file, "swap", "r3", "r4")
    assert done.returncode == 0, done.stderr
    assert runs(r4) == ("active", "enabled")


def test_an_interrupted_swap_for_a_robot_that_is_off_is_finished(
    hosts: FrailHosts, fleet_file: Path
) -> None:
    r3, r4 = hosts[2], hosts[3]
    r3.power_off()
    # Broken off after the file was changed.
    assign(fleet_file, 2, "r4")
    done = lpac_fleet(fleet_file, "swap", "r3", "r4")
    assert done.returncode == 0, done.stderr
    assert f"r3     was not stopped: {SILENT}" in done.stdout
    assert "both fail their checks and do not take off" in done.stdout
    assert runs(r4) == ("active", "enabled")
