"""Robots that are not as a deployment left them: nothing is said to run that does not."""

from contextlib import ExitStack
from pathlib import Path

import pytest

from lpac.fleet.agent import UNIT
from lpac.fleet.session import RemoteError
from tests.host.fleet.field import armed, deploy_to, lpac_fleet
from tests.host.fleet.laptop import Laptop, boot_nonce
from tests.host.hosts import FrailHosts

OTHERS_UNIT = "/etc/systemd/system/lpac-robot.service.d/60-others.conf"


@pytest.fixture(scope="module")
def laptop(hosts: FrailHosts, tmp_path_factory: pytest.TempPathFactory) -> Laptop:
    """r1 runs a release."""
    laptop = Laptop(hosts, tmp_path_factory.mktemp("releases"))
    # Of an image that is newer than the robot's, only files that differ travel.
    deploy_to(hosts, "r1", image_id="older")
    return laptop


def test_a_program_that_was_not_restarted_does_not_run_the_release(laptop: Laptop) -> None:
    host, before = laptop.hosts[0], laptop.overview(0)
    host.run(f"mkdir -p {Path(OTHERS_UNIT).parent}")
    host.run(f"printf '[Service]\\nExecStart=/bin/true\\n' > {OTHERS_UNIT}")
    host.run("systemctl daemon-reload")
    try:
        with pytest.raises(RemoteError, match="it was not restarted"):
            laptop.deploy(0, laptop.release(0, laptop.changed()))
        after = laptop.overview(0)
        assert after["current"] == before["current"]
        # What systemd does not understand is still there to be stopped.
        assert lpac_fleet(laptop.hosts.fleet_toml, "stop", "--robots", "r1").returncode == 0
        assert laptop.overview(0)["service"]["active"] != "active"
    finally:
        host.run(f"rm {OTHERS_UNIT} && systemctl daemon-reload")
    # One that is damaged is mended by deploying it again.
    release = laptop.release(0, laptop.changed())
    assert laptop.deploy(0, release).summary == "runs"
    host.run("rm /opt/lpac/current/world.env && systemctl restart lpac-robot || true")
    # The releases share the files of their image.
    host.run("echo damaged > /opt/lpac/current/root/usr/share/lpac/versions.json")
    assert laptop.deploy(0, release).summary == "runs"
    assert boot_nonce(laptop.overview(0))


def test_nothing_is_taken_back_under_a_pilot(laptop: Laptop) -> None:
    host = laptop.hosts[0]
    # A program that ends at once: no release can be well with it.
    units = dict(laptop.common.units)
    unit = units[UNIT].replace(b"robot run --config", b"robot run --no-config")
    release = laptop.release(0, laptop.changed()._replace(units=units | {UNIT: unit}))
    with ExitStack() as stack:

        def arm(step: str, _: float | None) -> None:
            if step == "health":
                stack.enter_context(armed(host))

        with pytest.raises(RemoteError, match="the vehicle was armed meanwhile"):
            laptop.deploy(0, release, arm)
        assert laptop.overview(0)["pending"] == release.id
    # On the ground again, whoever comes next puts it right.
    done = lpac_fleet(laptop.hosts.fleet_toml, "restart", "--robots", "r1")
    assert done.returncode == 0, done.stderr
    after = laptop.overview(0)
    assert after["pending"] is None and after["current"] != release.id
    assert boot_nonce(after)


def test_a_shell_that_prints_is_named(laptop: Laptop) -> None:
    host = laptop.hosts[0]
    host.run("echo 'echo welcome' > /root/.bashrc")
    try:
        with pytest.raises(RemoteError, match=r"its login shell prints .*welcome"):
            laptop.overview(0)
    finally:
        host.run("rm /root/.bashrc")
