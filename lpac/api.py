"""The Python API: what a script or a notebook of yours needs, under stable names.

    from pathlib import Path
    import matplotlib.pyplot as plt
    from lpac.api import (SHIPPED_BUNDLE, Method, Scenario, Study, draw_costs, draw_snapshot,
                          examine, fly, load_bundle, log_arrays, run)

    bundle = load_bundle(SHIPPED_BUNDLE)

    def watch(moment):                              # each 0.2 s of the flight
        if moment.time_s > 30.0 and not moment.received.any():
            moment.stop()

    flight = fly(Scenario(robots=10, seed=7, duration_s=60.0), bundle, watch)
    flight.positions_m                              # (T, N, 2), mission frame, m
    lloyd = fly(Scenario(robots=10, seed=7, controller="clairvoyant-cvt"), bundle)

    figure, (left, right) = plt.subplots(1, 2, layout="constrained")
    draw_snapshot(left, flight, time_s=10.0)
    draw_costs(right, {"this policy": flight, "Lloyd": lloyd})

    study = Study(methods=(Method.of("field", SHIPPED_BUNDLE), Method.of("decentralized-cvt")))
    [[field, *baselines]] = run(study).values()     # over 20 worlds
    field.final                                     # (trainings, worlds): J at the end / J(0)

    control = log_arrays("out/flight/robots")["robot-3"]["control"]
    control.time_s, control["position_m"]           # (T,), (T, 3): as that robot wrote it
    [record] = examine([Path("out/flight")]).records  # all robots, on one clock

docs/api.md shows each task, one robot's steps by hand too. Names are those of the modules that they
come from, whose docstrings say more. They change only with a new minor version, and CHANGELOG.md
says how. What is neither in `__all__` nor on the page "Interfaces" of the documentation may change
at any time. Constants: `SHIPPED_BUNDLE` is the path of the policy that flies if no other is named,
`FIELD_SCALE` the `ModelScale` of the paper's field tests, `BASELINES` the names of all baselines,
`SET_UPS` sizes of worlds and teams, by name, `VERDICT_RULE` by what a method is called better, in
words. What is wrong raises ValueError (`BundleError` is
one), in one line that says what to do, or OSError for a file that is not there or cannot be used.

Nothing is imported before it is used: matplotlib with what draws, the simulated whole robots with
engine "simulated". The extra `sim` has all that is needed; torch never is.
"""

# ruff: noqa: PLC0414 (so that who checks types sees that these names are handed on)

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from edge.core.frames import ModelScale as ModelScale
    from edge.core.ports import Odometry as Odometry
    from edge.core.world import GaussianFeature as GaussianFeature
    from edge.core.world import PolygonFeature as PolygonFeature
    from edge.core.world import parse_world as parse_world
    from edge.core.world import rasterize as rasterize
    from edge.drivers.registry import load_policy as load_policy
    from edge.drivers.world_sensor import WorldSensor as WorldSensor
    from edge.policy.bundle import Bundle as Bundle
    from edge.policy.bundle import BundleError as BundleError
    from edge.policy.bundle import load_bundle as load_bundle
    from edge.policy.family import Agent as Agent
    from edge.policy.family import Neighbourhood as Neighbourhood
    from edge.policy.family import Observation as Observation
    from edge.policy.family import Policy as Policy
    from edge.robot.pac import Pac as Pac
    from edge.robot.pac import PacParameters as PacParameters
    from edge.robot.pac import PolicyTick as PolicyTick
    from lpac.analysis.arrays import Columns as Columns
    from lpac.analysis.arrays import log_arrays as log_arrays
    from lpac.analysis.coverage import Coverage as Coverage
    from lpac.analysis.examination import Examined as Examined
    from lpac.analysis.examination import Wanted as Wanted
    from lpac.analysis.examination import examine as examine
    from lpac.analysis.figures import draw_costs as draw_costs
    from lpac.analysis.figures import draw_heights as draw_heights
    from lpac.analysis.figures import draw_snapshot as draw_snapshot
    from lpac.analysis.figures import draw_states as draw_states
    from lpac.analysis.figures import overview as overview
    from lpac.analysis.figures import snapshots as snapshots
    from lpac.analysis.figures import snapshots_and_costs as snapshots_and_costs
    from lpac.analysis.flight import FlightRecord as FlightRecord
    from lpac.analysis.flight import RobotRecord as RobotRecord
    from lpac.analysis.statistics import VERDICT_RULE as VERDICT_RULE
    from lpac.analysis.statistics import what_would_tell as what_would_tell
    from lpac.analysis.worlds import random_features as random_features
    from lpac.shipped import SHIPPED_BUNDLE as SHIPPED_BUNDLE
    from lpac.sim.batch import fly_batch as fly_batch
    from lpac.sim.cores import in_this_process as in_this_process
    from lpac.sim.cores import over_cores as over_cores
    from lpac.sim.description import FIELD_SCALE as FIELD_SCALE
    from lpac.sim.engines import fly as fly
    from lpac.sim.failure import Failure as Failure
    from lpac.sim.failure import LostRobots as LostRobots
    from lpac.sim.fleet.flight import FleetMoment as FleetMoment
    from lpac.sim.points import FlightMoment as FlightMoment
    from lpac.sim.scenario import Scenario as Scenario
    from lpac.sim.ticks import Clocks as Clocks
    from lpac.sim.vehicles import PointVehicles as PointVehicles
    from lpac.sim.vehicles import VehicleOdometry as VehicleOdometry
    from lpac.study.figures import cost_curves as cost_curves
    from lpac.study.figures import distributions as distributions
    from lpac.study.file import read_study as read_study
    from lpac.study.results import MethodResult as MethodResult
    from lpac.study.results import verdict_of as verdict_of
    from lpac.study.run import run as run
    from lpac.study.study import BASELINES as BASELINES
    from lpac.study.study import Condition as Condition
    from lpac.study.study import Method as Method
    from lpac.study.study import Study as Study
    from lpac.study.worlds import SET_UPS as SET_UPS
    from lpac.study.worlds import draw_world as draw_world

# Each module, and what is taken from it: the imports above, when they are needed.
_TAKEN = {
    "edge.core.frames": "ModelScale",
    "edge.core.ports": "Odometry",
    "edge.core.world": "GaussianFeature PolygonFeature parse_world rasterize",
    "edge.drivers.registry": "load_policy",
    "edge.drivers.world_sensor": "WorldSensor",
    "edge.policy.bundle": "Bundle BundleError load_bundle",
    "edge.policy.family": "Agent Neighbourhood Observation Policy",
    "edge.robot.pac": "Pac PacParameters PolicyTick",
    "lpac.analysis.arrays": "Columns log_arrays",
    "lpac.analysis.coverage": "Coverage",
    "lpac.analysis.figures": (
        "draw_costs draw_heights draw_snapshot draw_states overview snapshots snapshots_and_costs"
    ),
    "lpac.analysis.flight": "FlightRecord RobotRecord",
    "lpac.analysis.examination": "Examined Wanted examine",
    "lpac.analysis.statistics": "VERDICT_RULE what_would_tell",
    "lpac.analysis.worlds": "random_features",
    "lpac.shipped": "SHIPPED_BUNDLE",
    "lpac.sim.batch": "fly_batch",
    "lpac.sim.cores": "in_this_process over_cores",
    "lpac.sim.description": "FIELD_SCALE",
    "lpac.sim.engines": "fly",
    "lpac.sim.failure": "Failure LostRobots",
    "lpac.sim.points": "FlightMoment",
    "lpac.sim.fleet.flight": "FleetMoment",
    "lpac.sim.scenario": "Scenario",
    "lpac.sim.ticks": "Clocks",
    "lpac.sim.vehicles": "PointVehicles VehicleOdometry",
    "lpac.study.file": "read_study",
    "lpac.study.figures": "cost_curves distributions",
    "lpac.study.results": "MethodResult verdict_of",
    "lpac.study.run": "run",
    "lpac.study.study": "BASELINES Condition Method Study",
    "lpac.study.worlds": "SET_UPS draw_world",
}
_MODULE_OF = {name: module for module, names in _TAKEN.items() for name in names.split()}
__all__ = sorted(_MODULE_OF)  # noqa: PLE0605


def __getattr__(name: str) -> object:
    """Called for names that are not here yet."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_MODULE_OF[name]), name)
    return value


def __dir__() -> list[str]:
    return __all__
