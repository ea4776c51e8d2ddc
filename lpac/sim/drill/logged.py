"""Flights of faults that leave their logs and a figure: in real time, or on the simulated clock."""

import shutil
from pathlib import Path

from lpac.analysis.truth import TRUTH, write_truth
from lpac.sim.drill.faults import Fault
from lpac.sim.drill.field import has_remote_control, settings_of
from lpac.sim.drill.figure import write_figure
from lpac.sim.drill.outcome import LATE_S, FlightOutcome, outcome_of
from lpac.sim.drill.processes import process_field
from lpac.sim.drill.simulated import SimulatedDrill
from lpac.sim.drill.truth import FlightTruth, tracks_of
from lpac.sim.fleet.ground import GroundProgram
from lpac.sim.fleet.processes import Fleet
from lpac.sim.scenario import Scenario

# What a late machine broke says nothing, and is flown again.
_TRIES = 3


def fly_logged(
    fault: Fault,
    scenario: Scenario,
    bundle: Path,
    folder: Path,
    px4_build: Path | None = None,
    *,
    in_real_time: bool,
) -> FlightOutcome:
    """Fly and judge; again if it broke a promise while this machine was late.

    What that flight left stays beside `folder`, in one whose name ends in late-1, and so on.
    """

    def flown() -> FlightTruth:
        shutil.rmtree(folder, ignore_errors=True)
        if in_real_time:
            truth = _fly_programs(fault, scenario, bundle, folder, px4_build)
        else:
            folder.mkdir(parents=True)
            truth = SimulatedDrill(bundle).fly(fault, scenario, logs=folder)
        write_figure(fault, truth, folder)
        write_truth(tracks_of(truth), folder / TRUTH)
        return truth

    for number in range(1, _TRIES + 1):
        outcome = outcome_of(fault, flown)
        if outcome.held or outcome.late_s <= LATE_S:
            break
        late = folder.with_name(f"{folder.name}-late-{number}")
        shutil.rmtree(late, ignore_errors=True)
        if folder.exists():
            shutil.copytree(folder, late)
    return outcome


def _fly_programs(
    fault: Fault, scenario: Scenario, bundle: Path, folder: Path, px4_build: Path | None
) -> FlightTruth:
    """With processes on simulated vehicles, or on real PX4s of a build."""
    fleet = Fleet(scenario, folder, bundle, px4_build=px4_build, settings=settings_of(fault))
    with (
        fleet,
        GroundProgram(fleet.fleet_toml, fleet.name) as ground,
        process_field(fleet, ground) as field,
    ):
        if has_remote_control(fault):
            with field.stepped:
                for vehicle in field.vehicles:
                    vehicle.rc_connected = True
        timeline = field.fly(fault, scenario)
    return field.truth(timeline)
