"""Sets of worlds for training, selection and evaluation of policies.

World number i of a set draws its features, the robots' starts and clocks from its own seeds: spawn
keys (set, i, purpose) of one entropy. So sets have no common worlds, and a world does not depend on
how many are used.

Train on "training" and select on "validation". "test" measures the selected policy; after a
selection by its results it is no longer a test set.
"""

import math
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, NamedTuple, get_args

import numpy as np
from msgspec import Meta

from edge.core.schema import Bounded, Positive
from edge.core.world import MOST_FEATURES, GaussianFeature
from lpac.analysis.worlds import random_features
from lpac.sim.scenario import MAX_ROBOTS, Scenario

WorldSet = Literal["training", "validation", "test"]
WORLD_SETS: tuple[WorldSet, ...] = get_args(WorldSet)

_ENTROPY = 0x6C706163
# Never change or reuse these: they define the worlds.
_SET_KEYS: dict[WorldSet, int] = {"training": 0, "validation": 1, "test": 2}
_FEATURES, _STARTS, _FLIGHT = range(3)


@dataclass(frozen=True, slots=True, kw_only=True)
class SetUp(Bounded):
    """Sizes of a task, in model units; those of sensor and local map are the policy's.

    `sigma` is the range of the features' standard deviation. Raises ValueError that names the
    impossible value.
    """

    robots: Annotated[int, Meta(ge=1, le=MAX_ROBOTS)]
    world_size: Annotated[int, Meta(ge=64, le=8192)]
    communication_range: Positive
    features: Annotated[int, Meta(ge=1, le=MOST_FEATURES)]
    sigma: tuple[Positive, Positive] = (40.0, 60.0)

    def check_rules(self) -> None:
        """See `Bounded`."""
        if self.sigma[0] > self.sigma[1]:
            raise ValueError(f"sigma = {self.sigma}: must be [least, greatest]")

    @property
    def sizes(self) -> dict[str, Any]:
        """The sizes by their names in a scenario."""
        return {
            "robots": self.robots,
            "world_size": self.world_size,
            "communication_range": self.communication_range,
            "random_feature_count": self.features,
            "random_feature_sigma": self.sigma,
        }

    def scenario(self, **changes: Any) -> Scenario:
        """A scenario of this set-up with `changes`."""
        return Scenario(**{**self.sizes, **changes})

    @classmethod
    def of(cls, scenario: Scenario) -> "SetUp":
        """Set-up of a scenario. Raises ValueError if its sizes are unknown."""
        if scenario.world_size is None or scenario.communication_range is None:
            raise ValueError("world_size, communication_range: must be given")
        return cls(
            robots=scenario.robots,
            world_size=scenario.world_size,
            communication_range=scenario.communication_range,
            features=scenario.random_feature_count,
            sigma=scenario.random_feature_sigma,
        )


FIELD = SetUp(robots=10, world_size=512, communication_range=256.0, features=10)


def at_equal_density(robots: int) -> SetUp:
    """The field's density for another number of robots: area and features grow with it."""
    world_size = round(FIELD.world_size * math.sqrt(robots / FIELD.robots))
    return replace(FIELD, robots=robots, world_size=world_size, features=robots)


# The field; other numbers of robots; the paper's training; variants of the field.
SET_UPS: dict[str, SetUp] = {
    "field": FIELD,
    **{f"n{robots}": at_equal_density(robots) for robots in (1, 3, 5, 20, 32, 100, 300, 1000)},
    "paper": SetUp(robots=32, world_size=1024, communication_range=128.0, features=32),
    **{f"features-{count}": replace(FIELD, features=count) for count in (3, 5, 20, 40)},
    "features-half-as-wide": replace(FIELD, sigma=(20.0, 30.0)),
    "features-twice-as-wide": replace(FIELD, sigma=(80.0, 120.0)),
    **{f"range-{units}": replace(FIELD, communication_range=units) for units in (64, 128, 512)},
}


class DrawnWorld(NamedTuple):
    """A world and its flight, in model units: `starts` are (x, y) of each robot.

    `seed` determines all other draws: clocks, losses.
    """

    features: tuple[GaussianFeature, ...]
    starts: tuple[tuple[float, float], ...]
    seed: int


def draw_world(world_set: WorldSet, index: int, set_up: SetUp) -> DrawnWorld:
    """World number `index` >= 0 of a set. Raises ValueError if there is none."""
    if world_set not in _SET_KEYS:
        raise ValueError(f"world_set = {world_set!r}: must be one of {', '.join(_SET_KEYS)}")
    if index < 0:
        raise ValueError(f"world = {index}: must be at least 0")

    def seeds(what: int) -> np.random.SeedSequence:
        return np.random.SeedSequence(_ENTROPY, spawn_key=(_SET_KEYS[world_set], index, what))

    features = random_features(
        np.random.default_rng(seeds(_FEATURES)), set_up.features, set_up.world_size, set_up.sigma
    )
    size = (set_up.robots, 2)
    starts = np.random.default_rng(seeds(_STARTS)).uniform(0.0, set_up.world_size, size)
    [seed] = seeds(_FLIGHT).generate_state(1, np.uint64).tolist()
    return DrawnWorld(features, tuple((x, y) for x, y in starts.tolist()), seed)
