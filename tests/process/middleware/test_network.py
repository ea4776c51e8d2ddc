"""`lpac bench network` on the loopback: real programs, sockets and clocks."""

import json
import os
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from lpac.middleware.kinds import MIDDLEWARES, NOTHING
from lpac.middleware.measure import MiddlewareFleet
from lpac.middleware.places import LOOPBACK
from lpac.middleware.results import MEASURES
from tests.command import called, error_line, lpac
from tests.conftest import ROOT

# Timeout, also for a busy machine.
PATIENCE_S = 120.0
INSTALLED = [
    pytest.param(
        name,
        marks=pytest.mark.skipif(
            middleware.version() is None,
            reason=f"{middleware.title} is not installed: `{middleware.install}`",
        ),
    )
    for name, middleware in MIDDLEWARES.items()
]


@pytest.mark.parametrize("middleware", INSTALLED)
def test_robots_hear_each_other_and_do_so_again_after_all_have_restarted(middleware: str) -> None:
    with MiddlewareFleet([LOOPBACK] * 3) as fleet:
        fleet.load(middleware)
        for start in (0, 1):
            fleet.start(middleware, 3, start)
            patience_until_s = time.monotonic() + PATIENCE_S
            while not fleet.meet(3, start):
                assert time.monotonic() < patience_until_s, "they do not hear each other"
        sent, heard = fleet.stop(3)
        assert {message.start for message in sent} == {0, 1}
        assert {(message.robot, message.by) for message in heard if message.by_start == 1} == {
            (0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1),
        }  # fmt: skip
        assert all(message.at_s >= message.sent_s for message in heard)
        # Each only once.
        assert len(set(heard)) == len(heard)


def test_a_program_that_has_ended_by_itself_is_no_result() -> None:
    with MiddlewareFleet([LOOPBACK] * 2) as fleet:
        fleet.start("zenoh", 2, 0)
        patience_until_s = time.monotonic() + PATIENCE_S
        while not fleet.meet(2, 0):
            assert time.monotonic() < patience_until_s
        first = min(_robots_of(os.getpid()))
        [program] = _robots_of(first)
        os.kill(program, signal.SIGKILL)
        with pytest.raises(OSError, match="robot: its program ended unexpectedly, with status 9"):
            fleet.stop(2)


def _robots_of(parent: int) -> list[int]:
    """Child processes of `parent`."""
    told = [path.read_text() for path in Path(f"/proc/{parent}/task").glob("*/children")]
    children = [int(child) for children in told for child in children.split()]
    return [
        child
        for child in children
        if b"lpac.middleware.robot" in Path(f"/proc/{child}/cmdline").read_bytes()
    ]


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Both experiments, with two robots and zenoh."""
    out = tmp_path_factory.mktemp("network")
    result = lpac(
        "bench", "network", "--middleware", "zenoh", "-n", 2, "--repetitions", 1, "--seconds", 1,
        "--out", out, "--json",
    )  # fmt: skip
    assert result.returncode == 0, (result.stdout, result.stderr)
    return out, json.loads(result.stdout)


def test_it_tells_what_it_measured_and_where(measured: tuple[Path, dict[str, Any]]) -> None:
    out, told = measured
    assert json.loads((out / "network.json").read_text()) == told
    where = told["measured_on"]
    assert where["where"] == "loopback" and where["namespaces"] is None
    assert where["versions"] == {"zenoh": MIDDLEWARES["zenoh"].version()}
    kinds = [(run["experiment"], run["middleware"], run["robots"]) for run in told["runs"]]
    assert kinds == [
        ("restarts", "zenoh", 2), ("restarts", NOTHING, 2), ("robots", "zenoh", 1),
        ("robots", NOTHING, 1), ("robots", "zenoh", 2), ("robots", NOTHING, 2),
    ]  # fmt: skip
    for run in told["runs"]:
        assert set(MEASURES) < set(run)
        assert run["throughput_mbit_s"] > 0.0 and run["seconds"] >= 1.0
        assert 0.0 <= run["processor"] <= 1.0
        assert run["met"]
        if run["middleware"] == NOTHING:
            assert run["delivered"] is None and run["never_heard"] is None
    restarted, together = told["runs"][0], told["runs"][4]
    assert 0.0 <= restarted["never_heard"] <= 1.0
    assert together["never_heard"] is None
    assert 0.0 < together["delivered"] <= 1.0
    assert 0.0 <= together["age_p50_ms"] <= together["age_p99_ms"]
    assert [summary["throughput_mbit_s"]["runs"] for summary in told["summaries"]] == [1] * 6


def test_it_draws_what_it_measured(measured: tuple[Path, dict[str, Any]]) -> None:
    out, _ = measured
    for name in ("restarts", "robots"):
        assert (out / f"{name}.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.skipif(
    MIDDLEWARES["cyclonedds"].version() is None, reason="Cyclone DDS is not installed"
)
def test_for_people_it_is_a_table_that_says_where(tmp_path: Path) -> None:
    result = lpac(
        "bench", "network", "restarts", "-n", 2, "--repetitions", 1, "--seconds", 1, "--out",
        tmp_path,
    )  # fmt: skip
    assert result.returncode == 0, (result.stdout, result.stderr)
    rows = [line.split("  ")[0] for line in result.stdout.splitlines()]
    assert {"zenoh", "Cyclone DDS", "nothing"} <= set(rows)
    assert "loopback, which has no radio" in result.stdout


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["flights"], "flights: an experiment is one of restarts, robots"),
        (["--middleware", "ros"], "--middleware ros: must be one of zenoh, cyclonedds"),
        (["restarts", "-n", 1], "--robots 1: restarts needs at least 2"),
        (["--repetitions", 0], "--repetitions = 0: must be at least 1"),
        (["--seconds", 0.5], "--seconds = 0.5: must be at least 1"),
        (
            ["--namespaces", "a,b"],
            "--namespaces: 2 given, and 10 robots need one each: name more, or measure fewer",
        ),
        (["-n", 2, "--namespaces", "a,a"], "--namespaces: one is given twice"),
        (["-n", 2, "--namespaces", "no-such-1,no-such-2"], "--namespaces: "),
    ],
)
def test_what_cannot_be_is_one_line(arguments: list[Any], told: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    alone = [] if "--middleware" in arguments else ["--middleware", "zenoh"]
    result = called("bench", "network", *arguments, *alone, "--out", out)
    assert error_line(result).startswith(f"lpac: {told}")
    assert not out.exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_however_it_ends_its_programs_end(number: signal.Signals, tmp_path: Path) -> None:
    name, value = "LPAC_TEST", str(uuid.uuid4())
    mark = f"{name}={value}"
    command = [sys.executable, "-m", "lpac.cli.main", "bench", "network", "robots", "-n", "2"]
    options = ["--middleware", "zenoh", "--seconds", "1", "--repetitions", "1000"]
    with subprocess.Popen(
        [*command, *options, "--out", str(tmp_path)], stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE, process_group=0, text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT), name: value},
    ) as ended:  # fmt: skip
        # During a run, after some results.
        while not (tmp_path / "network.json").exists():
            assert ended.poll() is None
            time.sleep(0.02)
        assert sum(1 for _ in _processes(mark)) > 1
        os.killpg(ended.pid, number)
        _, said = ended.communicate()
    if number == signal.SIGINT:
        assert ended.returncode == 130 and said.strip() == "lpac: interrupted"
    assert json.loads((tmp_path / "network.json").read_text())["runs"]
    patience_until_s = time.monotonic() + PATIENCE_S
    while left := list(_processes(mark)):
        assert time.monotonic() < patience_until_s, f"still there: {left}"
        time.sleep(0.05)


def _processes(mark: str) -> Iterator[int]:
    """Processes whose environment has the mark."""
    for path in Path("/proc").glob("[0-9]*/environ"):
        try:
            if mark.encode() in path.read_bytes().split(b"\0"):
                yield int(path.parent.name)
        except (OSError, ValueError):
            continue
