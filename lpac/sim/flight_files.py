"""Simulated flights as figures and files."""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from lpac.analysis.figures import overview, snapshots_and_costs
from lpac.analysis.flight import FlightRecord
from lpac.analysis.style import save
from lpac.analysis.worlds import format_world
from lpac.sim.flight_summary import summary
from lpac.sim.scenario import Scenario


def write_flight(scenario: Scenario, record: FlightRecord, folder: Path) -> None:
    """Write flight.json and flight.png / flight.pdf; of points also flight.npz and world.env."""
    _write_json(summary(scenario, record), folder / "flight.json")
    if record.script.vehicle:
        save(overview(record), folder / "flight")
        return
    assert record.coverage is not None
    (folder / "world.env").write_text(format_world(record.features))
    np.savez(
        folder / "flight.npz",
        time_s=record.time_s,
        positions_m=record.positions_m,
        cost_time_s=record.curve_time_s,
        cost=record.cost,
        importance=record.coverage.importance,
    )
    save(snapshots_and_costs({scenario.controller: record}), folder / "flight")


def write_demo(flights: Mapping[str, tuple[Scenario, FlightRecord]], folder: Path) -> None:
    """Write demo.json and the figure demo.png / demo.pdf: the first flight next to the others."""
    _write_json({name: summary(*flight) for name, flight in flights.items()}, folder / "demo.json")
    save(snapshots_and_costs({name: of for name, (_, of) in flights.items()}), folder / "demo")


def _write_json(value: object, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value, indent=2) + "\n")
