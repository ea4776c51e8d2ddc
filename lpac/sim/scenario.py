"""One flight, described for all engines."""

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from msgspec import Meta

from edge.core.frames import ModelScale
from edge.core.perception import PerceptionParameters
from edge.core.schema import AtLeastOne, Bounded, Finite, NonNegative, Positive, Share
from edge.core.wire import MAX_ROBOT_ID, PayloadType
from edge.core.world import Feature, random_features
from edge.flight.margins import ErrorBudget
from edge.policy.bundle import Bundle, BundleError
from lpac.fleet.settings import Transport
from lpac.radio.airtime import LinkQuality
from lpac.radio.modelled import ModelledRadio
from lpac.sim.baselines import BaselineName
from lpac.sim.description import ERRORS, FIELD_SCALE
from lpac.sim.failure import Failure, require_possible
from lpac.sim.ticks import Clocks

if TYPE_CHECKING:
    Features = tuple[Feature, ...]
else:
    # Files name a world's file instead: msgspec takes no union of dataclasses.
    Features = tuple

# The sensor's type that every installation has.
WORLD_SENSOR = "world"
Controller = Literal["lpac"] | BaselineName

MAX_ROBOTS = MAX_ROBOT_ID + 1
_INPUT_AGE_S = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario(Bounded):
    """One flight: who flies what, over which world, and what is wrong with it.

    Everything random follows from `seed`, but for the timing of programs in real time. All engines
    fly it: points (`lpac.sim.experiment`, `lpac.sim.batch`), whole robots on a simulated clock
    (`lpac.sim.fleet.clocked`), and as programs on simulated vehicles or PX4s
    (`lpac.sim.fleet.flight`). An engine refuses what it cannot do.

    World, in model units: without `features` there are `random_feature_count` Gaussian ones,
    `random_feature_sigma` (least, greatest) wide. `world_size` and `communication_range` are the
    bundle's where they are None.

    Team: `starts_m` is one position in the mission frame per robot; else points start anywhere in
    the world, and whole robots where there is room. `failures` are robots that are away: points
    fail, whole robots are taken out of the fence by a pilot. Ages and `payload` are those of
    `PacParameters`, and `clocks` the periods of the robots' loops. Where `max_input_age_s` is None,
    inputs count for two of the longest periods, and for 1 s at least.

    Radio: `loss` is the probability that a message is lost, `delay_s` how late it is on average; of
    whole robots from the mission's start on.

    Points alone: `controller` may be a baseline, which knows true positions and needs no radio;
    `max_speed_m_s` is the bundle's where it is None; `position_bias` is, per robot and in model
    units, how wrong its position is, to which an error of the standard deviation `position_error_m`
    along each axis is added; vehicles follow a velocity with the time constant `lag_s`; with a
    `radio` its model says what is lost and late.

    Whole robots alone: without `errors` their estimates are off by noise alone, and there is no
    wind; `wind_m_s` is the mean wind, drawn from the seed where it is None, with gusts of up to
    8 m/s; `budget` is the error they allow for; `sensor` the `type` in robot.toml's [sensor]; with
    `secure` the fleet has keys; `transport` is that of fleet.toml's [radio].

    Raises ValueError that names what is impossible.
    """

    controller: Controller = "lpac"
    robots: Annotated[int, Meta(ge=1, le=MAX_ROBOTS)] = 10
    seed: Annotated[int, Meta(ge=0)] = 0
    duration_s: Positive = 60.0
    features: Features | None = None
    random_feature_count: Annotated[int, Meta(ge=0)] = 10
    starts_m: tuple[tuple[Finite, Finite], ...] | None = None
    scale: ModelScale = FIELD_SCALE
    loss: Share = 0.0
    delay_s: NonNegative = 0.0
    radio: ModelledRadio | None = None
    max_message_age_s: NonNegative = 0.8
    max_input_age_s: NonNegative | None = None
    payload: PayloadType = "float16"
    random_feature_sigma: tuple[Positive, Positive] = (40.0, 60.0)
    world_size: AtLeastOne | None = None
    communication_range: Positive | None = None
    max_speed_m_s: Positive | None = None
    lag_s: NonNegative = 0.0
    position_bias: tuple[tuple[Finite, Finite], ...] | None = None
    position_error_m: NonNegative = 0.0
    failures: tuple[Failure, ...] = ()
    clocks: Clocks = field(default_factory=Clocks)
    errors: bool = True
    wind_m_s: NonNegative | None = None
    budget: ErrorBudget = ERRORS
    sensor: str = WORLD_SENSOR
    secure: bool = False
    transport: Transport = "mesh"

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
            raise ValueError(f"controller = {self.controller!r}: a baseline knows no failures")
        if self.controller != "lpac" and self.radio is not None:
            raise ValueError(f"controller = {self.controller!r}: a baseline needs no radio")
        require_possible(self.failures, self.robots)

    @property
    def input_age_s(self) -> float:
        """For how long images and actions count."""
        if self.max_input_age_s is not None:
            return self.max_input_age_s
        return max(_INPUT_AGE_S, 2.0 * self.clocks.perception_s, 2.0 * self.clocks.policy_s)

    @property
    def link(self) -> LinkQuality:
        """What messages suffer, as it was asked for, or by the model."""
        if self.radio is None:
            return LinkQuality(self.loss, self.delay_s)
        return self.radio.link(self.robots, self.payload, 1.0 / self.clocks.policy_s)

    def perception_of(self, bundle: Bundle) -> PerceptionParameters:
        """The bundle's, with the scenario's sizes. Raises BundleError if it has none."""
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
        """Raise ValueError if one of these fields asks for what this engine cannot do."""
        for name in names:
            default = getattr(_DEFAULT, name)
            if getattr(self, name) != default:
                raise ValueError(
                    f"{name} = {getattr(self, name)}: must be {default} for {engine}, which know "
                    "nothing of it"
                )


_DEFAULT = Scenario()
