"""Simulation of one flight of point robots."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from edge.core import F32, F64, Bools
from edge.core.perception import PerceptionParameters
from edge.core.ports import OdometrySource
from edge.core.world import Feature, rasterize
from edge.drivers.registry import load_policy
from edge.drivers.world_sensor import WorldSensor
from edge.policy.bundle import Bundle
from edge.robot.pac import PacParameters
from lpac.analysis.coverage import Coverage
from lpac.analysis.flight import FlightRecord, RobotRecord
from lpac.analysis.logs import LoopRates
from lpac.sim.baselines import BaselineSwarm, make_baseline
from lpac.sim.failure import alive_at
from lpac.sim.medium import Medium
from lpac.sim.scenario import Scenario
from lpac.sim.swarm import AnyRobot, ClockedPac, Swarm
from lpac.sim.vehicles import PointVehicles

SAMPLE_S = 0.2
SAMPLES_PER_COST = 5


@dataclass(frozen=True, slots=True, eq=False)
class Preparation:
    """Initial state of a simulator: a scenario together with a bundle.

    `bundle` has the scenario's own sizes in its manifest. `starts_m` (N, 2) and `bias_m` (N, 2) or
    None are in the mission frame, m, `importance` is (world_size, world_size), `times_s` are the
    sample times. Random draws in flight come from `clock_rng` and from `medium`.
    """

    scenario: Scenario
    bundle: Bundle
    perception: PerceptionParameters
    parameters: PacParameters
    features: tuple[Feature, ...]
    importance: F32
    starts_m: F64
    bias_m: F64 | None
    times_s: list[float]
    clock_rng: np.random.Generator
    medium: Medium

    def vehicles(self) -> PointVehicles:
        """The vehicles at their starts."""
        scenario = self.scenario
        side_m = self.perception.world_size / scenario.scale.env_scale
        return PointVehicles(self.starts_m, side_m, scenario.lag_s)

    def swarm(self, boot: Callable[[int, int, OdometrySource], AnyRobot]) -> Swarm[AnyRobot]:
        """The robots at their starts; see `Swarm`."""
        return Swarm(
            boot=boot,
            vehicles=self.vehicles(),
            medium=self.medium,
            rng=self.clock_rng,
            clocks=self.scenario.clocks,
            failures=self.scenario.failures,
            bias_m=self.bias_m,
        )

    def until(self, time_s: float) -> "Preparation":
        """This preparation, cut to end with that sample. Raises ValueError at time 0."""
        if time_s <= 0.0:
            raise ValueError("the flight was stopped at its start: nothing was flown")
        return replace(
            self,
            scenario=replace(self.scenario, duration_s=time_s),
            times_s=[each for each in self.times_s if each <= time_s],
        )

    def record(
        self, positions_m: F64, message_counts: dict[str, int], largest_payload: float
    ) -> FlightRecord:
        """Record of the flight with true positions (T, N, 2) at `times_s`.

        Points are in the air at every sample, unless they failed.
        """
        scenario, time_s = self.scenario, np.array(self.times_s)
        heights_m = np.zeros(len(time_s))
        alive = np.array([alive_at(scenario.robots, scenario.failures, t) for t in self.times_s])
        return FlightRecord(
            name=scenario.controller,
            duration_s=scenario.duration_s,
            from_s=0.0,
            to_s=scenario.duration_s,
            robots=tuple(
                RobotRecord(
                    robot_id=robot,
                    name=str(robot),
                    time_s=time_s,
                    position_m=np.column_stack([positions_m[:, robot], heights_m]),
                    flying=alive[:, robot],
                )
                for robot in range(scenario.robots)
            ),
            coverage=Coverage(self.importance, scenario.scale.env_scale),
            sensor_size=self.perception.sensor_size,
            cost_time_s=cost_times_s(scenario.duration_s),
            rates=LoopRates(1.0 / scenario.clocks.perception_s, 1.0 / scenario.clocks.policy_s),
            bundle_id=self.bundle.id,
            features=self.features,
            message_counts=message_counts,
            largest_payload=largest_payload,
        )


def prepare(scenario: Scenario, bundle: Bundle) -> Preparation:
    """Draw all initial random values of `scenario`.

    Raises BundleError for a bundle without perception, ValueError for invalid sizes and link
    parameters.
    """
    require_points(scenario)
    scale, training = scenario.scale, bundle.manifest.training
    perception = scenario.perception_of(bundle)
    bundle = replace(bundle, manifest=replace(bundle.manifest, perception=perception))
    # The first of the four is the world's.
    seeds = np.random.SeedSequence(scenario.seed).spawn(4)[1:]
    start_rng, clock_rng, medium_rng = (np.random.default_rng(seed) for seed in seeds)
    features = scenario.draw_features(perception.world_size)
    max_speed_m_s = scenario.max_speed_m_s
    if max_speed_m_s is None:
        max_speed_m_s = training.max_speed * scale.velocity_scale
    link = scenario.link
    return Preparation(
        scenario=scenario,
        bundle=bundle,
        perception=perception,
        parameters=PacParameters(
            scale=scale,
            max_speed_m_s=max_speed_m_s,
            max_message_age_s=scenario.max_message_age_s,
            max_input_age_s=scenario.input_age_s,
            payload=scenario.payload,
        ),
        features=features,
        importance=rasterize(
            features, perception.world_size, training.idf_truncation, training.idf_norm
        ),
        starts_m=_starts_m(scenario, perception.world_size, start_rng),
        bias_m=_bias_m(scenario),
        times_s=_sample_times_s(scenario.duration_s),
        clock_rng=clock_rng,
        medium=Medium(
            range_m=perception.communication_range / scale.env_scale,
            loss=link.loss,
            delay_s=link.delay_s,
            rng=medium_rng,
        ),
    )


def require_points(scenario: Scenario) -> None:
    """Raise ValueError that names a field points do not support."""
    scenario.require_default(
        "points", "errors", "wind_m_s", "budget", "sensor", "secure", "transport", "fault"
    )


class FlyingSwarm(Protocol):
    """State of the robots in flight."""

    def positions_m(self) -> F64: ...
    def velocities_m_s(self) -> F64: ...
    def received(self, now_s: float) -> Bools: ...
    @property
    def alive(self) -> Bools: ...


class WorldMoment:
    """One world at one time of a flight; valid until the flight goes on.

    `positions_m` (N, 2) are the true ones in the mission frame. Properties are computed on access,
    and reading them does not affect the flight.
    """

    def __init__(self, prepared: Preparation, swarm: FlyingSwarm, time_s: float) -> None:
        self.prepared = prepared
        self.time_s = time_s
        self._flying = swarm
        self.positions_m = swarm.positions_m()

    @property
    def positions(self) -> F64:
        """(N, 2): true positions in model units."""
        return self.prepared.scenario.scale.position_to_model(self.positions_m)

    @property
    def velocities_m_s(self) -> F64:
        """(N, 2): commanded velocities, mission frame, m/s.

        Vehicles follow them with the scenario's `lag_s`, and stop at the world's border.
        """
        return self._flying.velocities_m_s()

    @property
    def velocities(self) -> F64:
        """(N, 2): the same in model units/s."""
        return self.prepared.scenario.scale.velocity_to_model(self.velocities_m_s)

    @property
    def alive(self) -> Bools:
        """(N,): whether each robot is alive."""
        return self._flying.alive

    @property
    def adjacency(self) -> Bools:
        """(N, N): whether two robots, both alive, are truly in range; False on the diagonal."""
        x, y = self.positions.T
        distances = np.hypot(x[:, None] - x, y[:, None] - y)
        np.fill_diagonal(distances, np.inf)
        near: Bools = distances < self.prepared.perception.communication_range
        return near & np.logical_and.outer(self.alive, self.alive)

    @property
    def received(self) -> Bools:
        """(N, N), [receiver, sender]: whether a robot holds a fresh message of another.

        All False for baselines, which use no messages.
        """
        return self._flying.received(self.time_s)

    @property
    def cost(self) -> float:
        """The coverage cost J of the robots alive, model units; NaN if there are none.

        At a flight's `cost_time_s` it equals the record's `cost`.
        """
        scenario, alive = self.prepared.scenario, self.alive
        if not alive.any():
            return math.nan
        coverage = Coverage(self.prepared.importance, scenario.scale.env_scale)
        return coverage.cost(self.positions_m[alive])


class FlightMoment(WorldMoment):
    """A moment of a flight of points, for its watcher."""

    step = "mission"
    stopped = False

    def stop(self) -> None:
        """End the flight now; its duration becomes the time flown."""
        self.stopped = True


Watch = Callable[[FlightMoment], object]


def fly_points(scenario: Scenario, bundle: Bundle, watch: Watch | None = None) -> FlightRecord:
    """Simulate `scenario`; `bundle` flies it, or gives a baseline the sizes of its perception.

    `watch` is called at each sample, every `SAMPLE_S` from 0 to the end, and may stop the flight.
    Its return value is ignored; its exceptions propagate. The flight is bit for bit the same as
    without it. Raises BundleError for a bundle without perception, ValueError for invalid link
    parameters, and for a flight that is stopped at its start.
    """
    if not isinstance(bundle, Bundle):
        raise ValueError(f"{bundle}: is no loaded bundle: load it with load_bundle")
    prepared = prepare(scenario, bundle)
    swarm: Swarm[ClockedPac] | BaselineSwarm
    if scenario.controller == "lpac":
        swarm = prepared.swarm(_boot_of(prepared))
    else:
        perception, importance = prepared.perception, prepared.importance
        swarm = BaselineSwarm(
            make_baseline(scenario.controller, importance, perception, scenario.robots),
            prepared.vehicles(),
            scenario.scale,
            prepared.parameters.max_speed_m_s,
            prepared.bias_m,
            perception.world_size,
        )
    times_s = prepared.times_s
    positions = []
    for time_s, positions_m in zip(times_s, swarm.run(times_s), strict=True):
        positions.append(positions_m)
        if watch is None:
            continue
        moment = FlightMoment(prepared, swarm, time_s)
        watch(moment)
        if moment.stopped:
            prepared = prepared.until(time_s)
            break
    return prepared.record(np.array(positions), swarm.message_counts(), swarm.largest_payload)


def _boot_of(prepared: Preparation) -> Callable[[int, int, OdometrySource], ClockedPac]:
    """A `boot` for `Swarm` that makes robots of the real robot code."""
    policy = load_policy(prepared.bundle)
    sensor = WorldSensor(prepared.importance, prepared.perception.sensor_size)

    def boot(robot: int, start: int, odometry: OdometrySource) -> ClockedPac:
        return ClockedPac(
            start=start,
            robot_id=robot,
            policy=policy,
            sensor=sensor,
            odometry=odometry,
            parameters=prepared.parameters,
        )

    return boot


def cost_times_s(duration_s: float) -> F64:
    """(C,): times at which a flight's cost is computed: each second, and at its end."""
    time_s = _sample_times_s(duration_s)
    return np.array([*time_s[:-1:SAMPLES_PER_COST], time_s[-1]])


def _sample_times_s(duration_s: float) -> list[float]:
    """Every SAMPLE_S from 0, and the end."""
    samples = math.ceil(duration_s / SAMPLE_S - 1e-9)
    return [*(sample * SAMPLE_S for sample in range(samples)), duration_s]


def _bias_m(scenario: Scenario) -> F64 | None:
    """(robots, 2): position errors, m; None without any."""
    bias_m: F64 | None = None
    if scenario.position_bias is not None:
        bias = np.array(scenario.position_bias, np.float64)
        bias_m = scenario.scale.position_to_mission_m(bias)
    if scenario.position_error_m:
        rng, size = np.random.default_rng(scenario.seed), (scenario.robots, 2)
        error_m = rng.normal(0.0, scenario.position_error_m, size)
        bias_m = error_m if bias_m is None else error_m + bias_m
    return bias_m


def _starts_m(scenario: Scenario, world_size: int, rng: np.random.Generator) -> F64:
    if scenario.starts_m is not None:
        return np.array(scenario.starts_m)
    return scenario.scale.position_to_mission_m(rng.uniform(0.0, world_size, (scenario.robots, 2)))
