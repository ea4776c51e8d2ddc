"""One robot's steps, as `edge.robot.pac.Pac` has them, without its policy's computations.

The inputs of a policy tick (positions, received messages) are known at once; its outputs, a
velocity and a payload, are not needed before the robot's next control tick. So a tick leaves a
`DeferredStep`, which `DeferredSteps` computes later in a batch.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from edge.core import F32, F64, Bools
from edge.core.aggregation import AggregatedMessage
from edge.core.fleet_time import FleetClock, FleetTime
from edge.core.perception import clamp_to_world, neighbours_in_range
from edge.core.ports import Odometry, OdometrySource
from edge.core.shared_map import SharedMap
from edge.core.wire import PayloadType, rounded
from edge.flight.safety import limit_speed
from edge.messages.beacon import Beacon
from edge.policy.family import Neighbourhood, Observation
from edge.robot.neighbours import NeighbourTable, Number
from edge.robot.pac import PacParameters, neighbourhood
from lpac.sim.batch.agents import Agents, Inputs, PolicyFailedError
from lpac.sim.batch.seen import SeenMap, ShownWorld


def _age_error_s() -> float:
    """Error of a message's age where all robots share one clock, s."""
    clock = FleetClock()
    clock.update(1, 0.0, echoed_at_s=0.0, held_s=0.0, now_s=0.0)
    now = clock.at(0.0)
    age = clock.age_s(now, 0.0) if now else None
    assert age is not None
    return age.most_s


_AGE_ERROR_S = _age_error_s()


@dataclass(slots=True, eq=False)
class DeferredFeatures:
    """An agent's inputs from one perception; `values` are its features, once computed."""

    agent: int
    inputs: Inputs
    values: F32 = field(init=False)


@dataclass(slots=True, eq=False)
class DeferredStep:
    """A tick of a robot's policy: its inputs, and its outputs once computed.

    Ticks between two perceptions share `features`. `used` are the neighbours' ticks, whose
    payloads are those of `neighbours`. `rank` is the length of the longest chain of steps to
    compute before it. Before it is computed, `velocity` (2,) is None and `payload`
    (message_size,), as neighbours receive it, is undefined; `largest` is the payload's largest
    absolute value.
    """

    robot: "BatchedRobot"
    features: DeferredFeatures
    used: "tuple[DeferredStep, ...]"
    neighbours: Neighbourhood
    rank: int
    payload: F32
    velocity: F32 | None = None
    largest: float = 0.0


class DeferredSteps:
    """Pending steps of all robots of `agents`."""

    def __init__(self, agents: Agents, payload_limit: float | None) -> None:
        """`payload_limit` is that of the bundle's manifest."""
        self.agents = agents
        self._payload_limit = np.inf if payload_limit is None else payload_limit
        self._steps: list[DeferredStep] = []
        self._features: list[DeferredFeatures] = []

    def add_features(self, features: DeferredFeatures) -> None:
        """Add features, to be computed before the steps that use them."""
        self._features.append(features)

    def add(self, step: DeferredStep) -> None:
        """Add a pending step."""
        self._steps.append(step)

    def compute(self) -> None:
        """Compute all pending features and steps. Raises PolicyFailedError."""
        steps, self._steps = self._steps, []
        features, self._features = self._features, []
        if features:
            agents, inputs = [each.agent for each in features], [each.inputs for each in features]
            for each, values in zip(features, self.agents.features(agents, inputs), strict=True):
                each.values, each.inputs = values, {}
        ranked = defaultdict(list)
        for step in steps:
            ranked[step.rank].append(step)
        for _, group in sorted(ranked.items()):
            self._step(group)
        for step in steps:
            # Drop references, which would keep all earlier steps alive.
            step.used = ()

    def _step(self, steps: list[DeferredStep]) -> None:
        velocities, payloads = self.agents.step(
            [step.robot.agent for step in steps],
            [step.features.values for step in steps],
            [step.neighbours for step in steps],
        )
        received = np.empty_like(payloads)
        types = np.array([step.robot.payload for step in steps])
        for payload_type in set(types.tolist()):
            received[types == payload_type] = rounded(payloads[types == payload_type], payload_type)
        largest = np.abs(received).max(axis=1, initial=0.0)
        if not (np.isfinite(velocities).all() and (largest <= self._payload_limit).all()):
            raise PolicyFailedError(
                "a velocity or a payload of the policy is not finite, or beyond the bundle's "
                "payload_limit: fly without batches to see how the robots react"
            )
        for i, step in enumerate(steps):
            step.velocity = velocities[i]
            step.payload[:] = received[i]
            step.largest = float(largest[i])
            step.robot.note_payloads(step.used)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class _Deferred(AggregatedMessage):
    step: DeferredStep


class _Message(NamedTuple):
    beacon: Beacon
    number: Number
    message: _Deferred


class _Look(NamedTuple):
    """One perception: time, position (2,), positions of neighbours (n, 2), velocity, shared map.

    `velocity` (2,) is the robot's own, model units/s.
    """

    time_s: float
    own: F64
    neighbours: F64
    velocity: F64
    shared: SharedMap | None


class BatchedRobot:
    """The steps of one robot; see `Pac`."""

    def __init__(
        self,
        *,
        robot_id: int,
        start: int,
        agent: int,
        deferred: DeferredSteps,
        world: ShownWorld,
        odometry: OdometrySource,
        parameters: PacParameters,
        local_map: F32,
    ) -> None:
        """`agent` is its index among the agents of `deferred`.

        `local_map` (local_map_size, local_map_size) is a buffer that robots may share.
        """
        self.agent = agent
        self._robot_id = robot_id
        self._start = start
        self._deferred = deferred
        self._perception = world.parameters
        self._odometry = odometry
        self._parameters = parameters
        self._seen = SeenMap(world)
        self._local_map = local_map
        self._swap_clears = parameters.max_message_age_s == 0.0
        self._look: _Look | None = None
        # Features of the last look, once its policy has used them.
        self._features: DeferredFeatures | None = None
        self._action: DeferredStep | None = None
        self._action_s = 0.0
        # The last action that was flown, and its velocity in the mission frame.
        self._flown: tuple[DeferredStep, F64] | None = None
        self._sent = 0
        self.largest_payload = 0.0
        self.table = NeighbourTable(robot_id, parameters.max_message_age_s)

    @property
    def waits(self) -> bool:
        """Whether its policy's last step is still pending."""
        return self._action is not None and self._action.velocity is None

    @property
    def payload(self) -> PayloadType:
        """Number type of its messages' payloads."""
        return self._parameters.payload

    def perceive(self, now_s: float) -> None:
        """Observe the world and the neighbours."""
        odometry, own = self._own()
        self._seen.observe(own)
        neighbours = self.table.neighbours(now_s)
        beacons = [each.beacon for each in neighbours]
        near = self._in_range(own, beacons)
        for (_, message, _), is_near in zip(neighbours, near, strict=True):
            if is_near and message.shared is not None:
                self._seen.merge(message.shared)
        velocity_m_s = np.array(odometry.velocity_m_s[:2], np.float64)
        velocity = self._parameters.scale.velocity_to_model(velocity_m_s)
        self._look = _Look(
            now_s, own, self._to_model(beacons)[near], velocity, self._seen.shared_map(own)
        )
        self._features = None

    def inputs(self, now_s: float) -> Inputs | None:
        """The policy's inputs from its last perception; None if that is too old."""
        look = self._fresh_look(now_s)
        return None if look is None else self._inputs(look)

    def next_message(self, now_s: float) -> _Message | None:
        """Add a pending policy step, and return its message; None without a fresh perception."""
        look = self._fresh_look(now_s)
        if look is None:
            return None
        if self._features is None:
            self._features = DeferredFeatures(self.agent, self._inputs(look))
            self._deferred.add_features(self._features)
        odometry, own = self._own()
        # Read the neighbours before a swap that clears the table.
        kept = self.table.neighbours(now_s) if self._swap_clears else ()
        received = self.table.swap(now_s)
        positions = self._to_model([each.beacon for each in received])
        near = neighbours_in_range(own, positions, self._perception.communication_range)
        degree = int(near.sum())
        if kept:
            degree = max(degree, int(self._in_range(own, [each.beacon for each in kept]).sum()))
        used = [each for each, is_near in zip(received, near.tolist(), strict=True) if is_near]
        steps = tuple(message.step for _, message, _ in used if isinstance(message, _Deferred))
        scale = self._parameters.scale
        neighbours = neighbourhood(used, positions[near] - own, scale, now_s, degree)
        before = (*steps, self._action) if self._action else steps
        step = DeferredStep(
            self,
            self._features,
            steps,
            neighbours,
            max((other.rank + 1 for other in before if other.velocity is None), default=0),
            np.empty(self._deferred.agents.message_size, np.float32),
        )
        self._deferred.add(step)
        self._action, self._action_s = step, now_s
        self._sent += 1
        beacon = Beacon(
            robot_id=self._robot_id,
            sent=FleetTime(0, now_s, 0.0),
            position_m=odometry.position_m,
            velocity_m_s=odometry.velocity_m_s,
            frame_id=0,
            bundle_tag=0,
        )
        message = _Deferred(payload=step.payload, shared=look.shared, step=step)
        return _Message(beacon, (self._start, self._sent), message)

    def control(self, now_s: float) -> F64 | None:
        """The velocity (2,) in the mission frame, m/s; None when there is no fresh action."""
        action = self._action
        if action is None or now_s - self._action_s > self._parameters.max_input_age_s:
            return None
        if self._flown is None or self._flown[0] is not action:
            assert action.velocity is not None
            velocity_m_s = self._parameters.scale.velocity_to_mission_m_s(
                action.velocity.astype(np.float64)
            )
            self._flown = action, limit_speed(velocity_m_s, self._parameters.max_speed_m_s)
        return self._flown[1]

    def on_message(self, message: _Message, now_s: float) -> None:
        """Handle a neighbour's message."""
        sent = message.beacon.sent
        assert sent is not None
        self.table.receive(*message, now_s, now_s - sent.time_s + _AGE_ERROR_S)

    def note_payloads(self, used: tuple[DeferredStep, ...]) -> None:
        """Record the largest payload that its policy used."""
        self.largest_payload = max((self.largest_payload, *(each.largest for each in used)))

    def _fresh_look(self, now_s: float) -> _Look | None:
        look = self._look
        is_old = look is None or now_s - look.time_s > self._parameters.max_input_age_s
        return None if is_old else look

    def _inputs(self, look: _Look) -> Inputs:
        position = clamp_to_world(look.own, self._perception.world_size)
        local_map = self._seen.local_map(position, self._local_map)
        observation = Observation(position, local_map, look.neighbours, look.velocity)
        return self._deferred.agents.inputs(self.agent, observation)

    def _own(self) -> tuple[Odometry, F64]:
        odometry = self._odometry.odometry()
        assert odometry is not None
        return odometry, self._to_model([odometry])[0]

    def _in_range(self, own: F64, others: Sequence[Beacon]) -> Bools:
        return neighbours_in_range(
            own, self._to_model(others), self._perception.communication_range
        )

    def _to_model(self, known: Sequence[Odometry | Beacon]) -> F64:
        """Horizontal positions (n, 2) in model units."""
        horizontal = np.array(
            [each.position_m[:2] for each in known if each.position_m], np.float64
        ).reshape(-1, 2)
        return self._parameters.scale.position_to_model(horizontal)
