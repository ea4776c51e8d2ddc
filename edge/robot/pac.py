"""One robot's perception, action and communication, as steps without a clock of their own.

Paper: "A Scalable Multi-Robot Framework for Decentralized and Asynchronous
Perception-Action-Communication Loops". The robot calls these steps from threads, the simulator in
simulated time.
"""

import functools
import math
import zlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from edge.core import F32, F64, Bools
from edge.core.aggregation import AggregatedMessage
from edge.core.fleet_time import FleetClock
from edge.core.frames import ModelScale
from edge.core.memory import RobotMemory
from edge.core.part import PartError, array_problem, in_one_line
from edge.core.perception import clamp_to_world, neighbours_in_range
from edge.core.ports import Camera, Odometry, OdometrySource, Sensor
from edge.core.schema import Bounded, NonNegative, Positive, require
from edge.core.shared_map import SharedMap
from edge.core.wire import PayloadType, Rejection, decode, encode, most_bytes
from edge.flight.safety import limit_speed
from edge.identity.envelope import OVERHEAD_BYTES
from edge.messages.beacon import BEACON_BYTES, Beacon, tag
from edge.messages.bounds import RobotId
from edge.policy.bundle import BundleError
from edge.policy.family import (
    Neighbourhood,
    Observation,
    Perceived,
    Policy,
    PolicyStep,
    perceived_problem,
    step_problem,
)
from edge.robot.neighbours import NeighbourTable, Number, ReceivedMessage

_Array = TypeVar("_Array", F32, F64)
Position = tuple[float, float, float]  # in the mission frame, m


@dataclass(frozen=True, slots=True)
class PacParameters(Bounded):
    """The fleet's settings of the loop; ages in s, see `NeighbourTable` for `max_message_age_s`.

    Features older than `max_input_age_s` are not used, nor is an older action: the robot tolerates
    two missed ticks of the policy, then stops.
    """

    scale: ModelScale
    max_speed_m_s: Positive
    max_message_age_s: NonNegative = 0.8
    max_input_age_s: Positive = 1.0
    payload: PayloadType = "float16"


def message_bytes(policy: Policy, payload: PayloadType) -> tuple[int, int]:
    """Sizes of a robot's uncompressed message: without a map, and with one.

    Beacon and envelope are included. Most maps compress well.
    """
    perception = policy.manifest.perception
    side = perception.shared_map_side if perception else 0
    least, most = (most_bytes(policy.message_size, payload, cells) for cells in (0, side))
    around = OVERHEAD_BYTES + BEACON_BYTES
    return around + least, around + most


# In a simulator, the robots of one process decode the same bytes in turn.
@functools.lru_cache(maxsize=8)
def _decode(data: bytes, **own: Any) -> AggregatedMessage | Rejection:
    return decode(data, **own)


class _Timed(NamedTuple, Generic[_Array]):
    """An array that one thread replaces whole and another reads."""

    value: _Array
    time_s: float


class _OutgoingMap(NamedTuple):
    """Map for the neighbours, and its mission."""

    trial: int
    shared: SharedMap | None


@dataclass(frozen=True, slots=True, eq=False)
class PolicyTick:
    """Record of one `Pac.infer`.

    The inputs are `features`, the fields of a `Neighbourhood`, with `senders` for the robots' ids,
    and the `inputs` of the `PolicyStep`. The outputs are `velocity` (2,), in model units/s, and
    `message`, sent after a beacon.
    """

    features: F32
    senders: tuple[int, ...]
    payloads: Sequence[F32]
    positions: F32
    velocities: F32
    ages_s: F32
    degree: int
    inputs: Mapping[str, F32]
    velocity: F32
    message: bytes


class Pac:
    """The steps of one robot.

    Call `perceive` and `explored` from one thread, `infer` from one thread, the rest from any. They
    exchange immutable values by reference and never wait for each other.
    """

    def __init__(
        self,
        *,
        robot_id: int,
        policy: Policy,
        sensor: Sensor | Camera,
        odometry: OdometrySource,
        parameters: PacParameters,
    ) -> None:
        """Raise BundleError if no robot can fly the policy, ValueError for an impossible id."""
        require(RobotId, robot_id, "robot_id")
        manifest = policy.manifest
        if manifest.perception is None:
            raise BundleError(
                f"bundle {manifest.name!r} has no perception: it cannot drive a robot"
            )
        self._robot_id = robot_id
        self._bundle_tag = tag(policy.bundle_id.hex())
        self._policy = policy
        self._odometry = odometry
        self._parameters = parameters
        self._perception = manifest.perception
        self._decode = functools.partial(
            _decode,
            message_size=policy.message_size,
            payload_limit=manifest.payload_limit,
            shared_side=manifest.perception.shared_map_side,
        )
        self._memory = RobotMemory(manifest.perception)
        self._agent = policy.agent()
        # Requests from any thread to the thread of the memory or of the agent.
        self._forget_map = False
        self._reset_agent = False
        # The present mission, and the map's: maps of another mission are not merged.
        self._trial = self._map_trial = 0
        # Replaced whole, before the features, so that no message is sent without a map.
        self._outgoing_map = _OutgoingMap(0, None)
        self._features: _Timed[F32] | None = None
        # The result of `control`.
        self._action: _Timed[F64] | None = None
        self.clock = FleetClock()
        self.table = NeighbourTable(robot_id, parameters.max_message_age_s)
        self._sensor_problem = self._observe_problem = self._step_problem = ""
        # Replaced whole when the ground sets another origin or world, before a flight.
        self.frame_id = 0
        self.sensor = sensor

    def forget(self, trial: str = "") -> None:
        """Clear the explored map and the messages for the mission `trial`. Thread-safe.

        The last action stays until the policy's next tick, so that the robot need not stop.
        """
        self._trial = zlib.crc32(trial.encode())
        self._forget_map = True
        self._reset_agent = True
        self._features = None
        self.table.clear()

    def beacon(self, now_s: float) -> Beacon:
        """The beacon of a message sent now, with the fields known here."""
        odometry = self._finite_odometry()
        return Beacon(
            robot_id=self._robot_id,
            sent=self.clock.at(now_s),
            position_m=odometry and odometry.position_m,
            velocity_m_s=odometry and odometry.velocity_m_s,
            frame_id=self.frame_id,
            bundle_tag=self._bundle_tag,
        )

    def receive(
        self, beacon: Beacon, number: Number, data: bytes, now_s: float
    ) -> Rejection | None:
        """Receive another robot's message; returns, and counts, the reason to reject it.

        `data` follows the beacon; it is empty if the robot's policy is silent.
        """
        message: AggregatedMessage | Rejection | None
        if not data:
            message = None
        elif beacon.other_release:
            message = Rejection.OTHER_RELEASE
        elif beacon.bundle_tag != self._bundle_tag:
            message = Rejection.OTHER_BUNDLE
        elif beacon.frame_id != self.frame_id or beacon.position_m is None:
            message = Rejection.OTHER_FRAME
        else:
            message = self._decode(data)
        return self.table.receive(beacon, number, message, now_s, self.age_s(beacon, now_s))

    def age_s(self, beacon: Beacon, now_s: float) -> float | None:
        """Greatest possible age of a beacon, s; None if unknown."""
        age = None if beacon.sent is None else self.clock.age_s(beacon.sent, now_s)
        return None if age is None else age.most_s

    def perceive(self, now_s: float) -> Perceived | None:
        """Sensor view -> robot map -> the policy's features.

        None without a position, a valid view, or valid features. Raises PartError if sensor or
        policy raise anything.
        """
        if self._forget_map:
            self._forget_map = False
            self._memory = RobotMemory(self._perception)
            self._map_trial = self._trial
        odometry = self._finite_odometry()
        if odometry is None:
            return None
        (own,) = self._to_model([odometry.position_m])
        looked = self._look(own, odometry.position_m[2])
        if looked is None:
            return None
        view, seen = looked
        self._memory.observe(own, view, seen)
        neighbours = self.table.neighbours(now_s)
        positions = self._to_model([_position_m(each) for each in neighbours])
        near = neighbours_in_range(own, positions, self._perception.communication_range)
        trial = self._map_trial
        for (_, message, _), is_near in zip(neighbours, near, strict=True):
            if is_near and message.shared is not None and message.trial == trial:
                self._memory.merge(message.shared)
        self._outgoing_map = _OutgoingMap(trial, self._memory.shared_map(own))
        # Training keeps robots in the world: outside it, the policy gets the nearest point inside.
        position = clamp_to_world(own, self._perception.world_size)
        velocity_m_s = np.array(odometry.velocity_m_s[:2], np.float64)
        velocity = self._parameters.scale.velocity_to_model(velocity_m_s)
        local_map = self._memory.local_map(position)
        perceived = self._observe(Observation(position, local_map, positions[near], velocity))
        if perceived is None:
            return None
        self._features = _Timed(perceived.features, now_s)
        return perceived

    def explored(self) -> Bools:
        """Explored map for `mission.explored_to_bytes`; valid until the next `perceive`."""
        return self._memory.explored

    def infer(self, now_s: float, *, on_ground: bool = False) -> PolicyTick | None:
        """Neighbours' messages and x_i -> action and the message Y_i for the neighbours.

        None without fresh features, a position, or a valid `PolicyStep`. Then, or if this raises,
        the last action grows old and `control` stops the robot. Raises PartError if the policy
        raises anything.

        `on_ground`: the message is as large as in flight, to test the radio.
        """
        features, odometry = self._features, self._finite_odometry()
        if features is None or odometry is None or self._is_old(features, now_s):
            return None
        (own,) = self._to_model([odometry.position_m])
        # Before the swap, which may remove messages: not all neighbours have sent a new one.
        kept = self.table.neighbours(now_s)
        received = self.table.swap(now_s)
        positions = self._to_model([_position_m(each) for each in (*received, *kept)])
        near = neighbours_in_range(own, positions, self._perception.communication_range)
        near, kept_near = near[: len(received)], near[len(received) :]
        used = [each for each, is_near in zip(received, near, strict=True) if is_near]
        neighbours = neighbourhood(
            used,
            positions[: len(received)][near] - own,
            self._parameters.scale,
            now_s,
            degree=max(int(kept_near.sum()), int(near.sum())),
        )
        step = self._step(features.value, neighbours)
        if step is None:
            return None
        velocity, payload, inputs = step
        velocity_m_s = self._parameters.scale.velocity_to_mission_m_s(velocity.astype(np.float64))
        self._action = _Timed(limit_speed(velocity_m_s, self._parameters.max_speed_m_s), now_s)
        message = AggregatedMessage(payload, *self._outgoing_map)
        return PolicyTick(
            features=features.value,
            senders=neighbours.robot_ids,
            payloads=neighbours.payloads,
            positions=neighbours.positions,
            velocities=neighbours.velocities,
            ages_s=neighbours.ages_s,
            degree=neighbours.degree,
            inputs=inputs,
            velocity=velocity,
            message=encode(message, self._parameters.payload, as_in_flight=on_ground),
        )

    def control(self, now_s: float) -> F64 | None:
        """The action: velocity (2,) in the mission frame, m/s, within the speed limit.

        None without a fresh action.
        """
        action = self._action
        return None if action is None or self._is_old(action, now_s) else action.value

    @property
    def problem(self) -> str:
        """Describe the fault of the sensor's, or the policy's, last result; "" if there is none."""
        of_sensor, of_policy = self._sensor_problem, self._observe_problem or self._step_problem
        if of_sensor:
            return f"sensor: {of_sensor}"
        return f"policy: {of_policy}" if of_policy else ""

    def try_sensor(self, position_m: Position) -> str:
        """Describe the fault of a sensor reading at a position; "" if there is none.

        For `lpac robot check`, without a concurrent `perceive`.
        """
        (own,) = self._to_model([position_m])
        with suppress(PartError):
            self._look(own, position_m[2])
        return self._sensor_problem

    def action_age_s(self, now_s: float) -> float | None:
        """Age of the policy's newest action, s; None without one."""
        action = self._action
        return None if action is None else now_s - action.time_s

    def feature_age_s(self, now_s: float) -> float | None:
        """Age of the newest features, s; None without any."""
        features = self._features
        return None if features is None else now_s - features.time_s

    def _finite_odometry(self) -> Odometry | None:
        odometry = self._odometry.odometry()
        if odometry is None:
            return None
        numbers = (*odometry.position_m, *odometry.velocity_m_s)
        return odometry if all(map(math.isfinite, numbers)) else None

    def _look(self, own: F64, height_m: float) -> tuple[F32, Bools | None] | None:
        """The sensor's view, and its seen cells (None: all); None without a valid view."""
        shown: tuple[F32, Bools | None] | None
        try:
            sensor = self.sensor
            # isinstance(sensor, Camera) takes many times as long.
            if hasattr(sensor, "look"):
                shown = sensor.look(own, height_m * self._parameters.scale.env_scale)
            else:
                view = sensor.view(own)
                shown = None if view is None else (view, None)
            view, seen = (None, None) if shown is None else shown
        except Exception as error:  # Sensors and policies may be third-party code.
            self._sensor_problem = in_one_line(error)
            raise self._raised("sensor", self._sensor_problem) from error
        if view is None:
            self._sensor_problem = "it shows nothing"
            return None
        # A cell that is not finite would stay in the map.
        problem = array_problem("view", view, (self._perception.sensor_size,) * 2)
        if seen is not None and not problem:
            problem = array_problem("seen", seen, view.shape)
            if not problem and seen.dtype != np.bool_:
                problem = f"seen is of type {seen.dtype}: must be bool"
        self._sensor_problem = problem
        return None if problem else (view, seen)

    def _observe(self, observation: Observation) -> Perceived | None:
        try:
            perceived = self._agent.observe(observation)
        except Exception as error:
            self._observe_problem = in_one_line(error)
            raise self._raised("policy", self._observe_problem) from error
        self._observe_problem = perceived_problem(perceived)
        return None if self._observe_problem else perceived

    def _step(self, features: F32, neighbours: Neighbourhood) -> PolicyStep | None:
        try:
            if self._reset_agent:
                self._reset_agent = False
                self._agent.reset()
            step = self._agent.step(features, neighbours)
        except Exception as error:
            self._step_problem = in_one_line(error)
            raise self._raised("policy", self._step_problem) from error
        self._step_problem = step_problem(step, self._policy.message_size)
        return None if self._step_problem else step

    def _raised(self, part: str, problem: str) -> PartError:
        return PartError(f"robot {self._robot_id}: {part}: {problem}")

    def _to_model(self, positions_m: Sequence[Position]) -> F64:
        """Horizontal positions (n, 2) in model units."""
        horizontal = np.array(positions_m, np.float64).reshape(-1, 3)[:, :2]
        return self._parameters.scale.position_to_model(horizontal)

    def _is_old(self, timed: _Timed[Any], now_s: float) -> bool:
        return now_s - timed.time_s > self._parameters.max_input_age_s


def neighbourhood(
    received: Sequence[ReceivedMessage],
    positions: F64,
    scale: ModelScale,
    now_s: float,
    degree: int,
) -> Neighbourhood:
    """The messages that a step uses, their senders' relative `positions` (n, 2), model units."""
    velocities_m_s = [each.beacon.velocity_m_s or (0.0, 0.0, 0.0) for each in received]
    horizontal = np.array(velocities_m_s, np.float64).reshape(-1, 3)[:, :2]
    return Neighbourhood(
        robot_ids=tuple(each.beacon.robot_id for each in received),
        payloads=tuple(each.message.payload for each in received),
        positions=positions.astype(np.float32),
        velocities=scale.velocity_to_model(horizontal).astype(np.float32),
        ages_s=np.array([now_s - each.sent_at_s for each in received], np.float32),
        degree=degree,
    )


def _position_m(received: ReceivedMessage) -> Position:
    position_m = received.beacon.position_m
    assert position_m is not None  # `Pac.receive` has rejected it otherwise.
    return position_m
