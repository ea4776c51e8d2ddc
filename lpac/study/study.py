"""A study: policies and baselines over the worlds of a set, under conditions.

Studies are TOML files (docs/research.md has one), or made in Python.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Literal, NamedTuple, get_args

import numpy as np
from msgspec import Meta

from edge.core import F64
from edge.core.counted import counted
from edge.core.schema import Bounded
from edge.core.world import MOST_FEATURES
from edge.drivers.registry import open_sensor
from edge.policy.bundle import load_bundle
from lpac.shipped import SHIPPED_BUNDLE
from lpac.sim.baselines import BaselineName
from lpac.sim.description import FIELD_SCALE
from lpac.sim.engines import Engine, EngineName, engine_of, loaded_bundle
from lpac.sim.failure import NONE_LOST, LostRobots
from lpac.sim.fleet.layout import Layout, pads_for_all
from lpac.sim.scenario import Scenario
from lpac.study.flights import CLAIRVOYANT, PlannedFlight, sizes_of, task_of
from lpac.study.worlds import FIELD, SET_UPS, SetUp, WorldSet, draw_world

BASELINES: tuple[BaselineName, ...] = get_args(BaselineName)
Figure = Literal[
    "curves", "distributions", "pairs", "conditions", "worst", "snapshots", "repeatability",
    "perturbation", "rates",
]  # fmt: skip
# Default of a study.
USUAL_FIGURES: tuple[Figure, ...] = ("curves", "distributions", "pairs", "conditions", "worst")
# Figures that need records of whole flights, not only costs.
_OF_RECORDS = ("snapshots", "repeatability", "perturbation")


Worlds = Annotated[int, Meta(ge=1, le=10_000)]
Trials = Annotated[int, Meta(ge=1, le=1000)]
WorldNumber = Annotated[int, Meta(ge=0, le=1_000_000)]
# Distance of a position from its true place, m.
Misplaced = Annotated[float, Meta(ge=0.0, le=1000.0)]
# In bytes: folders of figures have these names.
_LONGEST_NAME = 200


class ConditionError(ValueError):
    """A condition of a study under which no flight is possible."""

    def __init__(self, condition: "Condition", text: str) -> None:
        super().__init__(text)
        self.condition = condition


class Draw(NamedTuple):
    """A world of the set, by number, and a trial over it."""

    world: int
    trial: int = 0


class TrainedBundle(NamedTuple):
    """Path and id of a bundle."""

    path: str
    bundle_id: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Method:
    """A baseline, or a policy with the bundles of its trainings, which differ only in their seed.

    Raises ValueError for an invalid name of a policy, or a baseline's name.
    """

    name: str
    trainings: tuple[TrainedBundle, ...] = ()

    def __post_init__(self) -> None:
        _require_name("name", self.name)
        if self.trainings and self.name in BASELINES:
            raise ValueError(f"name = {self.name!r}: is a baseline's: choose another")

    @property
    def trained(self) -> bool:
        """Whether it is a policy."""
        return bool(self.trainings)

    @classmethod
    def of(cls, name: str, *bundles: Path | str) -> "Method":
        """A policy by the paths of its bundles, or without bundles the baseline of that name.

        Raises BundleError; ValueError for an unknown baseline.
        """
        if not bundles and name not in BASELINES:
            raise ValueError(f"baseline {name!r}: must be one of {', '.join(BASELINES)}")
        trainings = (TrainedBundle(str(Path(p).resolve()), load_bundle(p).id) for p in bundles)
        return cls(name=name, trainings=tuple(trainings))


@dataclass(frozen=True, slots=True, kw_only=True)
class Condition:
    """Common properties of the flights of all methods.

    `scenario` has the sizes; its world (unless it has features), starts and seed are drawn for each
    world of the set. `engine` flies the policies; baselines are points. With `from_pads` points
    start on whole robots' pads, with their position errors. The last robots are `lost` in flight;
    baselines never had them. `methods` names the methods that fly; all if empty.

    Raises ValueError that names the impossible value.
    """

    scenario: Scenario = field(default_factory=FIELD.scenario)
    engine: EngineName = "point"
    from_pads: bool = False
    lost: LostRobots = NONE_LOST
    methods: tuple[str, ...] = ()
    title: str = ""

    def __post_init__(self) -> None:
        scenario, lost = self.scenario, f"lost = {self.lost.robots}@{self.lost.at_s:g}"
        count, robots = scenario.random_feature_count, scenario.robots
        if not 1 <= count <= MOST_FEATURES:
            raise ValueError(f"random_feature_count = {count}: must be from 1 to {MOST_FEATURES}")
        world_m = SetUp.of(scenario).world_size / scenario.scale.env_scale
        for place_m in scenario.starts_m or ():
            if not all(0.0 <= each <= world_m for each in place_m):
                raise ValueError(
                    f"starts_m: {list(place_m)}: must be within the world, from 0 to {world_m:g} m"
                )
        if self.lost.robots and not 0.0 < self.lost.at_s < scenario.duration_s:
            raise ValueError(f"{lost}: must be in flight, before {scenario.duration_s:g} s")
        if self.lost.robots >= robots:
            raise ValueError(f"{lost}: must be fewer than robots = {robots}")
        _require_name("title", self.name)

    @property
    def name(self) -> str:
        """Title for people; by default the set-up and its differences."""
        return self.title or ", ".join([self.set_up, *self._differences()])

    @property
    def folder(self) -> str:
        """Name of the folder of its figures."""
        name = self.name.replace(",", "").replace("%", "percent")
        return name.replace(" ", "-").replace("/", "-")

    @property
    def set_up(self) -> str:
        """Name of the set-up, or its sizes if it has none."""
        own = SetUp.of(self.scenario)
        return next((name for name, known in SET_UPS.items() if known == own), self.sizes)

    @property
    def sizes(self) -> str:
        """Description of the sizes."""
        own, features = SetUp.of(self.scenario), self.scenario.features
        count = own.features if features is None else len(features)
        return (
            f"{counted(own.robots, 'robot')} in {own.world_size} x {own.world_size} units, "
            f"{counted(count, 'feature')}, range {own.communication_range:g}"
        )

    def _differences(self) -> Iterator[str]:
        scenario = self.scenario
        if scenario.loss:
            yield f"{100.0 * scenario.loss:g} % of messages lost"
        if scenario.radio:
            yield f"{scenario.radio.transport} by the model"
        if self.lost.robots:
            yield f"{self.lost.robots} of {scenario.robots} robots lost at {self.lost.at_s:g} s"
        if scenario.lag_s:
            yield f"lag {scenario.lag_s:g} s"
        if scenario.position_error_m:
            yield f"positions off by {scenario.position_error_m:g} m"
        if scenario.payload != "float16":
            yield f"payloads in {scenario.payload}"
        if scenario.failures:
            yield f"{counted(len(scenario.failures), 'robot')} away for a while"
        if self.from_pads:
            yield "points from pads, GPS off"
        usual = FIELD.scenario()
        for each in fields(Scenario):
            value = getattr(scenario, each.name)
            if each.name not in _IN_NAME and value != getattr(usual, each.name):
                yield f"{each.name} = {_short(value)}"
        if self.engine != "point":
            yield _ENGINES[self.engine]


def _require_name(key: str, name: str) -> None:
    """Raise ValueError for a name that cannot be a folder's or a figure's."""
    if (
        not name.isprintable() or name.startswith(".") or "$" in name
        or not 0 < len(name.encode()) <= _LONGEST_NAME
    ):  # fmt: skip
        shown = f"{name[:60]}..." if len(name) > 60 else name
        raise ValueError(
            f"{key} = {shown!r}: must be 1 to {_LONGEST_NAME} letters on one line, without $ and "
            "leading dot"
        )


_ENGINES: dict[EngineName, str] = {
    "simulated": "whole robots",
    "mavlink": "whole robots, as programs",
    "px4": "whole robots, on PX4",
}
# Keys of a scenario that `Condition.name` has in words, or that are drawn.
_IN_NAME = {
    "controller", "robots", "seed", "duration_s", "world_size", "communication_range",
    "random_feature_count", "random_feature_sigma", "loss", "radio", "lag_s", "position_error_m",
    "payload", "scale", "failures",
}  # fmt: skip


def _short(value: object) -> str:
    """Text of a value; for a dataclass, of its differences from the defaults."""
    if not hasattr(value, "__dataclass_fields__"):
        return f"{value:g}" if isinstance(value, float) else f"{value}"
    usual = type(value)()
    changed = (f.name for f in fields(value) if getattr(value, f.name) != getattr(usual, f.name))  # type: ignore[arg-type]
    return ", ".join(f"{name} {_short(getattr(value, name))}" for name in changed)


@dataclass(frozen=True, slots=True, kw_only=True)
class Study(Bounded):
    """Policies over `worlds` worlds of a set from `first_world` on, under each condition.

    Each world has its own starts, or all have those of the `first` one, and with whole robots also
    the same receivers and wind. Each world is flown in `trials`, which differ in everything drawn
    except the world: starts are within `placed_within_m` of the world's, and positions of points
    are off by a constant `receiver_error_m` (least, greatest).

    The clairvoyant baseline always flies, for comparison. Baselines take their sizes from the first
    bundle, or without policies from the bundle at `sizes_from`. `figures` are drawn from the
    results. `px4_build` is the build folder of real PX4s.

    Raises BundleError; ValueError that names the impossible value, also what an engine cannot do.
    """

    methods: tuple[Method, ...]
    conditions: Annotated[tuple[Condition, ...], Meta(min_length=1)] = (Condition(),)
    world_set: WorldSet = "validation"
    first_world: WorldNumber = 0
    worlds: Worlds = 20
    starts: Literal["own", "first"] = "own"
    trials: Trials = 1
    placed_within_m: Misplaced = 0.0
    receiver_error_m: tuple[Misplaced, Misplaced] | None = None
    title: str = ""
    text: str = ""
    figures: tuple[Figure, ...] = USUAL_FIGURES
    sizes_from: str = str(SHIPPED_BUNDLE)
    px4_build: str = ""

    def check_rules(self) -> None:
        """See `Bounded`."""
        least_m, greatest_m = self.receiver_error_m or (0.0, 0.0)
        if least_m > greatest_m:
            raise ValueError(
                f"receiver_error_m = {self.receiver_error_m}: must be [least, greatest]"
            )
        names = [method.name for method in self.all_methods]
        if len(set(names)) < len(names):
            raise ValueError(f"methods {', '.join(names)}: must differ")
        tasks = {task_of(loaded_bundle(path)): path for path in self._bundles}
        if len(tasks) > 1:
            different = "; ".join(f"{path}: {task}" for task, path in tasks.items())
            raise ValueError(f"bundles of different tasks: {different}")
        folders = set()
        for condition in self.conditions:
            try:
                self._require(condition)
                if condition.folder in folders:
                    raise ValueError(f"title = {condition.name!r}: is used twice")
            except ValueError as error:
                raise ConditionError(condition, str(error)) from None
            folders.add(condition.folder)
        if "repeatability" in self.figures and self.trials == 1:
            raise ValueError("figures = 'repeatability': needs trials of at least 2")
        first, policy = self.conditions[0], self.methods_of(self.conditions[0])[0]
        away = [f for f in first.scenario.failures if f.from_s < first.scenario.duration_s]
        if "perturbation" in self.figures and not (away and policy.trained):
            raise ValueError(
                "figures = 'perturbation': needs a policy, and failures in flight, under the first "
                "condition"
            )

    def _require(self, condition: Condition) -> None:
        """Raise ValueError if a condition cannot be flown, as far as known in advance."""
        engine, scenario = self.engine_of(condition), condition.scenario
        engine.require_able(scenario)
        if scenario.fault:
            raise ValueError(
                f"fault = {scenario.fault}: must not be given in a study; `lpac drill` flies faults"
            )
        if engine.whole_robots and condition.lost.robots:
            raise ValueError(
                f"lost = {condition.lost.robots}@{condition.lost.at_s:g}: must not be given for "
                "whole robots; `failures` takes them out of the mission for a while"
            )
        if engine.whole_robots and condition.from_pads:
            raise ValueError("from_pads = True: must be False for whole robots, which always do")
        names = [method.name for method in self.all_methods]
        for name in condition.methods:
            if name not in names:
                raise ValueError(f"methods = {name!r}: must be one of {', '.join(names)}")
        for path in dict.fromkeys([self.sized_by, *self._bundles]):
            scenario.perception_of(loaded_bundle(path))
        if engine.whole_robots:
            open_sensor(scenario.sensor, {}, loaded_bundle(self.sized_by).manifest)
        # Check that all fit on their pads.
        for method in self.methods_of(condition):
            next(self.flights_of(method, condition, Draw(self.first_world)))

    @property
    def all_methods(self) -> tuple[Method, ...]:
        """The methods, with the clairvoyant baseline."""
        if CLAIRVOYANT in [method.name for method in self.methods]:
            return self.methods
        return (*self.methods, Method(name=CLAIRVOYANT))

    @property
    def _bundles(self) -> list[str]:
        """Paths of all bundles."""
        return list(dict.fromkeys(each.path for p in self.methods for each in p.trainings))

    @property
    def sized_by(self) -> str:
        """Path of the bundle that gives baselines their sizes."""
        return next(iter(self._bundles), self.sizes_from)

    @property
    def sizes(self) -> str:
        """Description of the baselines' sizes."""
        return sizes_of(loaded_bundle(self.sized_by))

    @property
    def draws(self) -> list[Draw]:
        """All trials in all worlds."""
        numbers = range(self.first_world, self.first_world + self.worlds)
        return [Draw(world, trial) for world in numbers for trial in range(self.trials)]

    @property
    def needs_records(self) -> bool:
        """Whether its figures need records, which are not stored: such flights are flown again."""
        return any(figure in _OF_RECORDS for figure in self.figures)

    def engine_of(self, condition: Condition) -> Engine:
        """Engine of the policies. Raises ValueError for PX4 without a build folder."""
        is_px4 = condition.engine == "px4"
        if is_px4 and not self.px4_build:
            raise ValueError("engine = 'px4': needs PX4's build folder, --px4")
        return engine_of(condition.engine, Path(self.px4_build) if is_px4 else None)

    def methods_of(self, condition: Condition) -> tuple[Method, ...]:
        """The methods that fly under a condition."""
        return tuple(
            method
            for method in self.all_methods
            if not condition.methods or method.name in (*condition.methods, CLAIRVOYANT)
        )

    def flights(self) -> list[PlannedFlight]:
        """All flights, each once; those over one world are adjacent."""
        wanted = (
            flight
            for condition in self.conditions
            for draw in self.draws
            for method in self.methods_of(condition)
            for flight in self.flights_of(method, condition, draw)
        )
        return list(dict.fromkeys(wanted))

    def flights_of(
        self, method: Method, condition: Condition, draw: Draw
    ) -> Iterator[PlannedFlight]:
        """One flight for each training, or for the baseline."""
        scenario = self._scenario(method, condition, draw)
        trainings = method.trainings or (TrainedBundle(self.sized_by, self.sizes),)
        for path, bundle_id in trainings:
            yield PlannedFlight(
                scenario=scenario,
                bundle=path,
                flown_by=bundle_id,
                engine=condition.engine if method.trained else "point",
                px4_build=self.px4_build if method.trained and condition.engine == "px4" else "",
            )

    def _scenario(self, method: Method, condition: Condition, draw: Draw) -> Scenario:
        template, set_up = condition.scenario, SetUp.of(condition.scenario)
        drawn = draw_world(self.world_set, draw.world, set_up)
        first = drawn
        if self.starts == "first":
            first = draw_world(self.world_set, self.first_world, set_up)
        on_pads = condition.from_pads or condition.engine != "point"
        scenario = replace(
            template,
            # The seed also determines whole robots' pads, receivers and wind.
            seed=(first if on_pads else drawn).seed + draw.trial,
            features=template.features or drawn.features,
        )
        rng = np.random.default_rng(np.random.SeedSequence([first.seed, draw.trial]))
        starts_m: F64 | None = None
        if template.starts_m is not None:
            starts_m = np.array(template.starts_m)
        elif not on_pads:
            starts_m = FIELD_SCALE.position_to_mission_m(np.array(first.starts, np.float64))
        elif self.trials > 1:
            seeds = range(first.seed, first.seed + self.trials)
            each = [replace(_on_pads(scenario), seed=seed) for seed in seeds]
            starts_m = pads_for_all(each, Path(self.sized_by), self.placed_within_m)
        if starts_m is not None and self.placed_within_m:
            radii_m = self.placed_within_m * rng.uniform(0.0, 1.0, len(starts_m)) ** 0.5
            starts_m = starts_m + _around(radii_m, rng)
        if starts_m is not None:
            scenario = replace(scenario, starts_m=_pairs(starts_m))
        if method.trained and condition.engine != "point":
            return scenario
        if on_pads:
            pads_m, bias_m = _pads(_on_pads(scenario), self.sized_by)
            scenario = replace(scenario, starts_m=_pairs(pads_m))
        elif self.receiver_error_m is not None:
            bias_m = _around(rng.uniform(*self.receiver_error_m, scenario.robots), rng)
        else:
            bias_m = None
        if bias_m is not None:
            scenario = replace(scenario, position_bias=_pairs(bias_m * FIELD_SCALE.env_scale))
        if method.trained:
            lost = condition.lost.failures(scenario.robots)
            return replace(scenario, failures=(*scenario.failures, *lost))
        return _of_baseline(scenario, method.name, condition.lost.robots)


_USUAL = Scenario()
# Keys without effect on a baseline, which senses and decides at once and sends nothing.
_OF_POLICIES = (
    "loss", "delay_s", "radio", "max_message_age_s", "max_input_age_s", "payload", "clocks",
    "errors", "wind_m_s", "budget", "sensor", "secure", "transport", "failures",
)  # fmt: skip
# Keys of points only, or without effect on the pads of whole robots.
_OF_POINTS = (
    "radio", "payload", "lag_s", "position_error_m", "max_speed_m_s", "clocks", "failures",
)  # fmt: skip


def _of_baseline(scenario: Scenario, name: str, lost: int) -> Scenario:
    """The same scenario for a baseline, without the `lost` robots."""
    # Starts are drawn equally for all robots, so dropping the last ones is no bias.
    robots, starts_m, bias = scenario.robots - lost, scenario.starts_m, scenario.position_bias
    [controller] = [baseline for baseline in BASELINES if baseline == name]
    return replace(
        scenario,
        controller=controller,
        robots=robots,
        starts_m=starts_m and starts_m[:robots],
        position_bias=bias and bias[:robots],
        **{each: getattr(_USUAL, each) for each in _OF_POLICIES},
    )


def _on_pads(scenario: Scenario) -> Scenario:
    """The scenario of whole robots that corresponds to one of points, for their pads."""
    return replace(scenario, **{name: getattr(_USUAL, name) for name in _OF_POINTS})


def _around(radii_m: F64, rng: np.random.Generator) -> F64:
    """Offsets (N, 2) of these lengths in random directions."""
    angles_rad = rng.uniform(0.0, 2.0 * np.pi, len(radii_m))
    directions = np.column_stack([np.cos(angles_rad), np.sin(angles_rad)])
    offsets_m: F64 = radii_m[:, None] * directions
    return offsets_m


@cache
def _pads(scenario: Scenario, bundle: str) -> tuple[F64, F64]:
    """Positions of whole robots, and their receivers' errors there; (N, 2) each, m."""
    layout = Layout(scenario, Path(bundle))
    return layout.pads_m, layout.landing_points_m - layout.pads_m


def _pairs(rows: F64) -> tuple[tuple[float, float], ...]:
    return tuple((x, y) for x, y in rows.tolist())
