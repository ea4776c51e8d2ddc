"""Drills: their flights, stored outcomes, and reports."""

import itertools
from collections.abc import Generator, Sequence
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest

from edge.core.schema import ConfigError
from lpac.sim.cores import Outcome, in_this_process
from lpac.sim.drill.bounds import Figure
from lpac.sim.drill.faults import FAULTS
from lpac.sim.drill.outcome import FlightOutcome
from lpac.sim.engines import flies
from lpac.study.drill_report import as_junit, report_of
from lpac.study.drills import Drill, outcomes_of, read_drill
from lpac.study.flights import FlightGroup, KeptFlights, PlannedFlight
from tests.conftest import ROOT, SHIPPED

BROKEN = Figure("lands", float("inf"), 3.3, "s")
HELD = Figure("lands", 2.4, 3.3, "s")


def outcome_of(flight: PlannedFlight) -> FlightOutcome:
    """Outcome determined by the flight's seed."""
    return {
        0: FlightOutcome((HELD,)),
        1: FlightOutcome((BROKEN,)),
        2: FlightOutcome((), "not judged", 0.5),
    }[flight.scenario.seed]


def test_without_names_all_faults_of_the_engine_are_flown() -> None:
    for engine in ("simulated", "mavlink"):
        flown = {flight.scenario.fault for flight in Drill(engine=engine).flights()}
        assert flown == {name for name, fault in FAULTS.items() if flies(engine, fault)}
    assert len(Drill(engine="mavlink").flights()) < len(Drill().flights()) == len(FAULTS)


def test_flights_that_share_their_begin_are_beside_each_other() -> None:
    """So that a process computes the common start once."""
    flights = Drill(seeds=2).flights()
    begins = [(flight.scenario, FAULTS[flight.scenario.fault].settings) for flight in flights]
    changes = sum(a != b for a, b in itertools.pairwise(begins))
    assert changes == len(dict.fromkeys(begins)) - 1
    assert len({flight.key for flight in flights}) == 2 * len(FAULTS)


def test_what_was_judged_is_kept_and_the_rest_flown_again(tmp_path: Path) -> None:
    flights = Drill(faults=("held",), seeds=3, robots=2).flights()
    flown: list[int] = []

    def do(group: FlightGroup) -> list[tuple[PlannedFlight, FlightOutcome]]:
        flown.extend(flight.scenario.seed for flight in group)
        return [(flight, outcome_of(flight)) for flight in group]

    for _ in range(2):
        kept = KeptFlights(tmp_path, FlightOutcome, lambda outcome: not outcome.error)
        told = dict(kept.fly(do, flights, in_this_process))
        assert told == {flight: outcome_of(flight) for flight in flights}
    assert flown == [0, 1, 2, 2]


def test_another_bundle_is_not_taken_for_it() -> None:
    [flight] = Drill(faults=("held",)).flights()
    with pytest.raises(ValueError, match="differs from the planned bundle"):
        outcomes_of((replace(flight, flown_by="0" * 64),))


def test_flights_in_real_time_have_a_pool_of_their_own(tmp_path: Path) -> None:
    flights = Drill(faults=("held",), seeds=2, engine="mavlink").flights()

    def refuse(do: object, tasks: Sequence[object]) -> Generator[Outcome, None, None]:
        raise AssertionError(f"{tasks} were flown")
        yield

    def do(group: FlightGroup) -> list[tuple[PlannedFlight, FlightOutcome]]:
        return [(flight, outcome_of(flight)) for flight in group]

    kept = KeptFlights(tmp_path, FlightOutcome)
    assert len(dict(kept.fly(do, flights, refuse, in_this_process))) == 2


def test_a_report_says_what_broke_and_how_it_is_flown_again(tmp_path: Path) -> None:
    flights = Drill(faults=("held",), seeds=2, robots=3).flights()
    outcomes = {flight: outcome_of(flight) for flight in flights}
    report = report_of(outcomes, {"command": "lpac drill"})
    told = report.write(tmp_path)
    [fault], [broken] = told["faults"], told["broken"]
    assert (fault["fault"], fault["flights"], fault["broken"]) == ("held", 2, 1)
    assert fault["worst"] == [{**BROKEN._asdict(), "value": None}]
    again = "lpac drill --fault held --seed 1 -n 3"
    assert (broken["seed"], broken["error"], broken["again"]) == (1, "", again)
    assert again in (tmp_path / "README.md").read_text()
    assert "1 of 2" in (tmp_path / "README.md").read_text()
    assert (tmp_path / "drill.csv").read_text().splitlines()[1:] == [
        "held,0,lands,2.4,3.3,s,False,False", "held,1,lands,inf,3.3,s,False,True",
    ]  # fmt: skip
    suite = ElementTree.fromstring(as_junit(outcomes))
    assert (suite.get("tests"), suite.get("failures")) == ("2", "1")
    assert [case.get("name") for case in suite if len(case)] == ["seed 1"]


def test_a_drill_is_a_file(tmp_path: Path) -> None:
    drill = read_drill(ROOT / "examples" / "drill.toml")
    assert {flight.scenario.fault for flight in drill.flights()} == set(drill.faults)
    file = tmp_path / "mine.toml"
    file.write_text(f'faults = []\nseeds = 3\nbundle = "{SHIPPED}"\n')
    assert len(read_drill(file).flights()) == 3 * len(FAULTS)
    for text, said in (
        ("faults = ['nothing']", "mine.toml: faults: nothing: no such fault"),
        ("faults = []\nrobots = 11", "mine.toml: robots = 11: must be from 2 to 10"),
        ("faults = ['radio-dies']\nengine = 'mavlink'", "radio-dies: mavlink cannot do it"),
        ("faults = []\ntitle = 3", "unknown key 'title': a file with `faults` is a drill, whose"),
    ):
        file.write_text(text)
        with pytest.raises(ConfigError, match=said):
            read_drill(file)
