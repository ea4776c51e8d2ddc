"""What is said of how many robots a machine carries."""

from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from lpac.analysis.flight import ScriptRecord
from lpac.cli import sim as cli
from lpac.cli.programs import choose_robot_count, report_capacity
from lpac.sim.fleet import load
from lpac.sim.fleet.processes import Backlog, OverloadError
from lpac.sim.scenario import Scenario
from tests.conftest import SHIPPED

# Units of work a second, measured: two cores of a small cloud machine, which flew ten robots with
# 0.9 cores; and half of that, on which ten fell 88 s behind and five flew well.
TEN_FLEW, FIVE_FLEW = 62.0, 31.0


@pytest.mark.parametrize(("units_per_s", "robots"), [(TEN_FLEW, 10), (FIVE_FLEW, 5), (1.0, 1)])
def test_as_many_robots_fly_as_the_machine_carries(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    units_per_s: float,
    robots: int,
) -> None:
    monkeypatch.setattr(load, "_units_per_s", lambda _: units_per_s)
    assert choose_robot_count(SHIPPED, "mavlink") == robots
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith(f": flying {robots}")


@pytest.mark.parametrize(
    ("options", "robots"),
    [
        (("--vehicle", "mavlink"), 5),
        (("--vehicle", "mavlink", "--no-script"), 5),
        (("--vehicle", "mavlink", "--robots", "auto"), 5),
        (("--vehicle", "px4", "--px4", "build"), 2),
        (("--vehicle", "mavlink", "-n", "7"), 7),
        (("--vehicle", "simulated"), 10),
    ],
)
def test_programs_fly_as_many_as_the_machine_carries_unless_it_is_said_how_many(
    monkeypatch: pytest.MonkeyPatch, options: tuple[str, ...], robots: int
) -> None:
    flown: list[int] = []

    def fly(scenario: Scenario, *_: object) -> SimpleNamespace:
        flown.append(scenario.robots)
        return SimpleNamespace(script=ScriptRecord())

    monkeypatch.setattr(load, "_units_per_s", lambda _: FIVE_FLEW)
    monkeypatch.setattr(cli, "_show", lambda *_: None)
    for name in ("_fly_on_clock", "_fly_programs", "_serve"):
        monkeypatch.setattr(cli, name, fly)
    result = CliRunner().invoke(cli.app, options)
    assert (result.exit_code, flown) == (0, [robots]), result.output


def test_who_asks_for_more_is_warned(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(load, "_units_per_s", lambda _: FIVE_FLEW)
    assert report_capacity(5, SHIPPED, "mavlink") == 5
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith("carries about 5 of these robots and vehicles")
    assert report_capacity(6, SHIPPED, "mavlink") == 5
    (line,) = capsys.readouterr().err.splitlines()
    assert (
        "carries about 5 of these robots" in line
        and "not 6" in line
        and line.endswith("fewer: -n 5")
    )


@pytest.mark.parametrize(
    ("robots", "carried", "advice"), [(10, None, 5), (10, 7, 7), (10, 12, 9), (3, 0, 1)]
)
def test_who_falls_behind_is_told_what_was_found_out(
    robots: int, carried: int | None, advice: int
) -> None:
    error = OverloadError(Backlog(9.0, 0.0), robots, carried)
    assert str(error).endswith(f"fly fewer: -n {advice}")
