"""One flight, described for all engines."""

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from msgspec import Meta

from edge.core.frames import ModelScale
from edge.core.perception import PerceptionParameters
from edge.core.schema import AtLeastOne, Bounded, Finite, NonNegative, Positive, Share
from edge.core.wire import MAX_ROBOT_ID, PayloadType
from edge.core.world import Feature
from edge.flight.margins import ErrorBudget
from edge.policy.bundle import Bundle, BundleError
from lpac.analysis.worlds import random_features
from lpac.radio.airtime import LinkQuality, Transport
from lpac.radio.modelled import ModelledRadio
from lpac.sim.baselines import BaselineName
from lpac.sim.description import ERRORS, FIELD_SCALE
from lpac.sim.failure import Failure, require_possible
from lpac.sim.ticks import Clocks

if TYPE_CHECKING:
    Features = tuple[Feature, ...]
else:
    # Configuration files name a world file instead: msgspec takes no union of dataclasses.
    Features = tuple

# The sensor's type that every installation has.
WORLD_SENSOR = "world"
Controller = Literal["lpac", BaselineName]

MAX_ROBOTS = MAX_ROBOT_ID + 1
_INPUT_AGE_S = 1.0


class UnableError(ValueError):
    """An engine does not support the value of a scenario's field."""

    def __init__(self, engine: str, name: str, value: object, default: object) -> None:
        super().__init__(engine, name, value, default)
        self.name = name

    def __str__(self) -> str:
        engine, name, value, default = self.args
        must = f"{name} = {value}: must be"
        allowed = "left out" if default is None else default or repr(default)
        return f"{must} {allowed} for {engine}, which do not support it"


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario(Bounded):
    """One flight: team, controller, world and faults.

    All random values follow from `seed`, except the timing of programs in real time. All engines
    (`lpac.sim.engines`) fly it; an engine refuses fields that it does not support.

    World, in model units: without `features` there are `random_feature_count` Gaussian ones,
    `random_feature_sigma` (least, greatest) wide.

    Team: `starts_m` is one position in the mission frame per robot; by default points start
    anywhere in the world, and whole robots where there is room. `failures` are absent robots:
    points fail, whole robots are flown out of the fence by a pilot. `clocks` are the periods of the
    robots' loops. If `max_input_age_s` is None, inputs are valid for two of the longest periods,
    and for at least 1 s.

    Points alone: `max_speed_m_s` defaults to the bundle's; `position_bias` is the position error of
    each robot, model units, to which the error of `position_error_m` is added; a `radio` model
    gives loss and delay of messages.

    Whole robots alone: `budget` is the error that they allow for. A `fault` of the drill sets the
    duration of the flight.

    Raises ValueError that names the invalid field.
    """

    controller: Annotated[
        Controller,
        "Controller: lpac, which flies the bundle's policy, or a baseline.",
    ] = "lpac"
    robots: Annotated[int, Meta(ge=1, le=MAX_ROBOTS), "Number of robots."] = 10
    seed: Annotated[
        int, Meta(ge=0), "Seed of world, starts, clocks, losses and vehicles' errors."
    ] = 0
    duration_s: Annotated[
        float, Meta(gt=0.0, le=86_400.0), "Flight time, s; of whole robots that of the mission."
    ] = 60.0
    features: Features | None = None
    random_feature_count: Annotated[int, Meta(ge=0), "Features of a random world."] = 10
    starts_m: tuple[tuple[Finite, Finite], ...] | None = None
    scale: ModelScale = FIELD_SCALE
    loss: Annotated[
        Share, "Probability that a message is lost; of whole robots from the mission's start on."
    ] = 0.0
    delay_s: Annotated[
        NonNegative, "Mean delay of a message, s; of whole robots from the mission's start on."
    ] = 0.0
    radio: ModelledRadio | None = None
    max_message_age_s: Annotated[
        NonNegative, "Older messages are not used, s; 0: each is used once."
    ] = 0.8
    max_input_age_s: NonNegative | None = None
    payload: Annotated[PayloadType, "Points: number type in messages."] = "float16"
    random_feature_sigma: tuple[Positive, Positive] = (40.0, 60.0)
    world_size: Annotated[
        AtLeastOne | None, "Side of the world, in model units; else the bundle's."
    ] = None
    communication_range: Annotated[
        Positive | None, "Communication range, in model units; else the bundle's."
    ] = None
    max_speed_m_s: Positive | None = None
    lag_s: Annotated[NonNegative, "Points: time constant by which robots follow a velocity, s."] = (
        0.0
    )
    position_bias: tuple[tuple[Finite, Finite], ...] | None = None
    position_error_m: Annotated[
        NonNegative,
        "Points: position error of the robots, standard deviation along each axis, m.",
    ] = 0.0
    failures: tuple[Failure, ...] = ()
    clocks: Clocks = field(default_factory=Clocks)
    errors: Annotated[
        bool,
        "Whole robots: with errors of positions, heights, compasses and batteries, and in wind.",
    ] = True
    wind_m_s: Annotated[
        Annotated[float, Meta(ge=0.0, le=30.0)] | None,
        "Whole robots: the mean wind, m/s, with gusts of up to 8 m/s; else it is drawn.",
    ] = None
    budget: ErrorBudget = ERRORS
    sensor: Annotated[str, "Whole robots: the type of their sensor."] = WORLD_SENSOR
    secure: Annotated[
        bool,
        "Whole robots: robots and ground are members of a fleet, with keys that are made for it: "
        "their messages are signed, and all others are dropped.",
    ] = False
    transport: Transport = "mesh"
    fault: Annotated[str, "Whole robots: a fault of the drill, by name."] = ""

    def check_rules(self) -> None:
        """See `Bounded`."""
        for name, of_each in (("starts_m", self.starts_m), ("position_bias", self.position_bias)):
            if of_each is not None and len(of_each) != self.robots:
                raise ValueError(f"{name}: {len(of_each)} positions for {self.robots} robots")
        if self.radio is not None and (self.loss or self.delay_s):
            raise ValueError(
                f"loss = {self.loss}, delay_s = {self.delay_s}: must be 0 with a modelled radio"
            )
        least, greatest = self.random_feature_sigma
        if not least <= greatest:
            raise ValueError(
                f"random_feature_sigma = {self.random_feature_sigma}: must be (least, greatest)"
            )
        if self.controller != "lpac" and self.failures:
            raise ValueError(f"controller = {self.controller!r}: must be lpac with failures")
        if self.controller != "lpac" and self.radio is not None:
            raise ValueError(f"controller = {self.controller!r}: must be lpac with a radio")
        require_possible(self.failures, self.robots)

    @property
    def input_age_s(self) -> float:
        """Validity of images and actions, s."""
        if self.max_input_age_s is not None:
            return self.max_input_age_s
        return max(_INPUT_AGE_S, 2.0 * self.clocks.perception_s, 2.0 * self.clocks.policy_s)

    @property
    def link(self) -> LinkQuality:
        """Loss and delay of messages: as set, or by the radio model."""
        if self.radio is None:
            return LinkQuality(self.loss, self.delay_s)
        return self.radio.link(self.robots, self.payload, 1.0 / self.clocks.policy_s)

    def perception_of(self, bundle: Bundle) -> PerceptionParameters:
        """The bundle's perception with the scenario's sizes. Raises BundleError without one."""
        trained = bundle.manifest.perception
        if trained is None:
            name = bundle.manifest.name
            raise BundleError(f"bundle {name!r} has no perception: it cannot fly")
        world_size, range_ = self.world_size, self.communication_range
        return replace(
            trained,
            world_size=trained.world_size if world_size is None else world_size,
            communication_range=trained.communication_range if range_ is None else range_,
        )

    def draw_features(self, world_size: int) -> tuple[Feature, ...]:
        """The world's features: those given, or else random ones."""
        if self.features is not None:
            return self.features
        rng = np.random.default_rng(np.random.SeedSequence(self.seed).spawn(1)[0])
        return random_features(
            rng, self.random_feature_count, world_size, self.random_feature_sigma
        )

    def require_default(self, engine: str, *names: str) -> None:
        """Raise UnableError if one of these fields, which `engine` does not support, is set."""
        for name in names:
            value, default = getattr(self, name), getattr(_DEFAULT, name)
            if value != default:
                raise UnableError(engine, name, value, default)


_DEFAULT = Scenario()
