"""Deploying to real robot computers: whole and proven, or nothing has changed."""

import asyncio
import contextlib
import json
import os
import random
import re
import signal
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import onnx
import pytest
from onnx import numpy_helper

from edge.policy.bundle import BUNDLE_ID, MANIFEST, make_bundle
from lpac.fleet.deploy import deploy
from lpac.fleet.hold import lock, overview
from lpac.fleet.program import start, stop
from lpac.fleet.release import Release, make_release
from lpac.fleet.session import (
    FleetError,
    RemoteError,
    Session,
    UnreachableError,
    connect,
)
from lpac.fleet.settings import RobotHost
from lpac.sim.hosts.rack import children
from tests.host.fleet.field import (
    armed,
    await_said,
    deploy_to,
    name_robot,
    running_lpac_fleet,
    unwatched,
)
from tests.host.fleet.laptop import Laptop, boot_nonce
from tests.host.hosts import FrailHost, FrailHosts


@pytest.fixture(scope="module")
def laptop(hosts: FrailHosts, tmp_path_factory: pytest.TempPathFactory) -> Laptop:
    """r1 and r2 run a first release; r3 is there, whatever it has."""
    laptop = Laptop(hosts, tmp_path_factory.mktemp("releases"))
    deploy_to(hosts, "r1", "r2")
    return laptop


def await_true(holds: Callable[[], bool], within_s: float = 120.0) -> None:
    until_s = time.monotonic() + within_s
    while not holds():
        assert time.monotonic() < until_s, "it did not come true"
        time.sleep(0.05)


def await_free(host: FrailHost) -> None:
    """Until nobody holds the robot. To ask mends nothing, as the robot's own `lock` does."""
    host.run("flock --shared /run/lpac-fleet.lock true")


def test_a_second_deploy_sends_nothing_and_disturbs_nothing(laptop: Laptop) -> None:
    before = boot_nonce(laptop.overview(0))
    done = laptop.deploy(0)
    assert (done.summary, done.sent_bytes) == ("unchanged", 0)
    assert boot_nonce(laptop.overview(0)) == before


def test_of_two_operators_the_second_waits(laptop: Laptop) -> None:
    async def both() -> None:
        async with connect(laptop.config, laptop.robot(0)) as session:
            await session.call(
                "lock", directory=laptop.config.directory, who="alice@field", mavlink_port=14551
            )
            with pytest.raises(RemoteError, match="alice@field is changing this robot"):
                await deploy(laptop.config, laptop.robot(0), laptop.release(0), unwatched)

    asyncio.run(both())
    assert laptop.deploy(0).summary in ("unchanged", "runs")


def test_a_changed_file_travels_alone_and_rollback_goes_back_once(laptop: Laptop) -> None:
    before = laptop.overview(0)
    release = laptop.release(0, laptop.changed())
    done = laptop.deploy(0, release)
    assert done.release == release.id != before["current"]
    # The world, the lock of versions, and the manifest of 2,000 files.
    assert done.sent_bytes < 0.01 * release.size_bytes
    now = laptop.overview(0)
    assert (now["current"], now["earlier"], now["pending"]) == (
        release.id, before["current"], None,
    )  # fmt: skip
    assert int(now["number"]) > int(before["number"])
    assert now["service"]["enabled"]
    assert laptop.roll_back(0) == before["current"]
    back = laptop.overview(0)
    assert (back["current"], back["number"]) == (before["current"], before["number"])
    with pytest.raises(RemoteError, match="no earlier release"):
        laptop.roll_back(0)
    again = laptop.deploy(0, release)
    assert again.summary == "runs" and again.sent_bytes < 0.01 * release.size_bytes
    after = laptop.overview(0)
    assert (after["current"], after["earlier"]) == (release.id, before["current"])
    assert int(after["number"]) > int(now["number"])


def test_an_altered_file_is_found_before_it_runs(laptop: Laptop) -> None:
    host = laptop.hosts[0]
    release = laptop.release(0, laptop.changed())
    laptop.deploy(0, release)
    before = laptop.overview(0)
    _, earlier = before["releases"]
    host.run(f"echo >> /opt/lpac/releases/{earlier}/world.env")
    with pytest.raises(RemoteError, match=r"^world\.env differs from the release: deploy again"):
        laptop.roll_back(0)
    assert boot_nonce(laptop.overview(0)) == boot_nonce(before)
    # Its image, too, in whatever releases it is.
    host.run("echo >> /opt/lpac/current/root/usr/share/lpac/versions.json")
    host.run("systemctl stop lpac-robot")
    with pytest.raises(RemoteError, match=r"root/usr/share/lpac/versions\.json differs from"):
        laptop.ask(0, lambda session, _: start(session, laptop.config))
    assert laptop.overview(0)["service"]["active"] == "inactive"
    assert laptop.deploy(0, release).summary == "runs"
    host.run("chmod 666 /opt/lpac/current/robot.toml")
    mended = laptop.deploy(0, release)
    assert (mended.summary, mended.release) == ("runs", release.id)
    assert laptop.deploy(0, release).summary == "unchanged"


def test_interrupted_anywhere_the_robot_has_a_whole_release(laptop: Laptop) -> None:
    """Twenty times, at any moment: the laptop is gone, or the network, or the robot's power."""
    host, draw = laptop.hosts[0], random.Random(42)
    began_s = time.monotonic()
    laptop.deploy(0, laptop.release(0, laptop.changed()))
    lasts_s = time.monotonic() - began_s
    mishaps = [gone, gone, host.cut, host.power_off]

    async def interrupted(release: Release, mishap: Callable[[], None], after_s: float) -> None:
        deploying = asyncio.create_task(deploy(laptop.config, laptop.robot(0), release, unwatched))
        await asyncio.wait([deploying], timeout=after_s)
        mishap()
        with contextlib.suppress(FleetError):
            await deploying

    async def found(session: Session, robot: RobotHost) -> list[dict[str, Any]]:
        """As it is, and after the next operator has finished what was interrupted."""
        first = await overview(session, laptop.config)
        await session.call("check", folder="/opt/lpac/current/")
        await lock(session, laptop.config, robot)
        return [first, await overview(session, laptop.config)]

    before = laptop.overview(0)["current"]
    for n in range(20):
        release = laptop.release(0, laptop.changed())
        mishap, after_s = mishaps[n % len(mishaps)], draw.uniform(0.0, lasts_s)
        asyncio.run(interrupted(release, mishap, after_s))
        host.heal()
        if mishap == host.power_off:
            host.power_on()
        await_free(host)
        first, now = laptop.ask(0, found)
        what = f"{n}: {mishap.__name__} after {after_s:.2f} of {lasts_s:.2f} s: {first}, {now}"
        assert {first["current"], now["current"]} <= {before, release.id}, what
        assert now["pending"] is None and now["service"]["active"] == "active", what
        before = now["current"]
    last = laptop.release(0, laptop.changed())
    assert laptop.deploy(0, last).summary == "runs"
    now = laptop.overview(0)
    assert now["current"] == last.id and len(now["releases"]) == 2 and boot_nonce(now)
    assert host.run("ls /opt/lpac/incoming") == ""


def gone() -> None:
    """The laptop's ssh and rsync end at once."""
    for child in children(os.getpid()):
        with contextlib.suppress(ProcessLookupError, FileNotFoundError):
            if Path(f"/proc/{child}/comm").read_text().strip() in ("ssh", "rsync"):
                os.kill(child, signal.SIGKILL)


def test_a_transfer_that_breaks_off_changes_nothing_and_a_repeat_finishes(
    laptop: Laptop,
) -> None:
    """The network is gone, then the disk is full, then the laptop's program is killed."""
    host = laptop.hosts[2]
    host.reset()
    name_robot(laptop.hosts, host)
    release = laptop.release(2)
    incoming = host.root / "opt" / "lpac" / "incoming"

    def breaks_off(mishap: Callable[[], None]) -> FleetError:
        seen: list[float] = []

        def at_a_third(step: str, share: float | None) -> None:
            if step == "send" and share is not None and share >= 0.3 and not seen:
                seen.append(share)
                mishap()

        with pytest.raises(FleetError) as error:
            laptop.deploy(2, release, at_a_third)
        assert seen
        return error.value

    def is_whole_and_free() -> None:
        assert laptop.overview(2)["current"] is None
        await_free(host)

    assert isinstance(breaks_off(host.cut), UnreachableError)
    host.heal()
    is_whole_and_free()
    assert any(incoming.iterdir())  # for the repeat
    assert "its disk is full" in str(breaks_off(host.fill_disk))
    host.free_disk()
    is_whole_and_free()
    with running_lpac_fleet(laptop.hosts.fleet_toml, "deploy", "--robots", host.name) as program:
        await_true(lambda: any(incoming.glob("*/root/usr/lib/*/*")))
        program.send_signal(signal.SIGKILL)
        program.communicate()
    is_whole_and_free()
    assert laptop.deploy(2, release).summary == "runs"


def test_a_full_disk_is_found_before_anything_travels(laptop: Laptop) -> None:
    host = laptop.hosts[0]
    before = laptop.overview(0)
    host.fill_disk()
    try:
        with pytest.raises(RemoteError, match=r"the disk has \d+ MB free.*needs \d+ MB"):
            laptop.deploy(0, laptop.release(0, laptop.changed()))
        after = laptop.overview(0)
    finally:
        host.free_disk()
    assert after["current"] == before["current"]
    assert boot_nonce(after) == boot_nonce(before)


def test_a_policy_that_does_not_compute_what_torch_computed_is_not_run(laptop: Laptop) -> None:
    bundle = laptop.common.bundle
    model = onnx.load_from_string(bundle.files["gnn_1.onnx"])
    taps = next(tensor for tensor in model.graph.initializer if tensor.name == "taps")
    taps.CopyFrom(numpy_helper.from_array(1.01 * numpy_helper.to_array(taps), "taps"))
    files = {n: c for n, c in bundle.files.items() if n not in (MANIFEST, BUNDLE_ID)}
    broken = make_bundle(bundle.manifest, files | {"gnn_1.onnx": model.SerializeToString()})
    before = laptop.overview(0)
    with pytest.raises(RemoteError, match=r"bundle verify on the robot: .*gnn_1\.onnx"):
        laptop.deploy(0, laptop.release(0, laptop.common._replace(bundle=broken)))
    after = laptop.overview(0)
    assert (after["current"], after["pending"]) == (before["current"], None)
    assert boot_nonce(after) == boot_nonce(before)


def test_a_release_that_does_not_run_well_is_taken_back(laptop: Laptop) -> None:
    before = laptop.overview(0)
    # Not for a program that is not root's.
    robot = replace(laptop.robot(0), zenoh_port=22)
    config = replace(laptop.config, robots={**laptop.config.robots, robot.name: robot})
    folder = laptop.release(0).folder.with_name("taken-port")
    folder.mkdir()
    release = make_release(config, robot, laptop.common, folder)
    with pytest.raises(RemoteError) as error:
        asyncio.run(deploy(config, robot, release, unwatched))
    assert re.search(
        rf"{release.id} failed .*zenoh.*:22.*the robot runs {before['current']} again",
        str(error.value),
    ), error.value
    after = laptop.overview(0)
    assert (after["current"], after["pending"]) == (before["current"], None)
    assert after["earlier"] == before["earlier"]
    assert after["service"]["fresh"]


def test_a_switch_is_finished_without_the_laptop_and_after_a_loss_of_power(laptop: Laptop) -> None:
    """At the switch r1 loses the network, and r2 its power, which a repeat mends."""
    r1, r2 = laptop.hosts[:2]
    releases = [laptop.release(index, laptop.changed()) for index in range(2)]
    former = laptop.overview(1)["current"]

    async def breaks_off(index: int, mishap: Callable[[], None]) -> None:
        def report(step: str, _: float | None) -> None:
            if step == "health":
                mishap()

        with pytest.raises(UnreachableError):
            await deploy(laptop.config, laptop.robot(index), releases[index], report)

    async def both() -> None:
        await asyncio.gather(breaks_off(0, r1.cut), breaks_off(1, r2.power_off))

    asyncio.run(both())
    r1.heal()
    await_free(r1)
    after = laptop.overview(0)
    assert (after["current"], after["pending"]) == (releases[0].id, None)
    assert after["service"]["fresh"]
    assert len(after["releases"]) <= 3  # of the six and more; what broke off pruned none

    r2.power_on()
    release = releases[1]
    assert laptop.overview(1)["pending"] == release.id
    assert laptop.deploy(1, release).summary.endswith(f"finished: the robot runs {release.id}")
    after = laptop.overview(1)
    assert (after["current"], after["earlier"], after["pending"]) == (release.id, former, None)


def test_an_armed_robot_refuses_whether_its_program_runs_or_not(laptop: Laptop) -> None:
    host = laptop.hosts[1]
    laptop.ask(1, lambda session, _: start(session, laptop.config))
    before, release = laptop.overview(1), laptop.release(1, laptop.changed())
    pending = json.dumps({"release": before["number"], "former": None})

    def end(*, in_flight: bool) -> None:
        laptop.ask(
            1, lambda session, robot: stop(session, robot, in_flight=in_flight, disable=False)
        )

    def refuses() -> None:
        with pytest.raises(RemoteError, match="the vehicle is armed: deploying is refused"):
            laptop.deploy(1, release)
        with pytest.raises(RemoteError, match="the vehicle is armed: stopping is refused"):
            end(in_flight=False)

    with armed(host):
        await_said(host, '"armed":true')
        refuses()
        # Nor is a switch that was interrupted finished in flight.
        (host.root / "opt/lpac/pending").write_text(pending)
        refuses()
        after = laptop.overview(1)
        assert (after["current"], after["pending"]) == (before["current"], before["current"])
        assert boot_nonce(after) == boot_nonce(before)
        (host.root / "opt/lpac/pending").unlink()
        end(in_flight=True)
        assert laptop.overview(1)["service"]["active"] == "inactive"
        refuses()
        assert laptop.overview(1)["current"] == before["current"]


def test_a_robot_with_another_host_key_gets_nothing(laptop: Laptop) -> None:
    known = laptop.hosts.known_hosts
    right = known.read_text()
    first, second = right.splitlines()[:2]
    known.write_text(f"{first.split(' ', 1)[0]} {second.split(' ', 1)[1]}\n")
    try:
        with pytest.raises(UnreachableError, match="its host key has changed"):
            laptop.deploy(0)
        known.write_text("")
        with pytest.raises(UnreachableError, match="its host key is not known"):
            laptop.deploy(0)
    finally:
        known.write_text(right)


def test_another_robot_at_the_address_gets_nothing(laptop: Laptop) -> None:
    stranger = replace(laptop.robot(0), host=laptop.robot(1).host)
    config = replace(laptop.config, robots={**laptop.config.robots, stranger.name: stranger})
    with pytest.raises(RemoteError, match="answers r2"):
        asyncio.run(deploy(config, stranger, laptop.release(0), unwatched))
