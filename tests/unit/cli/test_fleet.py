"""What `lpac fleet` prints: lines of a journal, and the table of robots."""

import json
import time
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from lpac.cli.fleet import membership
from lpac.cli.fleet.status import State, print_status
from lpac.cli.main import app
from lpac.fleet.logs import Entry, parse_entry, readable
from lpac.fleet.operations import Outcome
from lpac.fleet.session import UnreachableError
from lpac.fleet.settings import FleetConfig, load_fleet
from tests.conftest import ROOT, SHIPPED

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


@pytest.mark.parametrize(
    ("command", "named"),
    [
        (["fleet", "land", "--robots", "r1"], "robots.r1: host = '192.168.8.011'"),
        (["fleet", "enroll", "r9", "192.168.8.011"], "HOST = '192.168.8.011'"),
        (["fleet", "enroll", "r9", "drone9", "--address", "192.168.8.011"], "'192.168.8.011'"),
        (["map", "--host", "127.0.0.011"], "--host = '127.0.0.011'"),
        (["foxglove", "live", "--host", "127.0.0.011"], "--host = '127.0.0.011'"),
    ],
    ids=["file", "enroll", "address", "map", "foxglove"],
)
def test_an_address_that_others_read_in_another_way_is_refused(
    tmp_path: Path, command: list[str], named: str
) -> None:
    path = write_fleet(tmp_path, 22)
    if "land" in command:
        path.write_text(path.read_text().replace('"127.0.0.1"', '"192.168.8.011"'))
    result = CliRunner().invoke(app, [*command, "--fleet", str(path)])
    assert isinstance(result.exception, ValueError)
    assert named in str(result.exception) and "must be" in str(result.exception)


@pytest.mark.parametrize("changed", [True, False])
def test_a_changed_list_of_members_is_brought_although_a_robot_is_not_enrolled(
    monkeypatch: pytest.MonkeyPatch, changed: bool
) -> None:
    brought: list[str] = []
    lists = iter([b"before", b"after" if changed else b"before"])

    def enroll(name: str, _: object) -> list[str]:
        if name == "r2":
            raise UnreachableError("r2 does not answer")
        return []

    monkeypatch.setattr(membership, "_enroll", enroll)
    monkeypatch.setattr(membership, "_members", lambda _: next(lists))
    monkeypatch.setattr(membership, "send_list", lambda config: brought.extend(config.robots))
    result = CliRunner().invoke(app, ["fleet", "enroll", "--fleet", str(EXAMPLE)])
    assert str(result.exception) == "r2 does not answer"
    assert brought == (list(load_fleet(EXAMPLE).robots) if changed else [])


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


def date(unix_time_s: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M", time.localtime(unix_time_s))


NEWEST = date(1796000000)


@pytest.fixture
def fleet(tmp_path: Path) -> FleetConfig:
    return load_fleet(write_fleet(tmp_path, 22, flying=10, spares=1))


def overview(**changes: Any) -> dict[str, Any]:
    service = {
        "active": "active", "result": "success", "restarts": 0, "installed": True, "fresh": True,
        "uptime_s": 754.0,
        "status": {
            "state": "preflight", "armed": False, "battery": 1.0, "satellites": 14, "peers": 9,
            "failed_checks": [
                {"code": "ground_not_heard", "text": "x", "settles_by_itself": False}
            ],
        },
    } | changes.pop("service", {})  # fmt: skip
    versions = {"image": "1" * 16, "bundle": "2" * 64, "world": "3" * 12}
    return {
        "current": "0123456789abcdef", "number": "1796000000", "pending": None,
        "versions": versions, "service": service,
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
        ["all", f"{NEWEST}: image 11111111, bundle 22222222, world 33333333"],
    ]


def test_what_is_not_as_it_should_be_is_noted(
    fleet: FleetConfig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    other = overview(number=str(1796000000 - 60))
    other["versions"] |= {"world": "4" * 12}
    failed = {"active": "failed", "result": "exit-code", "fresh": False, "restarts": 5}
    never = {"active": "inactive", "installed": False, "fresh": False, "status": None}
    states: list[State | None] = [
        State(overview(), 0, 0.0, None),
        State(overview(pending="fedcba9876543210"), 1, -70.0, None),
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
    assert [line.split()[0] for line in notes] == ["r2", "r3", "r4", "r4", "newest"]
    assert "fedcba98 not confirmed" in notes[0]
    before = date(1796000000 - 60)
    parts = "image 11111111, bundle 22222222, world 44444444"
    assert notes[1].split("*")[1].strip() == f"behind r1: {before}: {parts}"
    assert notes[2].endswith("lpac: no such file")
    assert "systemd restarted its program 5 times" in notes[3]


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
        "its configuration is not that of fleet.toml: lpac fleet deploy --robots r1" in (notes[0])
    )
