"""`lpac fleet` as a user types it, as far as no robot has to answer."""

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.command import called, error_line, lpac
from tests.conftest import ROOT
from tests.host.fleet.field import lpac_fleet
from tests.needs import needs
from tests.unit.cli.test_fleet import write_fleet

needs_ssh = needs("ssh")


@pytest.fixture
def nobody(tmp_path: Path) -> Iterator[Path]:
    """A fleet of two robots and a spare; connections to them are refused."""
    with socket.socket() as bound:  # and not listening
        bound.bind(("0.0.0.0", 0))
        yield write_fleet(tmp_path, bound.getsockname()[1])


def test_help_names_the_commands() -> None:
    result = lpac("fleet", "--help")
    assert result.returncode == 0
    for command in ("deploy", "rollback", "start", "stop", "restart", "status", "logs", "exec"):
        assert command in result.stdout


def test_a_fleet_or_robot_that_is_not_there(tmp_path: Path, nobody: Path) -> None:
    missing = tmp_path / "other.toml"
    assert str(missing) in error_line(called("fleet", "status", "--fleet", missing))
    line = error_line(called("fleet", "stop", "--fleet", nobody, "--robots", "r1,r9"))
    assert "'r9'" in line and "r1, r2, r3" in line


def test_deploy_needs_an_image_before_it_asks_any_robot(nobody: Path) -> None:
    line = error_line(called("fleet", "deploy", "--fleet", nobody))
    assert line.endswith("no image: has no image: run `make image`")


@pytest.mark.parametrize("command", ["start", "restart", "rollback"])
def test_a_spare_is_left_out(nobody: Path, command: str) -> None:
    line = error_line(called("fleet", command, "--fleet", nobody, "--robots", "r3"))
    assert "r3" in line and "spare" in line
    result = called("fleet", command, "--fleet", nobody)
    assert result.stderr.startswith("left out, since a spare is not ")
    assert result.stderr.endswith("0 of 2 robots; failed: r1, r2\n")


@needs_ssh
def test_each_robot_that_does_not_answer_is_named_with_the_reason(nobody: Path) -> None:
    result = lpac("fleet", "status", "--fleet", nobody)
    assert error_line(result) == "lpac: reached 0 of 3 robots; failed: r1, r2, r3"
    rows, notes = result.stdout.split("\n\n")
    assert [line.split() for line in rows.splitlines()[2:]] == [
        ["r1", "0", "see", "below"], ["r2", "1", "see", "below"], ["r3", "spare", "see", "below"],
    ]  # fmt: skip
    assert [line.split(maxsplit=1) for line in notes.splitlines()] == [
        [name, "nothing listens on its ssh port"] for name in ("r1", "r2", "r3")
    ]


@needs_ssh
@pytest.mark.parametrize(
    "command", [("status",), ("stop",), ("restart", "--in-flight"), ("rollback",), ("exec", "true")]
)
def test_json_has_every_robot(nobody: Path, command: tuple[str, ...]) -> None:
    name, *options = command
    result = called("fleet", name, "--fleet", nobody, "--robots", "r1,r2", "--json", *options)
    assert result.returncode == 1
    problem = "nothing listens on its ssh port"
    assert json.loads(result.stdout) == {
        "fleet": "test",
        "robots": {
            "r1": {"host": "127.0.0.1", "problem": problem},
            "r2": {"host": "127.0.0.2", "problem": problem},
        },
    }


@needs_ssh
@pytest.mark.parametrize("follow", [[], ["-f"]])
def test_logs_of_a_robot_that_does_not_answer(nobody: Path, follow: list[str]) -> None:
    result = called("fleet", "logs", "--fleet", nobody, "--robots", "r2", *follow)
    assert (result.returncode, result.stdout) == (1, "")
    assert result.stderr.splitlines() == [
        "r2  nothing listens on its ssh port",
        "lpac: read the journal of 0 of 1 robot; failed: r2",
    ]


@needs_ssh
def test_up_on_a_terminal_has_a_board_though_no_robot_has_come_up(
    nobody: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")  # as a terminal, to rich
    result = lpac("fleet", "up", "--fleet", nobody, "--timeout", "0")
    assert result.stdout.count("nothing listens on its ssh port") >= 2
    assert result.stdout.count("keep free: the fence and ") == 1
    assert result.stderr.endswith("lpac: NO-GO: r1, r2\n")


@pytest.fixture
def here(nobody: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A fleet whose robots are this machine's shell, which says GREETING at every login."""
    ssh = tmp_path / "bin" / "ssh"
    ssh.parent.mkdir()
    ssh.write_text('#!/bin/sh\nprintf "$GREETING"\nfor last; do :; done\nexec sh -c "$last"\n')
    ssh.chmod(0o755)
    monkeypatch.setenv("PATH", f"{ssh.parent}:{os.environ['PATH']}")
    return nobody


def is_there(pid: int) -> bool:
    return Path(f"/proc/{pid}").exists()


@pytest.mark.parametrize("greeting", ["Welcome!", "1", "[]", "{}", '"progress"'])
def test_a_login_shell_that_prints_is_named(
    here: Path, monkeypatch: pytest.MonkeyPatch, greeting: str
) -> None:
    monkeypatch.setenv("GREETING", greeting + "\\n")
    result = called("fleet", "status", "--fleet", here, "--robots", "r1")
    assert error_line(result) == "lpac: reached 0 of 1 robot; failed: r1"
    assert "its login shell prints" in result.stdout and greeting in result.stdout
    result = called("fleet", "logs", "--fleet", here, "--robots", "r1")
    assert result.stderr.startswith(f"r1  journalctl printed {greeting!r}")


def test_exec_ends_quietly_when_nobody_reads_on(here: Path) -> None:
    # One talks without end; the others would stay for long.
    first = f"mkdir '{here.parent / 'first'}' 2> /dev/null && exec seq 1 9999999"
    command = f"{first}; echo process $$; exec sleep 1000"
    with subprocess.Popen(
        [sys.executable, "-m", "lpac.cli.main", "fleet", "exec", "--fleet", str(here), command],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as program:  # fmt: skip
        assert program.stdout is not None and program.stderr is not None
        silent: list[int] = []
        while len(silent) < 2:
            if "process" in (line := program.stdout.readline()):
                silent.append(int(line.split()[-1]))
        program.stdout.close()
        assert program.stderr.read() == ""
    assert program.returncode == -signal.SIGPIPE
    assert not any(map(is_there, silent))


@pytest.mark.parametrize("times", [1, 2])
def test_ctrl_c_ends_all_sessions_in_order(here: Path, times: int) -> None:
    came = here.parent / "came"
    os.mkfifo(came)
    ssh = here.parent / "bin" / "ssh"
    ssh.write_text(f"#!/bin/sh\necho $$ > '{came}'\nexec sleep 1000\n")
    with subprocess.Popen(
        [sys.executable, "-m", "lpac.cli.main", "fleet", "stop", "--fleet", str(here)], cwd=ROOT,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as program:  # fmt: skip
        # Open for writing too: one that comes late finds somebody who reads.
        with open(os.open(came, os.O_RDWR)) as arrivals:  # noqa: PTH123
            begun = [int(arrivals.readline()) for _ in range(3)]
        for _ in range(times):
            program.send_signal(signal.SIGINT)
        output, complaints = program.communicate()
    assert program.returncode == 1
    assert output.count("interrupted at connect") == 3
    assert "Traceback" not in complaints and "Exception" not in complaints
    assert complaints.endswith("lpac: stopped on 0 of 3 robots; failed: r1, r2, r3\n")
    assert not any(map(is_there, begun))


@needs("ssh", "ssh-keygen", "rsync")
def test_the_laptop_is_looked_at_and_what_it_lacks_is_named(tmp_path: Path) -> None:
    fleet = write_fleet(tmp_path, 22)

    def look(**environment: str) -> dict[str, dict[str, str]]:
        asked = (fleet, "doctor", "--laptop", "--json")
        shown = lpac_fleet(*asked, environment=environment)
        return {c["name"]: c for c in json.loads(shown.stdout)["robots"]["laptop"]["checks"]}

    checks = look()
    assert list(checks) == ["tools", "keys", "sleep", "clock", "firewall"]
    assert checks["tools"]["verdict"] == "ok"
    tools = look(PATH=str(tmp_path))["tools"]
    assert (tools["verdict"], tools["found"]) == ("FAILED", "ssh, ssh-keygen, rsync is missing")
