"""A moment of a simulated flight: the input of all measurements of one robot's tick."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edge.core import F32, F64
from edge.core.aggregation import AggregatedMessage
from edge.core.memory import RobotMap, RobotMemory
from edge.core.perception import neighbours_in_range, window_corner
from edge.core.world import random_features, rasterize
from edge.drivers.world_sensor import WorldSensor
from edge.policy.bundle import Manifest
from edge.policy.family import Policy
from edge.robot.pac import PacParameters
from lpac.sim.description import FIELD_SCALE
from lpac.sim.medium import Medium
from lpac.sim.swarm import pac_swarm
from lpac.sim.ticks import Clocks

NEIGHBOURS = 10
# So many that robots in the middle have ten neighbours.
_ROBOTS = 16
_EARLIEST_S, _LATEST_S, _SAMPLE_S = 10.0, 60.0, 0.2


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """One robot in flight with ten neighbours, and everything that its tick takes.

    Positions are in model units. `memory` is of what the robot has seen; `robot_map`
    (world_size, world_size) is the same as one array. `messages` are the neighbours' newest.
    """

    position: F64
    neighbours: F64
    messages: tuple[AggregatedMessage, ...]
    memory: RobotMemory
    robot_map: F32

    @property
    def payloads(self) -> list[F32]:
        """The neighbours' (message_size,) payloads, as the wire gives them."""
        return [message.payload for message in self.messages]


def moment_in_flight(policy: Policy) -> Moment:
    """The first moment after the start at which a robot has exactly ten neighbours."""
    manifest = policy.manifest
    perception = manifest.perception
    assert perception
    rng = np.random.default_rng(1)
    importance = rasterize(random_features(rng, 10, perception.world_size), perception.world_size)
    swarm = pac_swarm(
        policy=policy,
        importance=importance,
        positions_m=FIELD_SCALE.position_to_mission_m(
            rng.uniform(0.0, perception.world_size, (_ROBOTS, 2))
        ),
        parameters=PacParameters(
            scale=FIELD_SCALE,
            max_speed_m_s=manifest.training.max_speed * FIELD_SCALE.velocity_scale,
        ),
        medium=Medium(
            range_m=perception.communication_range / FIELD_SCALE.env_scale,
            loss=0.0,
            delay_s=0.0,
            rng=rng,
        ),
        rng=rng,
        clocks=Clocks(),
    )
    paths: list[F64] = []
    times_s = np.arange(0.0, _LATEST_S, _SAMPLE_S).tolist()
    for now_s, positions_m in zip(times_s, swarm.run(times_s), strict=True):
        positions = FIELD_SCALE.position_to_model(positions_m)
        paths.append(positions)
        for robot, position, path in zip(
            swarm.robots, positions, np.stack(paths, axis=1), strict=True
        ):
            messages = robot.mailbox.swap(now_s)
            neighbours = _positions(messages)
            near = neighbours_in_range(position, neighbours, perception.communication_range)
            if now_s >= _EARLIEST_S and len(messages) == near.sum() == NEIGHBOURS:
                memory, robot_map = _seen_on(path, importance, manifest)
                return Moment(position, neighbours, messages, memory, robot_map)
    raise AssertionError(f"no robot had {NEIGHBOURS} neighbours")


def _positions(messages: Sequence[AggregatedMessage]) -> F64:
    positions_m = np.array([message.position_m[:2] for message in messages]).reshape(-1, 2)
    return FIELD_SCALE.position_to_model(positions_m)


def _seen_on(path: F64, importance: F32, manifest: Manifest) -> tuple[RobotMemory, F32]:
    """Memory and map of a robot that flew along `path` (T, 2)."""
    parameters = manifest.perception
    assert parameters
    memory = RobotMemory(parameters)
    robot_map = RobotMap(parameters.world_size, parameters.unknown_importance)
    sensor = WorldSensor(importance, parameters.sensor_size)
    for position in path:
        view = sensor.view(position)
        memory.observe(position, view)
        robot_map.insert(view, window_corner(position, parameters.sensor_size))
    return memory, robot_map.window((0, 0), np.empty_like(importance))
