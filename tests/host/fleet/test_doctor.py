"""What keeps robots from flying is found and named with its fix, on robot computers."""

import asyncio
import contextlib
import json
import re
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from edge.identity.members import Role
from lpac.fleet.authority import new_member
from lpac.fleet.doctor import (
    DoctorCheck,
    Examination,
    diagnose,
    examine,
)
from lpac.fleet.members import open_authority, send_members_to
from lpac.fleet.operations import Outcome, for_each
from lpac.fleet.settings import RobotHost, load_fleet
from lpac.fleet.up import bring_up
from tests.host.fleet.field import SILENT, armed, deploy_to, lpac_fleet, name_robot, unwatched
from tests.host.hosts import FrailHost, FrailHosts


@pytest.fixture(scope="module")
def enrolled(hosts: FrailHosts) -> FrailHosts:
    """With their identity; r1, r2 and r3 with new disks, and nothing else is done to them."""
    for host in hosts[:3]:
        host.reset()
    for host in hosts:
        name_robot(hosts, host)
    config = load_fleet(hosts.fleet_toml)
    # The first have the list from before the others joined.
    bring = partial(send_members_to, config, report=unwatched)
    assert not [o for o in asyncio.run(for_each([*config.robots.values()], bring)) if o.problem]
    return hosts


@contextlib.contextmanager
def deaf(one: FrailHost, other: FrailHost) -> Iterator[None]:
    """Nothing passes from one to the other, though both have the network."""
    script = 'ip -n "$1" route "$2" blackhole "$3"/32'
    one._rack.sh(script, one.name, "add", other.address)
    try:
        yield
    finally:
        one._rack.sh(script, one.name, "delete", other.address)


def run_doctor(
    hosts: FrailHosts, robots: str = "r1,r2,r3", **clock: Any
) -> dict[str, dict[str, DoctorCheck]]:
    config = load_fleet(hosts.fleet_toml)
    chosen = [config.robots[name] for name in robots.split(",")]

    async def one(robot: RobotHost) -> Examination:
        others = [other for other in chosen if other is not robot]
        return await examine(config, robot, others, unwatched, **clock)

    outcomes: list[Outcome[Examination]] = asyncio.run(for_each(chosen, one))
    return {
        diagnosis.robot: {check.name: check for check in diagnosis.checks}
        for diagnosis in diagnose(config, outcomes)
    }


def test_a_stock_robot_is_told_what_it_lacks(enrolled: FrailHosts) -> None:
    for checks in run_doctor(enrolled).values():
        verdicts = {check.name: check.verdict for check in checks.values()}
        assert {name for name, verdict in verdicts.items() if verdict == "FAILED"} == {
            "release",
            "vision-hub",
        }
        assert 'offboard_mode is "figure_eight"' in checks["vision-hub"].found
        assert checks["vision-hub"].fix.startswith("lpac fleet enroll r")
        assert checks["release"].fix.startswith("lpac fleet deploy --robots r")
        for name in ("enrolled", "system", "clock", "mavlink", "commanders"):
            assert verdicts[name] == "ok", checks[name]


def test_each_robot_has_its_own_faults_alone(enrolled: FrailHosts) -> None:
    """A full disk, no radio link between two, and one that is off."""
    r1, r2, r3, r4 = enrolled
    r1.fill_disk()
    r4.cut()
    try:
        with deaf(r2, r3):
            found = run_doctor(enrolled, "r1,r2,r3,r4")
    finally:
        r1.free_disk()
        r4.heal()
    assert found["r1"]["disk"].verdict == "FAILED"
    assert found["r2"]["disk"].verdict != "FAILED"
    assert found["r1"]["radio"].verdict != "FAILED"
    assert found["r2"]["radio"].verdict == "FAILED"
    assert found["r2"]["radio"].found == "no answer from r3"
    (reach,) = found["r4"].values()
    assert (reach.name, reach.verdict, reach.found) == ("reach", "FAILED", SILENT)


def test_another_clock_another_vehicle_and_one_that_is_silent(enrolled: FrailHosts) -> None:
    text = enrolled.fleet_toml.read_text()
    changed = text.replace("robot_id = 1\n", "robot_id = 1\nsystem_id = 99\n")
    changed = changed.replace(
        "robot_id = 2\n", 'robot_id = 2\nmavlink_url = "udpin://127.0.0.1:14999"\n'
    )
    enrolled.fleet_toml.write_text(changed)
    try:
        # The robots' clock is this machine's: it is the laptop's that is wrong.
        found = run_doctor(enrolled, "r1,r2", unix_time_s=lambda: time.time() - 3600.0)
    finally:
        enrolled.fleet_toml.write_text(text)
    assert found["r1"]["clock"].verdict == "FAILED"
    assert "system id 1, fleet.toml has 99" in found["r1"]["mavlink"].found
    assert "no heartbeat of PX4 at UDP port 14999" in found["r2"]["mavlink"].found
    assert "14551, fleet.toml has 14999" in found["r2"]["vision-hub"].found


def test_doctor_prints_a_board_and_fails(enrolled: FrailHosts) -> None:
    asked = (enrolled.fleet_toml, "doctor", "--robots", "r1,r3")
    shown = lpac_fleet(*asked)
    assert shown.returncode == 1
    assert shown.stderr.splitlines()[-1] == "lpac: 4 checks failed, on r1, r3"
    assert "vision-hub FAILED FAILED" in " ".join(shown.stdout.split())
    assert "→ lpac fleet deploy --robots r1" in shown.stdout
    robots = json.loads(lpac_fleet(*asked, "--json").stdout)["robots"]
    assert list(robots) == ["r1", "r3"]
    assert not robots["r1"]["ok"]
    (hub,) = [check for check in robots["r1"]["checks"] if check["name"] == "vision-hub"]
    assert hub["verdict"] == "FAILED"
    assert hub["fix"].startswith("lpac fleet enroll r1")


def test_up_says_no_go_with_the_reasons(enrolled: FrailHosts) -> None:
    enrolled[2].cut()
    try:
        shown = lpac_fleet(enrolled.fleet_toml, "up", "--timeout", "3", "--json")
    finally:
        enrolled[2].heal()
    assert shown.returncode == 1
    assert shown.stderr.splitlines()[-1] == "lpac: NO-GO: r1, r2, r3"
    robots = json.loads(shown.stdout)["robots"]
    # The spare is not waited for.
    assert list(robots) == ["r1", "r2", "r3"]
    assert "release: it has no release" in robots["r1"]["reasons"]
    assert robots["r3"]["reasons"] == [f"up: {SILENT}"]


def test_up_waits_for_a_robot_that_is_just_switched_on(enrolled: FrailHosts) -> None:
    config = load_fleet(enrolled.fleet_toml)
    config = replace(config, ssh=replace(config.ssh, connect_timeout_s=1.0))
    robot = config.robots["r1"]
    waits: list[str] = []

    def report(step: str, _: float | None) -> None:
        if step.startswith("wait: "):
            waits.append(step)
            enrolled[0].heal()

    enrolled[0].cut()
    arrival = asyncio.run(bring_up(config, robot, time.monotonic() + 60.0, report))
    assert waits
    assert arrival == ((), ())


def test_a_clock_that_cannot_be_set_is_no_go(enrolled: FrailHosts) -> None:
    """A container may not set the clock of the machine that it runs on."""
    config = load_fleet(enrolled.fleet_toml)
    arrival = asyncio.run(
        bring_up(
            config, config.robots["r1"], time.monotonic(), unwatched, lambda: time.time() + 100.0
        )
    )
    assert len(arrival.problems) == 1
    assert arrival.problems[0].startswith("its clock cannot be set")


def test_up_starts_what_was_switched_off_and_says_go(
    enrolled: FrailHosts,
) -> None:
    host = enrolled[0]
    config = load_fleet(enrolled.fleet_toml)
    robot = config.robots[host.name]
    deploy_to(enrolled, host.name)
    hub = host.root / "etc/modalai/voxl-vision-hub.conf"
    hub.write_text(hub.read_text().replace("figure_eight", "off"))

    # The program is stopped, but meant to run: as after a start that failed.
    host.run("systemctl stop lpac-robot")
    checks = run_doctor(enrolled, host.name)[host.name]
    assert checks["program"].found == "it is inactive (success)"
    # Its release has looked at PX4's parameters, and set them. What a loaded machine has not told
    # in time is a warning: try again.
    until_s = time.monotonic() + 120.0
    while checks["preflight"].verdict == "warning" and time.monotonic() < until_s:
        checks = run_doctor(enrolled, host.name)[host.name]
    assert checks["failsafe"].verdict == checks["preflight"].verdict == "ok"

    shown = lpac_fleet(enrolled.fleet_toml, "up", "--robots", host.name, "--json")
    found = json.loads(shown.stdout)["robots"][host.name]
    assert shown.returncode == 0, found["reasons"]
    assert found["go"]
    assert found["checks"][0]["found"] == "program started"

    # What is changed and not deployed is seen.
    text = enrolled.fleet_toml.read_text()
    for fleet_toml, as_deployed in ((re.sub("ceiling_m = .*", "ceiling_m = 20", text), False),
                                    (text, True)):  # fmt: skip
        enrolled.fleet_toml.write_text(fleet_toml)
        shown = lpac_fleet(enrolled.fleet_toml, "status", "--robots", host.name, "--json")
        assert json.loads(shown.stdout)["robots"][host.name]["is_configured"] is as_deployed
        checks = run_doctor(enrolled, host.name)[host.name]
        assert (checks["release"].verdict == "ok") is as_deployed

    # One that was stopped on purpose stays so.
    host.run("systemctl disable --now lpac-robot")
    assert asyncio.run(bring_up(config, robot, time.monotonic(), unwatched)) == ((), ())
    assert host.run("systemctl is-active lpac-robot || true") == "inactive\n"


def test_up_gives_robots_the_key_of_their_group(enrolled: FrailHosts, tmp_path: Path) -> None:
    host = enrolled[1]
    text = enrolled.fleet_toml.read_text()
    radio = '[radio]\ntransport = "multicast"\n\n[robot]'
    enrolled.fleet_toml.write_text(text.replace("[robot]", radio, 1))
    try:
        config = load_fleet(enrolled.fleet_toml)
        robot = config.robots[host.name]
        authority = open_authority(config)
        # Somebody who had the last one is a member no more.
        new_member(authority, tmp_path / "r9", Role.ROBOT, "r9", 9)
        authority.revoke("r9")
        shown = lpac_fleet(enrolled.fleet_toml, "up", "--timeout", "3")
        assert "multicast: a message in float16 takes 2" in shown.stdout
        kept = host.root / "var/lib/private/lpac/identity/group-keys"
        assert kept.read_bytes() == (authority.folder / "group-keys").read_bytes()
        assert kept.stat().st_mode & 0o077 == 0
        assert asyncio.run(bring_up(config, robot, time.monotonic(), unwatched)) == ((), ())
        assert run_doctor(enrolled, host.name)[host.name]["group key"].verdict == "ok"
        kept.unlink()
        lost = run_doctor(enrolled, host.name)[host.name]["group key"]
        assert (lost.verdict, lost.fix) == ("FAILED", "lpac fleet up")
        arrival = asyncio.run(bring_up(config, robot, time.monotonic(), unwatched))
        number = authority.members.number
        assert arrival == ((f"list of members {number} sent",), ())
        assert kept.read_bytes() == (authority.folder / "group-keys").read_bytes()
    finally:
        enrolled.fleet_toml.write_text(text)


def test_the_password_that_every_voxl_comes_with_is_found(enrolled: FrailHosts) -> None:
    host = enrolled[1]
    host.run("echo root:oelinux123 | chpasswd")
    try:
        doors = run_doctor(enrolled, host.name)[host.name]["doors"]
    finally:
        host.run("usermod --password '*' root")
    assert doors.verdict == "FAILED" and doors.fix.endswith("'passwd root'")


def test_no_clock_is_set_under_an_armed_vehicle(enrolled: FrailHosts) -> None:
    config = load_fleet(enrolled.fleet_toml)
    with armed(enrolled[1]):
        arrival = asyncio.run(
            bring_up(
                config, config.robots["r2"], time.monotonic(), unwatched,
                lambda: time.time() + 100.0,
            )
        )  # fmt: skip
    assert arrival.problems == (
        "the vehicle is armed: setting the clock is refused until it is disarmed",
    )
