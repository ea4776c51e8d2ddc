"""Simulated flights over many worlds at once.

Each world runs until one of its robots needs a velocity that is not computed yet. When all worlds
wait, the pending policy steps are computed in batches. The order of events is that of
`lpac.sim.points.fly_points`, and the results are the same for the same seed.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from edge.core import F32, F64
from edge.core.perception import PerceptionParameters
from edge.core.ports import OdometrySource
from edge.policy.bundle import Bundle
from edge.robot.pac import PacParameters
from lpac.analysis.flight import FlightRecord
from lpac.sim.batch.agents import Agents, make_agents
from lpac.sim.batch.robot import BatchedRobot, DeferredSteps
from lpac.sim.batch.seen import ShownWorld
from lpac.sim.points import Preparation, WorldMoment, prepare
from lpac.sim.scenario import Scenario
from lpac.sim.swarm import Swarm


class PolicyInputs(NamedTuple):
    """Inputs of a world's robots: arrays (n, ...) by name, of the n robots of `robots`.

    They are of each robot's last perception, up to one perception period ago. Robots that failed,
    or whose perception is older than `max_input_age_s`, are left out.
    """

    robots: tuple[int, ...]
    arrays: Mapping[str, F32]


class BatchMoment(WorldMoment):
    """One world of a batch at one time; valid until the batch goes on."""

    def __init__(self, prepared: Preparation, swarm: Swarm[BatchedRobot], time_s: float) -> None:
        super().__init__(prepared, swarm, time_s)
        self._swarm = swarm

    def inputs(self) -> PolicyInputs:
        """See `PolicyInputs`. Reading them does not affect the flight."""
        alive = self.alive
        found = {
            i: inputs
            for i, robot in enumerate(self._swarm.robots)
            if alive[i] and (inputs := robot.inputs(self.time_s)) is not None
        }
        each = list(found.values())
        arrays = (
            {name: np.stack([inputs[name] for inputs in each]) for name in each[0]} if each else {}
        )
        return PolicyInputs(tuple(found), arrays)


class BatchedFlights:
    """Flights of one bundle in several worlds, which may differ in everything else."""

    def __init__(
        self,
        scenarios: Sequence[Scenario],
        bundle: Bundle,
        agents: Callable[[Bundle, Sequence[PerceptionParameters]], Agents] = make_agents,
    ) -> None:
        """`agents` makes the policies of all robots of all worlds in their order.

        Raises BundleError and ConfigError as `load_policy`; ValueError, also for a baseline.
        """
        for scenario in scenarios:
            if scenario.controller != "lpac":
                raise ValueError(f"controller = {scenario.controller!r}: must be 'lpac' in batches")
        self.prepared = tuple(prepare(scenario, bundle) for scenario in scenarios)
        perceptions = [
            world.perception for world in self.prepared for _ in range(world.scenario.robots)
        ]
        self._deferred = DeferredSteps(agents(bundle, perceptions), bundle.manifest.payload_limit)
        firsts = np.cumsum([0, *(scenario.robots for scenario in scenarios)]).tolist()
        self.swarms = tuple(
            self._swarm(world, first)
            for world, first in zip(self.prepared, firsts[:-1], strict=True)
        )

    def advance(self, until_s: Sequence[float]) -> None:
        """Advance each world to its time. Raises PolicyFailedError."""
        running = [
            swarm.advance(time_s) for swarm, time_s in zip(self.swarms, until_s, strict=True)
        ]
        while running:
            running = [world for world in running if next(world, "arrived") is None]
            if running:
                self._deferred.compute()

    def moments(self, times_s: Sequence[float]) -> Iterator[tuple[BatchMoment, ...]]:
        """All worlds at each of `times_s`, which ascend. Raises PolicyFailedError."""
        for time_s in times_s:
            self.advance([time_s] * len(self.swarms))
            yield tuple(
                BatchMoment(world, swarm, time_s)
                for world, swarm in zip(self.prepared, self.swarms, strict=True)
            )

    def finish(self) -> None:
        """Compute the pending steps, so that `largest_payload` is complete."""
        self._deferred.compute()

    def _swarm(self, world: Preparation, first_agent: int) -> Swarm[BatchedRobot]:
        shown = ShownWorld(world.importance, world.perception)
        local_map = np.empty((world.perception.local_map_size,) * 2, np.float32)
        return world.swarm(partial(self._boot, world.parameters, shown, local_map, first_agent))

    def _boot(
        self,
        parameters: PacParameters,
        world: ShownWorld,
        local_map: F32,
        first_agent: int,
        robot: int,
        start: int,
        odometry: OdometrySource,
    ) -> BatchedRobot:
        agent = first_agent + robot
        if start > 1:
            # Steps pending from before the restart need the agent's old memory.
            self._deferred.compute()
            self._deferred.agents.reset(agent)
        return BatchedRobot(
            robot_id=robot,
            start=start,
            agent=agent,
            deferred=self._deferred,
            world=world,
            odometry=odometry,
            parameters=parameters,
            local_map=local_map,
        )


def fly_batch(scenarios: Sequence[Scenario], bundle: Bundle) -> list[FlightRecord]:
    """Simulate `scenarios`, all with `bundle`: the batched equivalent of
    `lpac.sim.points.fly_points`.

    Raises BundleError and ConfigError for a bundle that cannot fly, ValueError for invalid
    scenarios and for baselines, PolicyFailedError for policy outputs that robots refuse.
    """
    flights = BatchedFlights(scenarios, bundle)
    times_s = [world.times_s for world in flights.prepared]
    positions_m: list[list[F64]] = [[] for _ in scenarios]
    for sample in range(max(map(len, times_s), default=0)):
        flights.advance([times[min(sample, len(times) - 1)] for times in times_s])
        for swarm, times, flown_m in zip(flights.swarms, times_s, positions_m, strict=True):
            if sample < len(times):
                flown_m.append(swarm.positions_m())
    flights.finish()
    return [
        world.record(np.array(flown_m), swarm.message_counts(), swarm.largest_payload)
        for world, swarm, flown_m in zip(flights.prepared, flights.swarms, positions_m, strict=True)
    ]
