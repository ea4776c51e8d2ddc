"""Generates data: states in the batched simulator with the expert's velocities.

Flights and their random numbers follow from the configuration, the round and the flight's number.
Worker processes fly a shard at a time; this module does not import torch.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from edge.core import F32, F64, Bools
from edge.core.perception import PerceptionParameters
from edge.policy.bundle import Bundle
from edge.policy.family import Neighbourhood, Observation
from lpac.sim.batch import BatchedFlights, BatchMoment, PolicyFailedError
from lpac.sim.batch.agents import Agents, Inputs, PolicySteps, make_agents
from lpac.sim.failure import Failure
from lpac.sim.scenario import Scenario
from lpac.study.worlds import SetUp, draw_world
from lpac.train.config import DaggerConfig, DataConfig, Disturbances
from lpac.train.expert import LOOK_PERIOD_S
from lpac.train.task import CoverageTask, Task, Teacher

# In a shard: larger batches are no faster, and a kill loses one shard.
_ROBOTS_TOGETHER = 40
# Each training seed draws its own worlds from the training set.
_WORLDS_PER_SEED = 1_000_000
# All robots have perceived once by then.
_FIRST_STATE_S = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedShard:
    """Flights whose states at `times_s` are stored together; the expert flies those `by_expert`."""

    name: str
    scenarios: tuple[Scenario, ...]
    by_expert: tuple[bool, ...]
    times_s: tuple[float, ...]
    data: DataConfig


class ShardTask(NamedTuple):
    """A shard to fly. The bundle defines the inputs, and flies unless the expert does."""

    shard: PlannedShard
    bundle: Bundle
    task: Task = CoverageTask()


@dataclass(frozen=True, slots=True, eq=False)
class States:
    """S states of swarms, with R robots in total; failed robots are left out.

    `inputs` (R, ...) by name, images as float16; `velocities` (R, 2) are the expert's, in model
    units/s; `robots` (S,) is the number of robots of each state, and `adjacency` (sum of their
    squares,) which of them are in range, row by row. `largest_payload` is the flights' maximum.
    """

    inputs: dict[str, npt.NDArray[np.floating]]
    velocities: F32
    robots: npt.NDArray[np.int32]
    adjacency: Bools
    largest_payload: float


def plan_round(
    data: DataConfig, dagger: DaggerConfig, seed: int, round_: int
) -> list[PlannedShard]:
    """The shards of a round; the expert flies all of round 0."""
    flights = data.flights if round_ == 0 else dagger.flights
    first = 0 if round_ == 0 else data.flights + (round_ - 1) * dagger.flights
    duration_s = data.duration_s if round_ == 0 else dagger.duration_s
    experts = flights if round_ == 0 else round(dagger.expert_flights * flights)
    shards: list[list[tuple[Scenario, bool]]] = [[]]
    for number in range(flights):
        scenario = _draw_flight(data, duration_s, seed, first + number)
        robots = sum(planned.robots for planned, _ in shards[-1])
        if shards[-1] and robots + scenario.robots > _ROBOTS_TOGETHER:
            shards.append([])
        shards[-1].append((scenario, number < experts))
    return [
        PlannedShard(
            name=f"{round_:02d}-{number:04d}",
            scenarios=tuple(scenario for scenario, _ in shard),
            by_expert=tuple(by_expert for _, by_expert in shard),
            times_s=_draw_times_s(data.states, duration_s, [seed, round_, number]),
            data=data,
        )
        for number, shard in enumerate(shards)
    ]


def _draw_times_s(states: int, duration_s: float, seed: list[int]) -> tuple[float, ...]:
    """Draw one time in each of `states` equal parts of the flight."""
    rng = np.random.default_rng(np.random.SeedSequence(seed))
    edges = np.linspace(_FIRST_STATE_S, duration_s, states + 1)
    return tuple(rng.uniform(edges[:-1], edges[1:]).tolist())


def _draw_flight(data: DataConfig, duration_s: float, seed: int, number: int) -> Scenario:
    rng = np.random.default_rng(np.random.SeedSequence([seed, number]))
    weights = np.array([worlds.weight for worlds in data.worlds])
    worlds = data.worlds[int(rng.choice(len(weights), p=weights / weights.sum()))]
    least, most = worlds.sigma
    set_up = SetUp(
        robots=_integer(rng, worlds.robots),
        world_size=_integer(rng, worlds.world_size),
        communication_range=_uniform(rng, worlds.communication_range),
        features=_integer(rng, worlds.features),
        sigma=(least, most),
    )
    world = draw_world("training", seed * _WORLDS_PER_SEED + number, set_up)
    starts_m = data.scale.position_to_mission_m(np.array(world.starts)).tolist()
    wrong = data.disturbances
    bias = rng.normal(0.0, _uniform(rng, wrong.position_bias), (set_up.robots, 2)).tolist()
    return Scenario(
        robots=set_up.robots,
        seed=world.seed,
        duration_s=duration_s,
        features=world.features,
        starts_m=tuple((x_m, y_m) for x_m, y_m in starts_m),
        scale=data.scale,
        clocks=data.clocks,
        world_size=set_up.world_size,
        communication_range=set_up.communication_range,
        loss=_uniform(rng, wrong.loss),
        delay_s=_uniform(rng, wrong.delay_s),
        lag_s=_uniform(rng, wrong.lag_s),
        position_bias=tuple((x, y) for x, y in bias),
        failures=tuple(_draw_failures(wrong, set_up.robots, duration_s, rng)),
    )


def _integer(rng: np.random.Generator, least_most: Sequence[int]) -> int:
    least, most = least_most
    return int(rng.integers(least, most, endpoint=True))


def _uniform(rng: np.random.Generator, least_most: Sequence[float]) -> float:
    least, most = least_most
    return float(rng.uniform(least, most))


def _draw_failures(
    wrong: Disturbances, robots: int, duration_s: float, rng: np.random.Generator
) -> Iterator[Failure]:
    lost = min(_integer(rng, wrong.lost_robots), robots - 1)
    for robot in rng.permutation(robots)[:lost].tolist():
        from_s, until_s = sorted(rng.uniform(0.0, duration_s, 2).tolist())
        comes_back = rng.random() < wrong.come_back
        yield Failure(robot, from_s, until_s) if comes_back else Failure(robot, from_s)


class FlownShard(NamedTuple):
    """A shard's states and their CPU time."""

    name: str
    states: States
    cpu_s: float


def fly_shard(task: ShardTask) -> FlownShard:
    """Fly a shard, in any process. Raises BundleError, ValueError."""
    shard, bundle, taught = task
    begun_s = time.process_time()
    deciding = _MixedAgents(shard.by_expert)
    flights = BatchedFlights(shard.scenarios, bundle, agents=deciding.of)
    experts = [taught.teacher(shard.data, world) for world in flights.prepared]
    deciding.watch(flights, experts)
    looks_s = np.arange(0.0, max(shard.times_s), LOOK_PERIOD_S).tolist()
    times_s = sorted({*shard.times_s, *looks_s})
    kept = _StateBuffer()
    try:
        for moments in flights.moments(times_s):
            for moment, expert in zip(moments, experts, strict=True):
                expert.look(moment.positions, moment.alive)
                if moment.time_s in shard.times_s:
                    kept.add(moment, expert)
        flights.finish()
    except PolicyFailedError as error:
        raise ValueError(f"shard {shard.name}: {error}") from None
    states = kept.states(max(swarm.largest_payload for swarm in flights.swarms))
    return FlownShard(shard.name, states, time.process_time() - begun_s)


class _MixedAgents:
    """See `Agents`: the expert decides in some worlds, and sends payloads of zeros."""

    def __init__(self, by_expert: Sequence[bool]) -> None:
        self._by_expert = by_expert
        self._world_of: list[int] = []
        self._robot_of: list[int] = []

    def of(self, bundle: Bundle, perceptions: Sequence[PerceptionParameters]) -> Agents:
        """Use this bundle's policy in the other worlds; returns self."""
        self._policy = make_agents(bundle, perceptions)
        return self

    def watch(self, flights: BatchedFlights, experts: Sequence[Teacher]) -> None:
        """Set the flights and their experts, before the first step."""
        self._flights = flights
        self._experts = experts
        for world, prepared in enumerate(flights.prepared):
            self._world_of += [world] * prepared.scenario.robots
            self._robot_of += range(prepared.scenario.robots)

    @property
    def message_size(self) -> int:
        return self._policy.message_size

    def inputs(self, robot: int, observation: Observation) -> Inputs:
        return self._policy.inputs(robot, observation)

    def features(self, robots: Sequence[int], inputs: Sequence[Inputs]) -> list[F32]:
        deciding = self._by_policy(robots)
        found = [np.zeros(0, np.float32)] * len(robots)
        if deciding:
            computed = self._policy.features(
                [robots[i] for i in deciding], [inputs[i] for i in deciding]
            )
            for i, features in zip(deciding, computed, strict=True):
                found[i] = features
        return found

    def step(
        self,
        robots: Sequence[int],
        features: Sequence[F32],
        neighbours: Sequence[Neighbourhood],
    ) -> PolicySteps:
        velocities = np.zeros((len(robots), 2), np.float32)
        payloads_out = np.zeros((len(robots), self.message_size), np.float32)
        deciding = self._by_policy(robots)
        if deciding:
            steps = self._policy.step(
                [robots[i] for i in deciding],
                [features[i] for i in deciding],
                [neighbours[i] for i in deciding],
            )
            velocities[deciding], payloads_out[deciding] = steps
        by_expert: dict[int, list[int]] = {}
        for i, agent in enumerate(robots):
            if self._by_expert[self._world_of[agent]]:
                by_expert.setdefault(self._world_of[agent], []).append(i)
        for world, own in by_expert.items():
            velocities[own] = self._imitated(world, [self._robot_of[robots[i]] for i in own])
        return PolicySteps(velocities, payloads_out)

    def reset(self, robot: int) -> None:
        self._policy.reset(robot)

    def _by_policy(self, robots: Sequence[int]) -> list[int]:
        return [i for i, agent in enumerate(robots) if not self._by_expert[self._world_of[agent]]]

    def _imitated(self, world: int, robots: Sequence[int]) -> F64:
        """The expert's velocities for these robots at the present positions."""
        swarm, scenario = self._flights.swarms[world], self._flights.prepared[world].scenario
        return self._experts[world].velocities(
            scenario.scale.position_to_model(swarm.positions_m()),
            swarm.alive,
            robots,
            scenario.scale.velocity_to_model(swarm.velocities_m_s()),
        )


class _StateBuffer:
    """Collects states."""

    def __init__(self) -> None:
        self._inputs: list[Inputs] = []
        self._velocities: list[F64] = []
        self._robots: list[int] = []
        self._adjacency: list[Bools] = []

    def add(self, moment: BatchMoment, expert: Teacher) -> None:
        robots, arrays = moment.inputs()
        if not robots:
            return
        left = list(robots)
        self._inputs.append(arrays)
        self._velocities.append(
            expert.velocities(moment.positions, moment.alive, left, moment.velocities)
        )
        self._robots.append(len(left))
        self._adjacency.append(moment.adjacency[np.ix_(left, left)].ravel())

    def states(self, largest_payload: float) -> States:
        names = self._inputs[0] if self._inputs else {}
        return States(
            inputs={name: _stored([each[name] for each in self._inputs]) for name in names},
            velocities=np.concatenate(self._velocities).astype(np.float32),
            robots=np.array(self._robots, np.int32),
            adjacency=np.concatenate(self._adjacency),
            largest_payload=largest_payload,
        )


def _stored(arrays: Sequence[F32]) -> npt.NDArray[np.floating]:
    """Concatenate to (R, ...); images, of more than one dimension, become float16."""
    rows = np.concatenate(arrays)
    return rows.astype(np.float16) if rows.ndim > 2 else rows
