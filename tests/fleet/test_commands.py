"""`lpac fleet` as an operator types it, with real robot computers on the other side."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from sim.hosts import RobotHosts
from tests.cli.test_cli import lpac
from tests.conftest import ROOT


class Operator:
    """Types commands for one fleet."""

    def __init__(self, hosts: RobotHosts) -> None:
        self.hosts = hosts
        self.fleet_toml = hosts.fleet_toml

    def __call__(self, command: str, *options: str) -> subprocess.CompletedProcess[str]:
        return lpac("fleet", command, "--fleet", self.fleet_toml, *options)

    def json(self, command: str, *options: str, exit_code: int = 0) -> dict[str, Any]:
        """What the command says of each robot."""
        result = self(command, "--json", *options)
        assert result.returncode == exit_code, result.stderr
        answer = json.loads(result.stdout)
        assert answer["fleet"] == self.hosts.fleet
        robots: dict[str, Any] = answer["robots"]
        return robots

    def services(self) -> dict[str, str]:
        """How the unit is on each robot."""
        return {name: of["service"]["active"] for name, of in self.json("status").items()}

    @contextmanager
    def typing(
        self, command: str, *options: str, fleet_toml: Path | None = None
    ) -> Iterator[subprocess.Popen[str]]:
        """A command that runs meanwhile."""
        with subprocess.Popen(
            [sys.executable, "-m", "cli.main", "fleet", command, *options,
             "--fleet", str(fleet_toml or self.fleet_toml)],
            cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            env={**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "100"},
        ) as process:  # fmt: skip
            try:
                yield process
            finally:
                process.kill()


@pytest.fixture(scope="module")
def operator(hosts: RobotHosts) -> Operator:
    """Of three robots that run a release, and a spare that has one."""
    operator = Operator(hosts)
    for host in hosts:
        identity = {"fleet": hosts.fleet, "robot": host.name, "robot_id": host.robot_id}
        host.run(f"mkdir -p /etc/lpac && echo '{json.dumps(identity)}' > /etc/lpac/robot.json")
    robots = operator.json("deploy")
    assert {name: robot["problem"] for name, robot in robots.items()} == dict.fromkeys(
        ("r1", "r2", "r3", "r4")
    )
    assert robots["r4"]["summary"] in ("spare, not started", "unchanged")
    return operator


def test_deploy_again_says_that_nothing_changed(operator: Operator) -> None:
    result = operator("deploy")
    assert result.returncode == 0, result.stderr
    status = operator.json("status")
    rows = [line.split() for line in result.stdout.splitlines()[1:]]
    assert [(row[0], row[1], row[2], row[-1]) for row in rows] == [
        (name, status[name]["current"], "0.0", "unchanged") for name in ("r1", "r2", "r3", "r4")
    ]


def test_status_tells_of_release_program_vehicle_and_clock(operator: Operator) -> None:
    operator.json("restart")
    robots = operator.json("status")
    assert [robots[name]["slot"] for name in robots] == [0, 1, 2, None]
    for name, robot in robots.items():
        assert robot["problem"] is robot["last_words"] is robot["pending"] is None
        assert robot["identity"]["robot"] == name
        assert abs(robot["clock_offset_s"]) < 60.0  # the same clock; but CI may be slow
    assert robots["r1"]["service"]["status"]["armed"] is False
    table, notes = operator("status").stdout.split("\n\n")
    r1, *_, r4 = (line.split() for line in table.splitlines()[2:])
    assert r1[:4] == ["r1", "0", robots["r1"]["current"][:8], "up"]
    assert r1[6:8] == ["idle", "no"] or r1[6:8] == ["init", "no"]
    assert r4[:4] == ["r4", "spare", robots["r4"]["current"][:8], "stopped"]
    assert notes.split()[0] == "all"


def test_a_program_that_cannot_start_and_a_host_that_is_another(operator: Operator) -> None:
    first, second, _, _ = operator.hosts
    world = "/opt/lpac/current/world.env"
    first.run(f"mv {world} /tmp/ && systemctl restart lpac-robot || true")
    second.run("sed -i s/r2/r7/ /etc/lpac/robot.json")
    try:
        robots = operator.json("status", exit_code=1)
        assert robots["r1"]["service"]["active"] in ("failed", "activating")
        assert "world.env" in robots["r1"]["last_words"]
        assert "answers r7 of fleet" in robots["r2"]["problem"]
        assert robots["r3"]["problem"] is None
        robots = operator.json("stop", "--robots", "r2,r3", exit_code=1)
        assert "answers r7 of fleet" in robots["r2"]["problem"]
        assert robots["r3"]["service"]["active"] == "inactive"
        assert second.run("systemctl is-active lpac-robot").strip() == "active"
    finally:
        first.run(f"mv /tmp/world.env {world}")
        second.run("sed -i s/r7/r2/ /etc/lpac/robot.json")
    operator.json("start")


def test_stop_start_and_restart(operator: Operator) -> None:
    robots = operator.json("stop")
    assert {name: of["service"]["active"] for name, of in robots.items()} == dict.fromkeys(
        ("r1", "r2", "r3", "r4"), "inactive"
    )
    assert operator.hosts[0].run("systemctl is-enabled lpac-robot || true").strip() == "disabled"
    started = operator("start")
    assert started.returncode == 0
    assert "left out, since a spare is not started: r4" in started.stderr
    assert [line.split()[0] for line in started.stdout.splitlines()] == ["robot", "r1", "r2", "r3"]
    before = operator.json("status")
    assert before["r1"]["service"]["enabled"] and before["r4"]["service"]["active"] == "inactive"
    after = operator.json("restart", "--robots", "r1")
    nonces = [of["r1"]["service"]["status"]["boot_nonce"] for of in (before, after)]
    assert nonces[0] != nonces[1]


@pytest.mark.parametrize("command", ["stop", "restart"])
def test_a_robot_in_flight_refuses_unless_somebody_insists(
    operator: Operator, command: str
) -> None:
    host = operator.hosts[1]
    with host.stepped:
        host.vehicle.parameters["COM_DISARM_PRFLT"] = 0.0  # never by itself
        host.vehicle.arm(force=True)
    try:
        until_s = time.monotonic() + 60.0
        while operator.json("status")["r2"]["service"]["status"]["armed"] is not True:
            assert time.monotonic() < until_s
        robots = operator.json(command, "--robots", "r1,r2", exit_code=1)
        assert robots["r1"]["problem"] is None
        assert robots["r2"]["problem"].startswith("the vehicle is armed")
        assert operator.services()["r2"] == "active"
        assert operator(command, "--robots", "r2", "--in-flight").returncode == 0
    finally:
        with host.stepped:
            host.vehicle.disarm(force=True)
    assert operator.services()["r2"] == {"stop": "inactive", "restart": "active"}[command]
    operator.json("start")


def test_a_robot_that_is_off_is_named_and_the_others_do_it(operator: Operator) -> None:
    operator.hosts[2].power_off()
    try:
        deployed = operator("deploy", "--robots", "r1,r3")
        assert operator("logs", "--robots", "r1,r3").returncode == 1
        ran = operator("exec", "--robots", "r1,r3", "true")
    finally:
        operator.hosts[2].power_on()
    assert deployed.returncode == ran.returncode == 1
    table, notes = deployed.stdout.split("\n\n")
    assert [line.split()[-1] for line in table.splitlines()] == ["result", "unchanged", "failed"]
    silent = "it does not answer: it is off, or out of reach"
    assert notes.split(maxsplit=1) == ["r3", silent + "\n"]
    assert deployed.stderr.splitlines()[-1] == "lpac: deployed on 1 of 2 robots; failed: r3"
    # ssh's own complaint comes first.
    assert ran.stderr.splitlines()[1:] == [
        f"r3  {silent}", "lpac: succeeded on 1 of 2 robots; failed: r3",
    ]  # fmt: skip


def test_rollback_needs_a_release_to_go_back_to(operator: Operator) -> None:
    world = operator.hosts.folder / "world.env"
    text = world.read_text()
    before = operator.json("status", "--robots", "r1")["r1"]["current"]
    world.write_text(text + text.splitlines()[-1] + "\n")
    try:
        deployed = operator.json("deploy", "--robots", "r1")["r1"]
    finally:
        world.write_text(text)
    assert deployed["release"] != before and deployed["summary"] == "runs"
    assert deployed["perceive_p99_ms"] > 0 and deployed["infer_p99_ms"] > 0
    assert "* image" in operator("status").stdout  # r1 has another world than the others
    assert operator.json("rollback", "--robots", "r1") == {
        "r1": {"host": operator.hosts[0].address, "problem": None, "release": before}
    }
    again = operator.json("rollback", "--robots", "r1", exit_code=1)["r1"]
    assert "no earlier release" in again["problem"]


# Plain ssh


def test_logs_are_in_the_order_of_time(operator: Operator) -> None:
    operator.json("restart")
    result = operator("logs", "-n", "20")
    assert result.returncode == 0, result.stderr
    lines = [line.split() for line in result.stdout.splitlines()]
    assert {line[0] for line in lines} == {"r1", "r2", "r3"}  # r4 never ran
    assert any(line[2:5] == ["info", "robot", "runs"] for line in lines)
    entries = [
        json.loads(line) for line in operator("logs", "-n", "5", "--json").stdout.splitlines()
    ]
    assert [entry["robot"] for entry in entries].count("r1") == 5
    times_s = [entry["unix_time_s"] for entry in entries]
    assert times_s == sorted(times_s)


def test_logs_follow_until_ctrl_c(operator: Operator) -> None:
    with operator.typing("logs", "-f", "-n", "1", "--robots", "r1,r2") as following:
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
    assert sorted(lines[:-1]) == ["r1  exit code 1", "r2  me", "r3  exit code 1", "r4  exit code 1"]
    assert lines[-1] == "lpac: succeeded on 1 of 4 robots; failed: r1, r3, r4"
    robots = operator.json(
        "exec", "--robots", "r4", "--", "sh", "-c", "echo out; exit 3", exit_code=1
    )
    assert robots["r4"] == {
        "host": operator.hosts[3].address, "problem": "exit code 3", "exit_code": 3,
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
        with operator.typing("deploy", fleet_toml=patient) as deploying:
            assert deploying.stderr is not None
            waiting = {"r1", "r3", "r4"}
            while waiting:
                _, _, name, text = deploying.stderr.readline().split(maxsplit=3)
                if text == "done\n":
                    waiting.remove(name)
            deploying.send_signal(signal.SIGINT)
            output, _ = deploying.communicate()
    finally:
        hung.run("pkill -CONT -x sshd")
    assert deploying.returncode == 1
    table, notes = output.split("\n\n")
    assert [line.split()[-1] for line in table.splitlines()[1:]] == [
        "unchanged", "failed", "unchanged", "unchanged",
    ]  # fmt: skip
    assert notes.split() == ["r2", "interrupted", "at", "connect"]
