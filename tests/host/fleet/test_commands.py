"""`lpac fleet` as an operator types it, with real robot computers on the other side."""

import json
import math
import os
import select
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from lpac.fleet.members import open_authority
from lpac.fleet.settings import load_fleet
from lpac.sim.hosts.rack import children
from lpac.sim.px4.modes import Px4Mode
from tests.host.fleet.field import (
    SILENT,
    armed,
    await_said,
    booted,
    deploy_to,
    lpac_fleet,
    running_lpac_fleet,
)
from tests.host.hosts import FrailHosts


class Operator:
    """Types commands for one fleet."""

    def __init__(self, hosts: FrailHosts) -> None:
        self.hosts = hosts
        self.fleet_toml = hosts.fleet_toml

    def __call__(self, command: str, *options: str) -> subprocess.CompletedProcess[str]:
        return lpac_fleet(self.fleet_toml, command, *options)

    def json(self, command: str, *options: str, exit_code: int = 0) -> dict[str, Any]:
        """What the command says of each robot."""
        result = self(command, "--json", *options)
        assert result.returncode == exit_code, result.stderr
        answer = json.loads(result.stdout)
        assert answer["fleet"] == self.hosts.fleet
        robots: dict[str, Any] = answer["robots"]
        return robots


@pytest.fixture(scope="module")
def operator(amd64_image: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Operator]:
    """Of two robots that run a release, and r3, a spare that has one."""
    with booted(amd64_image, tmp_path_factory.mktemp("hosts"), 3) as hosts:
        robots = deploy_to(hosts, "r1", "r2", "r3")
        assert {name: (robot["problem"], robot["summary"]) for name, robot in robots.items()} == {
            "r1": (None, "runs"), "r2": (None, "runs"), "r3": (None, "spare, not started"),
        }  # fmt: skip
        yield Operator(hosts)


def test_status_tells_of_release_program_vehicle_and_clock(operator: Operator) -> None:
    await_said(operator.hosts[0], '"armed":false')
    robots = operator.json("status")
    assert [robots[name]["slot"] for name in robots] == [0, 1, None]
    for name, robot in robots.items():
        assert robot["problem"] is robot["last_words"] is robot["pending"] is None
        assert robot["identity"]["robot"] == name
        assert isinstance(robot["clock_offset_s"], float)
    assert robots["r1"]["service"]["status"]["armed"] is False
    table, notes = operator("status").stdout.split("\n\n")
    r1, _, r3 = (line.split() for line in table.splitlines()[2:])
    assert r1[:4] == ["r1", "0", robots["r1"]["current"][:8], "up"]
    assert r1[6:8] == ["idle", "no"] or r1[6:8] == ["init", "no"]
    assert r3[:4] == ["r3", "spare", robots["r3"]["current"][:8], "stopped"]
    assert notes.split()[0] == "all"


def test_rotate_gives_a_robot_a_new_key_and_the_others_hear_it(operator: Operator) -> None:
    first = operator.hosts[0]
    key = "sha256sum /var/lib/private/lpac/identity/key.pem"
    before = first.run(key)
    done = operator("rotate", "--robots", "r1")
    assert done.returncode == 0, done.stderr
    assert first.run(key) != before
    # The others keep their keys, and let it in with its new one.
    for host in operator.hosts[:2]:
        await_said(host, '"peers":1')
    # Also the one that was switched off meanwhile, as far as it answers.
    known = open_authority(load_fleet(operator.fleet_toml)).members.text
    for host in operator.hosts:
        assert host.run("cat /var/lib/private/lpac/identity/members") == known


def test_a_program_that_cannot_start_and_a_host_that_is_another(operator: Operator) -> None:
    first, second, _ = operator.hosts
    world = "/opt/lpac/current/world.env"
    first.run(f"mv {world} /tmp/ && systemctl restart lpac-robot || true")
    second.run("sed -i s/r2/r7/ /etc/lpac/robot.json")
    try:
        robots = operator.json("status", exit_code=1)
        assert robots["r1"]["service"]["active"] in ("failed", "activating")
        assert "world.env" in robots["r1"]["last_words"]
        assert "answers r7 of fleet" in robots["r2"]["problem"]
        assert robots["r3"]["problem"] is None
        robots = operator.json("stop", "--robots", "r1,r2", exit_code=1)
        assert "answers r7 of fleet" in robots["r2"]["problem"]
        assert robots["r1"]["service"]["active"] in ("inactive", "failed")
        assert second.run("systemctl is-active lpac-robot").strip() == "active"
    finally:
        first.run(f"mv /tmp/world.env {world}")
        second.run("sed -i s/r7/r2/ /etc/lpac/robot.json")
    operator.json("start")


def test_a_robot_in_flight_refuses_unless_somebody_insists_and_is_landed_over_ssh(
    operator: Operator,
) -> None:
    r1, r2, _ = operator.hosts
    before = operator.json("status")["r2"]["service"]["status"]["boot_nonce"]

    def land() -> str:
        (robot,) = operator.json("land", "--robots", "r2", exit_code=1).values()
        return str(robot["problem"])

    with armed(r2):
        await_said(r2, '"armed":true')
        robots = operator.json("stop", "--robots", "r1,r2", exit_code=1)
        assert robots["r1"]["problem"] is None
        assert robots["r1"]["service"]["active"] == "inactive"
        assert robots["r2"]["problem"].startswith("the vehicle is armed: stopping is refused")
        (robot,) = operator.json("restart", "--robots", "r2", exit_code=1).values()
        assert robot["problem"].startswith("the vehicle is armed")
        service = operator.json("status")["r2"]["service"]
        assert (service["active"], service["status"]["boot_nonce"]) == ("active", before)

        (robot,) = operator.json("restart", "--robots", "r2", "--in-flight").values()
        assert robot["service"]["active"] == "active"
        assert robot["service"]["status"]["boot_nonce"] != before
        assert land() == (
            "its program runs: use `lpac mission land`, in pilot after `lpac mission rejoin`"
        )
        (robot,) = operator.json("stop", "--robots", "r2", "--in-flight").values()
        assert robot["service"]["active"] == "inactive"
        # A vehicle whose program is gone.
        with r2.stepped:
            r2.vehicle.parameters |= {"MPC_TKO_RAMP_T": 0.0, "MPC_LAND_SPEED": 1.5}
            r2.vehicle.take_off(math.nan)
            assert r2.stepped.wait_for(lambda: r2.vehicle.position_m[2] < -1.0, 120.0)
            listens_to = r2.vehicle.parameters["COM_RC_IN_MODE"]
            r2.vehicle.parameters["COM_RC_IN_MODE"] = 3
            r2.vehicle.pilot()
        assert land() == "a pilot flies it (position): the pilot must land it"
        with r2.stepped:
            assert (r2.vehicle.mode, r2.vehicle.armed) == (Px4Mode.POSCTL, True)
            r2.vehicle.set_mode(Px4Mode.HOLD)
            assert r2.stepped.wait_for(lambda: r2.vehicle.mode is Px4Mode.HOLD, 60.0)
        both = operator("land", "--robots", "r1,r2")
        assert both.returncode == 1
        assert "it lands" in both.stdout
        assert "it is disarmed: there is nothing to land" in both.stdout
        assert both.stderr.splitlines()[-1] == "lpac: landing: 1 of 2 robots; failed: r1"
        with r2.stepped:
            assert r2.vehicle.mode is Px4Mode.LAND
            assert r2.stepped.wait_for(lambda: not r2.vehicle.armed, 120.0)
            r2.vehicle.rc_connected = False
            r2.vehicle.parameters["COM_RC_IN_MODE"] = listens_to
    assert r1.run("systemctl is-enabled lpac-robot || true").strip() == "disabled"

    started = operator("start")
    assert started.returncode == 0, started.stderr
    assert "left out, since a spare is not started: r3" in started.stderr
    assert [line.split()[0] for line in started.stdout.splitlines()] == ["robot", "r1", "r2"]
    robots = operator.json("status")
    assert robots["r1"]["service"]["enabled"]
    assert [of["service"]["active"] for of in robots.values()] == [*["active"] * 2, "inactive"]


def test_a_robot_that_is_off_is_named_and_the_others_do_it(operator: Operator) -> None:
    world = operator.hosts.folder / "world.env"
    text = world.read_text()
    before = operator.json("status", "--robots", "r1")["r1"]["current"]
    world.write_text(text + text.splitlines()[-1] + "\n")
    operator.hosts[1].power_off()
    try:
        both = ("--robots", "r1,r2")
        with (
            running_lpac_fleet(operator.fleet_toml, "logs", *both) as logs,
            running_lpac_fleet(operator.fleet_toml, "exec", *both, "true") as ran,
        ):
            deployed = operator("deploy", *both)
            logs.communicate()
            _, complaints = ran.communicate()
    finally:
        operator.hosts[1].power_on()
        world.write_text(text)
    assert deployed.returncode == logs.returncode == ran.returncode == 1
    table, notes = deployed.stdout.split("\n\n")
    of_r1, of_r2 = (line.split() for line in table.splitlines()[1:])
    assert of_r1[1] != before and of_r1[-1] == "runs"
    assert float(of_r1[3]) > 0.0 and float(of_r1[4]) > 0.0  # its policy's ticks there, ms
    assert of_r2[-1] == "failed"
    assert notes.split(maxsplit=1) == ["r2", SILENT + "\n"]
    assert deployed.stderr.splitlines()[-1] == "lpac: deployed on 1 of 2 robots; failed: r2"
    # ssh's own complaint comes first.
    assert complaints.splitlines()[1:] == [
        f"r2  {SILENT}", "lpac: succeeded on 1 of 2 robots; failed: r2",
    ]  # fmt: skip

    assert "* behind r1" in operator("status").stdout  # which alone has the new world
    assert operator.json("rollback", "--robots", "r1") == {
        "r1": {"host": operator.hosts[0].address, "problem": None, "release": before}
    }


# Plain ssh


def test_logs_are_in_the_order_of_time(operator: Operator) -> None:
    result = operator("logs", "-n", "200")
    assert result.returncode == 0, result.stderr
    lines = [line.split() for line in result.stdout.splitlines()]
    assert {line[0] for line in lines} == {"r1", "r2"}  # r3 never ran
    assert any(line[2:5] == ["info", "robot", "runs"] for line in lines)
    entries = [
        json.loads(line) for line in operator("logs", "-n", "5", "--json").stdout.splitlines()
    ]
    assert [entry["robot"] for entry in entries].count("r1") == 5
    times_s = [entry["unix_time_s"] for entry in entries]
    assert times_s == sorted(times_s)


def test_logs_follow_until_ctrl_c(operator: Operator) -> None:
    asked = (operator.fleet_toml, "logs", "-f", "-n", "1", "--robots", "r1,r2")
    with running_lpac_fleet(*asked) as following:
        assert following.stdout is not None
        waiting = {"r1", "r2"}
        while waiting:
            waiting.discard(following.stdout.readline().split()[0])
        operator.hosts[0].run("systemctl restart lpac-robot")
        while not (line := following.stdout.readline()).startswith("r1") or "Stopped" not in line:
            assert line
        following.send_signal(signal.SIGINT)
        following.communicate()
        assert following.returncode == 0


def test_exec_runs_a_program_or_a_line_of_shell(operator: Operator) -> None:
    result = operator("exec", "--robots", "r1,r3", "--", "printf", "%s\\n", "a  b", "$HOME")
    assert result.returncode == 0, result.stderr
    assert sorted(result.stdout.splitlines()) == ["r1  $HOME", "r1  a  b", "r3  $HOME", "r3  a  b"]
    result = operator("exec", "ip -4 -o address | grep -q 10.*[.]12/ && echo me >&2")
    assert (result.returncode, result.stdout) == (1, "")
    lines = result.stderr.splitlines()
    assert sorted(lines[:-1]) == ["r1  exit code 1", "r2  me", "r3  exit code 1"]
    assert lines[-1] == "lpac: succeeded on 1 of 3 robots; failed: r1, r3"
    robots = operator.json(
        "exec", "--robots", "r3", "--", "sh", "-c", "echo out; exit 3", exit_code=1
    )
    assert robots["r3"] == {
        "host": operator.hosts[2].address, "problem": "exit code 3", "exit_code": 3,
        "stdout": ["out"], "stderr": [],
    }  # fmt: skip


def test_ctrl_c_ends_with_a_summary_of_who_has_what(operator: Operator) -> None:
    patient = operator.hosts.folder / "patient.toml"
    text = operator.fleet_toml.read_text()
    patient.write_text(text.replace("[ssh]\n", "[ssh]\nconnect_timeout_s = 300.0\n"))
    operator.json("start")
    hung = operator.hosts[1]
    # Its kernel takes the connection, and then nobody says anything.
    hung.run("pkill -STOP -x sshd")
    try:
        with running_lpac_fleet(patient, "deploy") as deploying:
            assert deploying.stderr is not None
            waiting = {"r1", "r3"}
            while waiting:
                _, _, name, text = deploying.stderr.readline().split(maxsplit=3)
                if text == "done\n":
                    waiting.remove(name)
            (ssh,) = map(os.pidfd_open, children(deploying.pid))
            deploying.send_signal(signal.SIGINT)
            output, complaints = deploying.communicate()
        # What it began it has ended.
        assert select.select([ssh], [], [], 60.0)[0]
        os.close(ssh)
    finally:
        hung.run("pkill -CONT -x sshd")
    assert deploying.returncode == 1
    assert complaints.splitlines()[-1] == "lpac: deployed on 2 of 3 robots; failed: r2"
    table, notes = output.split("\n\n")
    assert [line.split()[-1] for line in table.splitlines()[1:]] == [
        "unchanged", "failed", "unchanged",
    ]  # fmt: skip
    assert notes.split() == ["r2", "interrupted", "at", "connect"]
