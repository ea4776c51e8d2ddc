"""A moment of a flight: common input of the benches of one robot's tick."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from edge.core import F32, F64
from edge.core.memory import RobotMap, RobotMemory
from edge.core.perception import PerceptionParameters, window_corner
from edge.core.world import rasterize
from edge.drivers.world_sensor import WorldSensor
from edge.policy.family import Neighbourhood, Observation, Policy
from lpac.analysis.worlds import random_features

NEIGHBOURS = 10
# Robots fly straight paths of this many views, and end within range of each other.
_VIEWS = 100


class Moment(NamedTuple):
    """Inputs of the tick of one robot with ten neighbours, all in range.

    Positions are in model units. `memory` is the robot's; `robot_map` (world_size, world_size) is
    the same as one array. `payloads` are the neighbours' newest.
    """

    position: F64
    neighbours: F64
    payloads: list[F32]
    memory: RobotMemory
    robot_map: F32


def moment_in_flight(policy: Policy) -> Moment:
    """A robot and its neighbours' payloads, after all have seen parts of a world."""
    perception = policy.manifest.perception
    assert perception
    rng = np.random.default_rng(1)
    size = perception.world_size
    importance = rasterize(random_features(rng, 10, size), size)
    starts = rng.uniform(0.0, size, (NEIGHBOURS + 1, 2))
    ends = size / 2.0 + rng.uniform(-0.3, 0.3, starts.shape) * perception.communication_range
    paths = np.linspace(starts, ends, _VIEWS, axis=1)
    memory, robot_map = _seen_on(paths[0], importance, perception)
    payloads = []
    for number, path in enumerate(paths[1:], 1):
        agent, theirs = policy.agent(), _seen_on(path, importance, perception)[0]
        others = np.delete(ends, number, axis=0)
        seen = agent.observe(Observation(path[-1], theirs.local_map(path[-1]), others, np.zeros(2)))
        nobody = Neighbourhood.silent(NEIGHBOURS)
        payloads.append(agent.step(seen.features, nobody).payload.copy())
    return Moment(ends[0], ends[1:], payloads, memory, robot_map)


def neighbourhood(position: F64, neighbours: F64, payloads: Sequence[F32]) -> Neighbourhood:
    """The first of the `neighbours` (n, 2) in range have sent `payloads`, standing still."""
    sent = len(payloads)
    return Neighbourhood(
        robot_ids=tuple(range(1, sent + 1)),
        payloads=payloads,
        positions=(neighbours[:sent] - position).astype(np.float32),
        velocities=np.zeros((sent, 2), np.float32),
        ages_s=np.zeros(sent, np.float32),
        degree=len(neighbours),
    )


def _seen_on(
    path: F64, importance: F32, parameters: PerceptionParameters
) -> tuple[RobotMemory, F32]:
    """Memory and map of a robot after a flight along `path` (T, 2)."""
    memory = RobotMemory(parameters)
    robot_map = RobotMap(parameters.world_size, parameters.unknown_importance)
    sensor = WorldSensor(importance, parameters.sensor_size)
    for position in path:
        view = sensor.view(position)
        memory.observe(position, view)
        robot_map.insert(view, window_corner(position, parameters.sensor_size))
    return memory, robot_map.window((0, 0), np.empty_like(importance))
