"""Simulated flights as figures and files."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from edge.core.world import format_world
from lpac.analysis.figures import overview, snapshots_and_costs
from lpac.analysis.style import save
from lpac.sim.experiment import SimulatedFlight

if TYPE_CHECKING:
    from lpac.sim.fleet.flight import FleetFlight


def write_flight(flight: SimulatedFlight, folder: Path) -> None:
    """Write flight.json, flight.npz, world.env and flight.png / flight.pdf into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "flight.json").write_text(json.dumps(flight.summary(), indent=2) + "\n")
    (folder / "world.env").write_text(format_world(flight.features))
    np.savez(
        folder / "flight.npz",
        time_s=flight.time_s,
        positions_m=flight.positions_m,
        cost_time_s=flight.cost_time_s,
        cost=flight.cost,
        importance=flight.importance,
    )
    save(snapshots_and_costs({flight.scenario.controller: flight.record}), folder / "flight")


def write_demo(flights: Mapping[str, SimulatedFlight], folder: Path) -> None:
    """Write demo.json and the figure demo.png / demo.pdf: the first flight beside the others."""
    folder.mkdir(parents=True, exist_ok=True)
    summaries = {name: flight.summary() for name, flight in flights.items()}
    (folder / "demo.json").write_text(json.dumps(summaries, indent=2) + "\n")
    records = {name: flight.record for name, flight in flights.items()}
    save(snapshots_and_costs(records), folder / "demo")


def write_fleet_flight(flight: "FleetFlight", folder: Path) -> None:
    """Write flight.json and flight.png / flight.pdf into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "flight.json").write_text(json.dumps(flight.summary(), indent=2) + "\n")
    save(overview(flight.record), folder / "flight")
