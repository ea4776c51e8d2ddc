"""The flights of an evaluation; this is the one place where they are flown."""

from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal, NamedTuple, get_args

import numpy as np

import edge
from edge.core.wire import PayloadType
from edge.policy.bundle import Bundle, BundleError, load_bundle
from lpac import analysis, evaluate, radio, sim
from lpac.analysis.coverage import Coverage
from lpac.evaluate.worlds import SET_UPS, WorldSet, draw_world
from lpac.radio.modelled import ModelledRadio
from lpac.sim.baselines import BaselineName
from lpac.sim.batch import PolicyFailedError, fly_batch
from lpac.sim.cores import Pool
from lpac.sim.description import FIELD_SCALE
from lpac.sim.experiment import SimulatedFlight, cost_times_s, draw_position_errors_m, fly, prepare
from lpac.sim.failure import NONE_LOST, LostRobots
from lpac.sim.fleet.clocked import fly_simulated
from lpac.sim.fleet.flight import FleetFlight
from lpac.sim.fleet.flight import fly as fly_fleet
from lpac.sim.fleet.layout import Layout
from lpac.sim.fleet.processes import Fleet
from lpac.sim.kept import KeptOutcomes, code_digest
from lpac.sim.scenario import Scenario
from lpac.sim.ticks import Clocks

BASELINES: tuple[BaselineName, ...] = get_args(BaselineName)
# The best of ten runs of Lloyd's algorithm that knows the world: where robots would end, not a
# flight. A mark for comparison, and no bound.
LLOYD: Literal["best-of-ten-lloyd"] = "best-of-ten-lloyd"
POLICY: Literal["lpac"] = "lpac"
Flier = Literal["lpac", "best-of-ten-lloyd"] | BaselineName
# A point that follows its velocity; the same that begins where whole robots stand, wrong about its
# place as their receivers are; and whole robots, their programs' loops and separation, in wind: on
# simulated vehicles and one simulated clock, as programs in real time on simulated vehicles, and on
# real PX4s.
RobotModel = Literal["point", "point-from-pad", "simulated", "mavlink", "px4"]
WHOLE_ROBOTS: tuple[RobotModel, ...] = ("simulated", "mavlink", "px4")
# These fly one after another, with nothing beside them.
IN_REAL_TIME: tuple[RobotModel, ...] = ("mavlink", "px4")

# Larger batches of the simulator are no faster.
_ROBOTS_TOGETHER = 80
_FLIGHTS = "flights.jsonl"


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationFlight:
    """One flight over one world: all of it follows from this, and from what is in the bundle.

    `bundle` is the path of the one that flies, or gives a baseline the sizes of sensor and local
    map; `flown_by` is its id, or says these sizes. `position_error_m` is the standard deviation,
    along each axis, of each robot's error in knowing its position. Baselines have no whole robots;
    these have moments and errors of their own, send what their policy was judged with, and lose
    messages, or have them late, from the mission's start on, but not in real time. `px4_build` is
    where robots of the kind "px4" have theirs from. The rest is as `Scenario` has it.
    """

    flier: Flier
    bundle: str
    flown_by: str
    world_set: WorldSet
    world: int
    set_up: str
    duration_s: float
    loss: float = 0.0
    lost: LostRobots = NONE_LOST
    delay_s: float = 0.0
    radio: ModelledRadio | None = None
    max_message_age_s: float = 0.8
    max_input_age_s: float = 1.0
    payload: PayloadType = "float16"
    clocks: Clocks = field(default_factory=Clocks)
    lag_s: float = 0.0
    position_error_m: float = 0.0
    robot: RobotModel = "point"
    px4_build: str = ""

    @property
    def key(self) -> str:
        """What tells it from all other flights, wherever the bundle and PX4 lie."""
        return (
            f"{self.flier} {self.flown_by}: {self.world_set} {self.world} {self.set_up}, "
            f"{self.duration_s:g} s, loss {self.loss:g}, lost {self.lost.robots}@{self.lost.at_s:g}"
            f", delay {self.delay_s:g} s, {self.radio}, ages to {self.max_message_age_s:g} s, "
            f"inputs to {self.max_input_age_s:g} s, "
            f"{self.payload}, {self.clocks}, lag {self.lag_s:g} s, "
            f"positions to {self.position_error_m:g} m, {self.robot}"
        )


class FlownCost(NamedTuple):
    """A cost (C,) at times (C,), s.

    That is J, the coverage cost in model units of the robots that are left, or another task's.
    """

    time_s: tuple[float, ...]
    cost: tuple[float, ...]


def task_of(bundle: Bundle) -> str:
    """What policies must have in common to be compared. Raises BundleError without perception."""
    perception, training = bundle.manifest.perception, bundle.manifest.training
    if perception is None:
        raise BundleError(f"bundle {bundle.manifest.name!r} has no perception: it cannot fly")
    return (
        f"sensor {perception.sensor_size}, speed {training.max_speed:g}, "
        f"features cut at {training.idf_truncation:g}, scaled to {training.idf_norm:g}"
    )


def sizes_of(bundle: Bundle) -> str:
    """What baselines take from a bundle. Raises BundleError without perception."""
    task, perception = task_of(bundle), bundle.manifest.perception
    assert perception is not None
    unseen = perception.unknown_importance
    return f"local map {perception.local_map_size}, unseen {unseen:g}, {task}"


# Flights that go together: those of one batch of the simulator, or one other.
FlightGroup = tuple[EvaluationFlight, ...]


def groups_of(flights: Iterable[EvaluationFlight]) -> list[FlightGroup]:
    """The flights in groups that go together, in about their order."""
    alike: dict[tuple[str, str], list[EvaluationFlight]] = {}
    groups: list[FlightGroup] = []
    for flight in flights:
        if flight.flier != POLICY or flight.robot in WHOLE_ROBOTS:
            groups.append((flight,))
            continue
        waiting = alike.setdefault((flight.bundle, flight.set_up), [])
        waiting.append(flight)
        if len(waiting) * SET_UPS[flight.set_up].robots >= _ROBOTS_TOGETHER:
            groups.append(tuple(waiting))
            waiting.clear()
    return [*groups, *(tuple(waiting) for waiting in alike.values() if waiting)]


def costs_of(group: FlightGroup) -> list[tuple[EvaluationFlight, FlownCost]]:
    """Fly them, in whatever process this is.

    Raises BundleError, ValueError, OSError, and what `lpac sim` does of programs in real time.
    """
    if group[0].flier == LLOYD:
        return [(flight, _best_of_ten(flight)) for flight in group]
    if group[0].robot in WHOLE_ROBOTS:
        return [(flight, _whole(flight)) for flight in group]
    return [
        (flight, FlownCost(tuple(flown.cost_time_s.tolist()), tuple(flown.cost.tolist())))
        for flight, flown in fly_group(group)
    ]


def fly_group(group: FlightGroup) -> list[tuple[EvaluationFlight, SimulatedFlight]]:
    """The flights of points, with all that they were like.

    Raises BundleError, ValueError, OSError.
    """
    bundle, scenarios = _bundle(group[0]), [_scenario(flight) for flight in group]
    if group[0].flier != POLICY:
        flown = [fly(scenario, bundle) for scenario in scenarios]
    else:
        try:
            flown = fly_batch(scenarios, bundle)
        except PolicyFailedError as error:
            raise ValueError(f"{group[0].bundle}: {error}") from None
    return list(zip(group, flown, strict=True))


def _scenario(flight: EvaluationFlight) -> Scenario:
    set_up = SET_UPS[flight.set_up]
    world = draw_world(flight.world_set, flight.world, set_up)
    # Starts are drawn alike for all: whoever is lost might be anybody.
    left = set_up.robots - flight.lost.robots
    lost_late = flight.lost.at_s > 0.0
    robots = set_up.robots if lost_late else left
    starts_m = FIELD_SCALE.position_to_mission_m(np.array(world.starts)).tolist()
    errors_m = draw_position_errors_m(world.seed, flight.position_error_m, set_up.robots)
    if flight.robot != "point":
        layout = Layout(fleet_of(flight), Path(flight.bundle))
        starts_m = layout.pads_m.tolist()
        # What a vehicle takes its pad to be is off by its receiver's bias.
        errors_m = errors_m + layout.landing_points_m - layout.pads_m
    errors = (errors_m[:robots] * FIELD_SCALE.env_scale).tolist()
    return Scenario(
        controller="clairvoyant-cvt" if flight.flier == LLOYD else flight.flier,
        robots=robots,
        seed=world.seed,
        duration_s=flight.duration_s,
        features=world.features,
        starts_m=tuple((x_m, y_m) for x_m, y_m in starts_m[:robots]),
        scale=FIELD_SCALE,
        loss=flight.loss,
        delay_s=flight.delay_s,
        radio=flight.radio,
        max_message_age_s=flight.max_message_age_s,
        max_input_age_s=flight.max_input_age_s,
        payload=flight.payload,
        clocks=flight.clocks,
        world_size=set_up.world_size,
        communication_range=set_up.communication_range,
        lag_s=flight.lag_s,
        position_bias=tuple((x, y) for x, y in errors) if np.any(errors_m) else None,
        failures=flight.lost.failures(robots),
    )


def _best_of_ten(flight: EvaluationFlight) -> FlownCost:
    """From the start to where Lloyd's algorithm ends, as if that took no time."""
    prepared = prepare(_scenario(flight), _bundle(flight))
    coverage = Coverage(prepared.importance, FIELD_SCALE.env_scale)
    cost = coverage.cost(prepared.starts_m), coverage.lloyd(prepared.starts_m)
    return FlownCost((0.0, 0.0), cost)


def fleet_of(flight: EvaluationFlight) -> Scenario:
    """Whole robots over the flight's world; where they stand follows from its seed."""
    set_up = SET_UPS[flight.set_up]
    world = draw_world(flight.world_set, flight.world, set_up)
    return Scenario(
        robots=set_up.robots,
        seed=world.seed,
        duration_s=flight.duration_s,
        features=world.features,
        world_size=set_up.world_size,
        communication_range=set_up.communication_range,
    )


def whole_scenario(flight: EvaluationFlight) -> Scenario:
    """The same with its radio, its ages and its clocks."""
    return replace(
        fleet_of(flight),
        loss=flight.loss,
        delay_s=flight.delay_s,
        max_message_age_s=flight.max_message_age_s,
        max_input_age_s=flight.max_input_age_s,
        clocks=flight.clocks,
    )


def _whole(flight: EvaluationFlight) -> FlownCost:
    _bundle(flight)
    scenario, bundle = whole_scenario(flight), Path(flight.bundle)
    with TemporaryDirectory() as folder:
        if flight.robot == "simulated":
            return whole_cost(flight, fly_simulated(scenario, folder, bundle))
        px4_build = Path(flight.px4_build) if flight.px4_build else None
        fleet = Fleet(scenario, Path(folder), bundle, px4_build=px4_build)
        return whole_cost(flight, fly_fleet(fleet))


def whole_cost(flight: EvaluationFlight, flown: FleetFlight) -> FlownCost:
    """Of the places where the vehicles truly are, from the start of the mission on.

    Raises ValueError if it came to no mission.
    """
    record = flown.record
    if flown.problem is not None or not len(record.curve_time_s):
        raise ValueError(f"{flight.key}: {flown.problem or 'nobody flew'}")
    time_s = cost_times_s(flight.duration_s)
    cost = np.interp(time_s, record.curve_time_s, record.true_cost)
    return FlownCost(tuple(time_s.tolist()), tuple(cost.tolist()))


def _bundle(flight: EvaluationFlight) -> Bundle:
    """The flight's; raises ValueError if it is not that one."""
    bundle = _loaded(flight.bundle)
    if flight.flier == POLICY and bundle.id != flight.flown_by:
        raise ValueError(f"{flight.bundle}: is another bundle by now, or on this machine")
    return bundle


@cache
def _loaded(path: str) -> Bundle:
    """Once in each process."""
    return load_bundle(Path(path))


# Flies a group, in whatever process it is, and says what came of each flight.
CostsOf = Callable[[FlightGroup], list[tuple[EvaluationFlight, FlownCost]]]


class KeptFlights:
    """What came of flights, in a folder: who asks again for one that was flown there has it."""

    def __init__(self, folder: Path, costs: CostsOf = costs_of) -> None:
        """`costs` flies them; a folder has those of one alone. Raises OSError."""
        self._costs_of = costs
        flown_by = {"code": code_digest(edge, analysis, evaluate, radio, sim)}
        self._kept = KeptOutcomes(folder / _FLIGHTS, flown_by)
        self._costs = {
            line["flight"]: FlownCost(tuple(line["time_s"]), tuple(line["cost"]))
            for line in self._kept.lines
        }

    def fly(
        self, flights: Sequence[EvaluationFlight], pool: Pool
    ) -> Generator[tuple[EvaluationFlight, FlownCost], None, None]:
        """All of them: first what was flown before, and then the others as they come."""
        missing = []
        for flight in flights:
            if flight.key in self._costs:
                yield flight, self._costs[flight.key]
            else:
                missing.append(flight)
        if not missing:
            return
        with closing(pool(self._costs_of, groups_of(missing))) as groups:
            for flight, flown in chain.from_iterable(groups):
                self._costs[flight.key] = flown
                self._kept.add({"flight": flight.key, "time_s": flown.time_s, "cost": flown.cost})
                yield flight, flown
