"""Evaluation of runs."""

from importlib.metadata import PackageNotFoundError
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from lpac.cli.main import app
from lpac.extras import install_command
from lpac.middleware.figures import of_restarts, over_robots
from lpac.middleware.kinds import MIDDLEWARES, NOTHING
from lpac.middleware.measure import Plan
from lpac.middleware.results import (
    CountedTime,
    Experiment,
    Reception,
    Run,
    Sent,
    as_json,
    left_out,
    of_traffic,
    summaries,
    traffic,
)


def test_what_was_said_in_the_window_counts_and_once_for_each_other_robot() -> None:
    sent = [Sent(robot, 1, sequence, 10.0 + sequence) for robot in range(3) for sequence in (0, 4)]
    heard = [
        Reception(by=1, by_start=1, robot=0, start=1, sequence=0, sent_s=10.0, at_s=10.2),
        # Sent in the window, received after it.
        Reception(by=2, by_start=1, robot=0, start=1, sequence=0, sent_s=10.0, at_s=13.0),
        Reception(by=1, by_start=1, robot=0, start=1, sequence=4, sent_s=14.0, at_s=14.1),
    ]
    told = traffic(sent, heard, [CountedTime(1, 10.0, 12.0)], robots=3)
    assert told.delivered == pytest.approx(2 / 6)
    assert told.ages_s == pytest.approx((0.2, 3.0))
    assert [time_s for time_s in told.heard_s if time_s is not None] == pytest.approx([0.2, 3.0])
    assert len(told.heard_s) == 6


def test_what_a_program_of_before_the_restart_heard_does_not_count() -> None:
    sent = [Sent(0, 1, 0, 10.0)]
    heard = [
        Reception(by=1, by_start=0, robot=0, start=1, sequence=0, sent_s=10.0, at_s=10.1),
        Reception(by=1, by_start=1, robot=0, start=0, sequence=9, sent_s=9.9, at_s=10.1),
    ]
    told = traffic(sent, heard, [CountedTime(1, 10.0, 12.0)], robots=2)
    assert told.delivered == 0.0 and told.heard_s == (None, None)
    assert of_traffic(told, restarted=True) == {"delivered": 0.0, "never_heard": 1.0}


def test_each_restart_has_a_window_of_its_own() -> None:
    heard = [
        Reception(by=1, by_start=start, robot=0, start=start, sequence=0, sent_s=at_s, at_s=at_s)
        for start, at_s in ((1, 10.5), (2, 21.0))
    ]
    windows = [CountedTime(1, 10.0, 15.0), CountedTime(2, 20.0, 25.0)]
    told = traffic([Sent(0, 1, 0, 10.5), Sent(0, 2, 0, 21.0)], heard, windows, robots=2)
    assert told.delivered == 1.0
    fields = of_traffic(told, restarted=True)
    assert fields["heard_again_p50_s"] == pytest.approx(0.75)
    assert fields["heard_again_max_s"] == pytest.approx(1.0)
    # The other robot sent nothing.
    assert fields["never_heard"] == 0.5


def test_a_robot_alone_tells_nothing_of_messages() -> None:
    told = traffic([Sent(0, 0, 0, 1.0)], [], [CountedTime(0, 0.0, 2.0)], robots=1)
    assert of_traffic(told, restarted=False) == {"delivered": None}


def _run(
    middleware: str,
    throughput: float,
    robots: int = 3,
    experiment: Experiment = "restarts",
    *,
    met: bool = True,
) -> Run:
    return Run(
        experiment=experiment, middleware=middleware, robots=robots, repetition=1, began=0.0,
        seconds=10.0, throughput_mbit_s=throughput, processor=0.5, met=met,
        delivered=None if middleware == NOTHING else 0.9,
        age_p50_ms=None if middleware == NOTHING else 9.0,
    )  # fmt: skip


def test_a_summary_has_the_mean_and_the_deviation_of_what_was_measured() -> None:
    runs = [_run("zenoh", 70.0), _run(NOTHING, 80.0), _run("zenoh", 74.0)]
    zenoh, nothing = summaries(runs)
    assert zenoh.measures["throughput_mbit_s"] == pytest.approx((72.0, 8.0**0.5, 2))
    assert nothing.measures["throughput_mbit_s"] == (80.0, None, 1)
    assert "delivered" not in nothing.measures
    told = as_json({"where": "loopback"}, runs)
    assert told["summaries"][0]["throughput_mbit_s"]["mean"] == 72.0
    assert [run["throughput_mbit_s"] for run in told["runs"]] == [70.0, 80.0, 74.0]


def test_runs_whose_robots_had_not_met_are_left_out_and_counted() -> None:
    met = [_run("zenoh", 70.0), _run(NOTHING, 80.0)]
    runs = [*met, _run("zenoh", 20.0, met=False), _run("cyclonedds", 30.0, met=False)]
    assert summaries(runs) == summaries(met)
    told = "left out: 2 of 4 runs that began before all robots had heard each other"
    assert (left_out(met), left_out(runs)) == ("", told)
    assert [run["met"] for run in as_json({}, runs)["runs"]] == [True, True, False, False]
    figure = of_restarts(runs)
    dots = [line.get_xydata() for line in figure.axes[0].lines if line.get_marker() == "o"]
    assert [np.asarray(dot)[:, 1].tolist() for dot in dots] == [[70.0], [80.0]]
    assert figure.get_supxlabel() == told


def test_middlewares_take_turns() -> None:
    plan = Plan(
        experiment="robots", middlewares=("zenoh", NOTHING), robots=(1, 2), repetitions=2,
        seconds=1.0,
    )  # fmt: skip
    assert list(plan.runs())[:5] == [
        (1, 1, "zenoh"), (1, 1, NOTHING), (1, 2, "zenoh"), (1, 2, NOTHING), (2, 1, "zenoh"),
    ]  # fmt: skip
    # A single robot has a stream, too.
    assert plan.places == 2


def test_figures_have_a_panel_for_each_measure() -> None:
    values = count(70)
    runs = [_run(name, next(values)) for name in (*MIDDLEWARES, NOTHING) for _ in range(2)]
    assert len(of_restarts(runs).axes) == 3
    curves = [_run(name, next(values), n, "robots") for name in ("zenoh", NOTHING) for n in (1, 2)]
    throughput, _ = over_robots(curves).axes
    assert throughput.get_legend_handles_labels()[1] == ["zenoh", NOTHING]


@pytest.fixture
def without_cyclone(monkeypatch: pytest.MonkeyPatch) -> None:
    def version(package: str) -> str:
        if package == "cyclonedds":
            raise PackageNotFoundError(package)
        return "1.0"

    monkeypatch.setattr("lpac.middleware.kinds.version", version)


@pytest.mark.usefixtures("without_cyclone")
def test_a_middleware_that_is_not_installed_is_named_with_what_to_do(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["bench", "network", "--out", str(tmp_path / "out")])
    assert isinstance(result.exception, ValueError)
    told = str(result.exception)
    assert told.startswith(f"Cyclone DDS is not installed here: `{install_command('bench')}`")
    assert told.endswith("--middleware zenoh")
    assert not (tmp_path / "out").exists()
