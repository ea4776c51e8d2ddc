"""Flights of faults in real time, each with a fleet of its own: some beside each other."""

import os
import shutil
import signal
from collections.abc import Generator, Sequence
from pathlib import Path

from edge.core.logger import show
from lpac.analysis.truth import TRUTH, write_truth
from lpac.sim.cores import over_processes
from lpac.sim.drill.campaign import LATE_S, FlightOutcome, FlightTask, outcome_of
from lpac.sim.drill.faults import FAULTS, Fault
from lpac.sim.drill.field import DrilledRobots, has_remote_control, scenario_of, settings_of
from lpac.sim.drill.figure import write_figure
from lpac.sim.drill.processes import process_field
from lpac.sim.drill.truth import FlightTruth, tracks_of
from lpac.sim.fleet.ground import GroundProgram
from lpac.sim.fleet.processes import Fleet
from lpac.sim.sitl.build import require_build

# A robot with its vehicle and its part of a ground takes 0.12 of a core, averaged over a flight.
_CORES_EACH = 0.16
# What a late machine broke says nothing, and is flown again.
_TRIES = 3


class RealTimeDrill:
    """Flies faults with processes on simulated vehicles, or on real PX4s.

    Each flight leaves its logs, and a figure, in a folder of `folder`.
    """

    def __init__(self, folder: Path, drilled: DrilledRobots, px4_build: Path | None = None) -> None:
        """With `px4_build` on real PX4s of that build. Raises ValueError if it is none."""
        if px4_build is not None:
            px4_build = require_build(px4_build)
        self._folder, self._drilled, self._px4_build = folder, drilled, px4_build

    def outcome(self, fault: Fault, seed: int) -> FlightOutcome:
        """Fly and judge; again if it broke a promise while this machine was late.

        What that flight left stays beside it, in a folder whose name ends in late-1, and so on.
        """
        folder = self._folder / f"{fault.name}-{seed}"
        for number in range(1, _TRIES + 1):
            outcome = outcome_of(fault, seed, lambda: self._fly(fault, seed, folder))
            if outcome.held or outcome.late_s <= LATE_S:
                break
            late = folder.with_name(f"{folder.name}-late-{number}")
            shutil.rmtree(late, ignore_errors=True)
            if folder.exists():
                shutil.copytree(folder, late)
        return outcome

    def fly_all(self, tasks: Sequence[FlightTask]) -> Generator[FlightOutcome, None, None]:
        """All of them, as many at once as this machine carries; outcomes as they come."""
        at_once = 1
        # PX4's ports are the same for all fleets.
        if self._px4_build is None:
            at_once = int(len(os.sched_getaffinity(0)) / (_CORES_EACH * self._drilled.robots))
        return over_processes(self.fly_task, tasks, max(1, at_once))

    def fly_task(self, task: FlightTask) -> FlightOutcome:
        """One flight, in whatever process this is."""
        show("error")
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        try:
            return self.outcome(FAULTS[task.fault], task.seed)
        except KeyboardInterrupt:
            # Its programs have ended. A worker of a pool would go on with the next flight.
            os._exit(1)

    def _fly(self, fault: Fault, seed: int, folder: Path) -> FlightTruth:
        shutil.rmtree(folder, ignore_errors=True)
        fleet = Fleet(
            scenario_of(fault, seed, self._drilled), folder, Path(self._drilled.bundle),
            px4_build=self._px4_build, settings=settings_of(fault),
        )  # fmt: skip
        with (
            fleet,
            GroundProgram(fleet.fleet_toml, fleet.name) as ground,
            process_field(fleet, ground) as field,
        ):
            if has_remote_control(fault):
                with field.stepped:
                    for vehicle in field.vehicles:
                        vehicle.rc_connected = True
            timeline = field.fly(fault, seed)
        truth = field.truth(timeline)
        write_figure(fault, truth, folder)
        write_truth(tracks_of(truth), folder / TRUTH)
        return truth
