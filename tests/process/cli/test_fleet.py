"""`lpac fleet` as a user types it, as far as no robot has to answer; and what tables look like."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from lpac.cli.fleet_status import State, print_status
from lpac.fleet.config import FleetConfig, load_fleet
from lpac.fleet.logs import Entry, parse_entry, readable
from lpac.fleet.operations import Outcome
from tests.conftest import ROOT, SHIPPED
from tests.process.cli.test_cli import error_line, lpac

needs_ssh = pytest.mark.skipif(shutil.which("ssh") is None, reason="needs OpenSSH's ssh")

EXAMPLE = ROOT / "docs" / "fleet.toml"


def write_fleet(folder: Path, port: int, flying: int = 2, spares: int = 1) -> Path:
    """Robots r1, r2, ... at one port of this machine's addresses, the last ones without a slot."""
    example = EXAMPLE.read_text()
    shared = example[example.index("[robot]") : example.index("# The robots:")]
    shared = shared.replace("ceiling_m = 30.0", "ceiling_m = 60.0")
    path = folder / "fleet.toml"

    def place(n: int) -> str:
        at_m = [9 * (n % 4), 2 + 9 * (n // 4)]
        return f"pad_m = {at_m}\nlanding_point_m = {at_m}\n"

    path.write_text(
        f'fleet = "test"\nimage = "no image"\nbundle = "{SHIPPED}"\nworld = "world.env"\n{shared}'
        + "".join(
            f'[robots.r{n}]\nhost = "127.0.0.{n}"\nport = {port}\nrobot_id = {n}\n'
            for n in range(1, flying + spares + 1)
        )
        + "".join(f'[[slots]]\nrobot = "r{n}"\n{place(n)}' for n in range(1, flying + 1))
    )
    (folder / "world.env").write_text("CircularBND 100 100 10 1\n")
    return path


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
    assert str(missing) in error_line(lpac("fleet", "status", "--fleet", missing))
    line = error_line(lpac("fleet", "stop", "--fleet", nobody, "--robots", "r1,r9"))
    assert "'r9'" in line and "r1, r2, r3" in line


def test_deploy_needs_an_image_before_it_asks_any_robot(nobody: Path) -> None:
    line = error_line(lpac("fleet", "deploy", "--fleet", nobody))
    assert line.endswith("no image: no image is there: run `make image`")


@pytest.mark.parametrize("command", ["start", "restart", "rollback"])
def test_a_spare_is_left_out(nobody: Path, command: str) -> None:
    line = error_line(lpac("fleet", command, "--fleet", nobody, "--robots", "r3"))
    assert "r3" in line and "spare" in line
    result = lpac("fleet", command, "--fleet", nobody)
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
    result = lpac("fleet", name, "--fleet", nobody, "--robots", "r1,r2", "--json", *options)
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
    result = lpac("fleet", "logs", "--fleet", nobody, "--robots", "r2", *follow)
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
    result = lpac("fleet", "status", "--fleet", here, "--robots", "r1")
    assert error_line(result) == "lpac: reached 0 of 1 robot; failed: r1"
    assert "its login shell prints" in result.stdout and greeting in result.stdout
    result = lpac("fleet", "logs", "--fleet", here, "--robots", "r1")
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


def entry(text: object) -> Entry:
    return parse_entry(json.dumps({"__REALTIME_TIMESTAMP": "1700000000250000", "MESSAGE": text}))


@pytest.mark.parametrize(
    ("message", "shown"),
    [
        ("Started LPAC robot.", "Started LPAC robot."),
        (
            '{"event": "flight state", "state": "idle", "reason": "all is well", "ticks": 3, '
            '"level": "info", "timestamp": "2026-11-21T15:28:17.6Z"}',
            'info flight state state=idle reason="all is well" ticks=3',
        ),
        ('{"not": "an event"}', '{"not": "an event"}'),
        ("{broken", "{broken"),
        ([*"\N{DEGREE SIGN}".encode(), 255], "\N{DEGREE SIGN}\N{REPLACEMENT CHARACTER}"),
        (None, ""),
    ],
)
def test_lines_of_a_journal(message: object, shown: str) -> None:
    time_of_day, _, text = readable(entry(message)).partition(" ")
    assert text == shown
    assert len(time_of_day) == 8 and time_of_day.endswith(":20")


def test_an_exception_keeps_its_lines() -> None:
    text = json.dumps({"event": "a loop fails", "level": "error", "exception": "Traceback\n  at 1"})
    assert readable(entry(text)).split(" ", 1)[1] == "error a loop fails\nTraceback\n  at 1"


def test_what_is_no_journal_is_said() -> None:
    with pytest.raises(ValueError, match="journalctl printed 'bash: nonsense'"):
        parse_entry("bash: nonsense")


# The table


@pytest.fixture
def fleet(tmp_path: Path) -> FleetConfig:
    return load_fleet(write_fleet(tmp_path, 22, flying=10, spares=1))


def overview(**changes: Any) -> dict[str, Any]:
    service = {
        "active": "active", "result": "success", "restarts": 0, "installed": True, "fresh": True,
        "uptime_s": 754.0,
        "status": {
            "state": "preflight", "armed": False, "battery": 1.0, "satellites": 14, "peers": 9,
            "failed_checks": ["ground was not heard"],
        },
    } | changes.pop("service", {})  # fmt: skip
    versions = {"image": "1" * 16, "bundle": "2" * 64, "world": "3" * 12}
    return {
        "current": "0123456789abcdef", "pending": None, "versions": versions, "service": service,
    } | changes  # fmt: skip


def printed(
    fleet: FleetConfig, states: list[State | None], capsys: pytest.CaptureFixture[str]
) -> tuple[list[str], list[str]]:
    """The lines of the table, heading and all, and those of the notes."""
    robots = list(fleet.robots.values())
    problems = [None if state else "it does not answer [or so]" for state in states]
    outcomes = [
        Outcome(*each) for each in zip(robots[: len(states)], states, problems, strict=True)
    ]
    print_status(fleet, outcomes)
    table, _, notes = capsys.readouterr().out.partition("\n\n")
    return [line.rstrip() for line in table.splitlines()], [
        line.rstrip() for line in notes.splitlines()
    ]


@pytest.mark.parametrize("width", [80, 100])
def test_ten_robots_fit_the_terminal(
    fleet: FleetConfig,
    width: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    states: list[State | None] = [State(overview(), n, 0.02, None) for n in range(10)]
    table, notes = printed(fleet, [*states, None], capsys)
    assert max(map(len, table + notes)) <= width
    assert len(table) == 2 + 11  # the headings take two lines
    rows = [line.split() for line in table[2:]]
    assert rows[9] == [
        "r10", "9", "01234567", "up", "13", "min", "preflight", "no", "100", "%", "14", "9", "1",
        "+0.0",
    ]  # fmt: skip
    assert rows[10] == ["r11", "spare", "see", "below"]
    assert [line.split(maxsplit=1) for line in notes] == [
        ["r11", "it does not answer [or so]"],
        ["all", "image 11111111, bundle 22222222, world 33333333"],
    ]


def test_what_is_not_as_it_should_be_is_noted(
    fleet: FleetConfig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    other = overview()
    other["versions"] |= {"world": "4" * 12}
    failed = {"active": "failed", "result": "exit-code", "fresh": False, "restarts": 5}
    never = {"active": "inactive", "installed": False, "fresh": False, "status": None}
    states: list[State | None] = [
        State(overview(), 0, 0.0, None),
        State(overview(pending={"release": "fedcba9876543210", "former": None}), 1, -70.0, None),
        State(other, 2, 0.0, None),
        State(overview(service=failed), 3, 0.0, "lpac: no such file"),
        State(overview(current=None, versions=None, service=never), 4, 0.0, None),
    ]
    table, notes = printed(fleet, states, capsys)
    rows = [line.split() for line in table[2:]]
    assert rows[1][2] == "01234567?" and rows[1][-1] == "-70.0"
    assert rows[2][2] == "01234567*"
    assert rows[3][2:] == ["01234567", "failed", "+0.0"]
    assert rows[4][2:] == ["none", "none", "+0.0"]
    assert [line.split()[0] for line in notes] == ["r2", "r3", "r4", "r4", "others"]
    assert "fedcba98 is not confirmed yet" in notes[0]
    assert notes[1].split("*")[1].strip() == "image 11111111, bundle 22222222, world 44444444"
    assert notes[2].endswith("lpac: no such file")
    assert "restarted 5 times" in notes[3]


def test_a_configuration_that_was_not_deployed_is_marked(
    fleet: FleetConfig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    states: list[State | None] = [
        State(overview(), n, 0.0, None, is_configured=n > 0) for n in range(2)
    ]
    table, notes = printed(fleet, states, capsys)
    assert [line.split()[2] for line in table[2:]] == ["01234567*", "01234567"]
    assert [line.split()[0] for line in notes] == ["r1", "all"]
    assert (
        "its configuration is not the one of fleet.toml: lpac fleet deploy --robots r1"
        in (notes[0])
    )
