"""Agents of simulated robots."""

import numpy as np

from edge.core import F32
from edge.policy.family import Neighbourhood, Observation
from edge.policy.lpac.policy import LpacPolicy
from lpac.sim.fleet.agents import DeferredAgent


def test_who_looks_late_decides_as_who_looks_at_once(shipped_policy: LpacPolicy) -> None:
    rng = np.random.default_rng(5)
    perception = shipped_policy.manifest.perception
    assert perception is not None
    # As a robot's memory, which uses one array again and again.
    size, side = perception.world_size, perception.local_map_size
    local_map: F32 = np.empty((side, side), np.float32)
    agent, deferred = shipped_policy.agent(), DeferredAgent(shipped_policy)
    for _ in range(3):
        for _ in range(2):
            local_map[:] = rng.random(local_map.shape)
            position, neighbours = size * rng.random(2), size * rng.random((2, 2))
            observation = Observation(position, local_map, neighbours, np.zeros(2))
            seen, unseen = agent.observe(observation), deferred.observe(observation)
        neighbour = Neighbourhood(
            robot_ids=(2,),
            payloads=[rng.random(shipped_policy.message_size).astype(np.float32)],
            positions=np.zeros((1, 2), np.float32),
            velocities=np.zeros((1, 2), np.float32),
            ages_s=np.zeros(1, np.float32),
            degree=1,
        )
        for _ in range(2):
            step = agent.step(seen.features, neighbour)
            late = deferred.step(unseen.features, neighbour)
            np.testing.assert_array_equal(late.velocity, step.velocity)
            np.testing.assert_array_equal(late.payload, step.payload)
