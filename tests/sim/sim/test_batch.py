"""The batched simulator, held to the exact one, which runs what a robot runs.

Both have one event loop, and the same operations on the same numbers; onnxruntime computes a row of
a batch as it computes it alone. So flights are equal to the last bit.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.core import F32
from edge.core.frames import ModelScale
from edge.core.memory import RobotMemory
from edge.core.perception import PerceptionParameters
from edge.core.shared_map import SharedMap
from edge.core.wire import PAYLOAD_TYPES
from edge.drivers.world_sensor import WorldSensor
from edge.policy.bundle import Bundle
from edge.policy.family import Perceived
from edge.policy.lpac.policy import LpacAgent
from lpac.analysis.flight import FlightRecord
from lpac.analysis.voronoi import coverage_cost
from lpac.radio.airtime import TRANSPORTS, Wifi
from lpac.radio.modelled import ModelledRadio
from lpac.sim.batch import BatchedFlights, PolicyFailedError, fly_batch
from lpac.sim.batch.agents import Inputs, LpacAgents, SingleAgents
from lpac.sim.batch.seen import SeenMap, ShownWorld
from lpac.sim.description import FIELD_SCALE
from lpac.sim.failure import Failure
from lpac.sim.points import fly_points
from lpac.sim.scenario import Scenario
from lpac.sim.swarm import ClockedPac
from lpac.sim.ticks import Clocks

# Ten robots of which some fail, one comes back, with all that may go wrong at once.
HARD = Scenario(
    seed=5,
    duration_s=6.0,
    loss=0.3,
    delay_s=0.15,
    failures=(Failure(2, 2.0), Failure(3, 1.0, until_s=3.5)),
    position_bias=((3.0, -4.0),) * 10,
    lag_s=1.0,
)
# A channel that is full with few robots.
SLOW = Wifi(data_rate_mbit_s=8.0, multicast_rate_mbit_s=1.0)


def assert_same(one: FlightRecord, other: FlightRecord) -> None:
    np.testing.assert_array_equal(one.positions_m, other.positions_m)
    np.testing.assert_array_equal(one.cost, other.cost)
    assert one.message_counts == other.message_counts
    assert (one.duration_s, one.bundle_id) == (other.duration_s, other.bundle_id)
    assert one.largest_payload == other.largest_payload


def unknown_matters(bundle: Bundle, importance: float = 0.2) -> Bundle:
    perception = bundle.manifest.perception
    assert perception is not None
    perception = dataclasses.replace(perception, unknown_importance=importance)
    return dataclasses.replace(
        bundle, manifest=dataclasses.replace(bundle.manifest, perception=perception)
    )


@st.composite
def scenarios(draw: st.DrawFn) -> Scenario:
    robots = draw(st.integers(1, 8))
    failing = draw(st.lists(st.integers(0, robots - 1), max_size=robots - 1, unique=True))
    duration_s = draw(st.floats(0.3, 3.0))
    failures = []
    for robot in failing:
        from_s = draw(st.floats(0.0, 2.0))
        lasts_s = draw(st.just(float("inf")) | st.floats(0.1, 2.0))
        failures.append(Failure(robot, from_s, from_s + lasts_s))
    offsets = st.floats(-30.0, 30.0)
    world_size = draw(st.integers(100, 700))
    radio = draw(st.none() | st.builds(ModelledRadio, st.sampled_from(TRANSPORTS), st.just(SLOW)))
    return Scenario(
        robots=robots,
        seed=draw(st.integers(0, 2**32)),
        duration_s=duration_s,
        random_feature_count=draw(st.integers(0, 5)),
        scale=draw(st.sampled_from([FIELD_SCALE, ModelScale(1.0, 1.0), ModelScale(8.0, 1.0)])),
        loss=0.0 if radio else draw(st.sampled_from([0.0, 0.3, 1.0])),
        delay_s=0.0 if radio else draw(st.sampled_from([0.0, 0.1, 0.7])),
        radio=radio,
        max_message_age_s=draw(st.sampled_from([0.0, 0.5, 0.8, 2.0])),
        max_input_age_s=draw(st.sampled_from([0.05, 1.0])),
        payload=draw(st.sampled_from(PAYLOAD_TYPES)),
        random_feature_sigma=(20.0, 80.0),
        world_size=world_size,
        communication_range=draw(st.floats(50.0, 400.0)),
        max_speed_m_s=draw(st.none() | st.floats(0.1, 3.0)),
        lag_s=draw(st.sampled_from([0.0, 0.05, 1.3])),
        position_bias=draw(
            st.none()
            | st.lists(st.tuples(offsets, offsets), min_size=robots, max_size=robots).map(tuple)
        ),
        failures=tuple(failures),
        clocks=draw(st.sampled_from([Clocks(), Clocks(0.5, 0.1, 0.3, 0.4)])),
    )


@settings(max_examples=12, deadline=None)
@given(st.lists(scenarios(), min_size=1, max_size=3), st.sampled_from([0.0, 0.3]))
def test_flights_are_those_of_the_exact_simulator(
    shipped_bundle: Bundle, flown: list[Scenario], unknown: float
) -> None:
    bundle = unknown_matters(shipped_bundle, unknown)
    for batched, scenario in zip(fly_batch(flown, bundle), flown, strict=True):
        assert_same(batched, fly_points(scenario, bundle))


@pytest.mark.parametrize("unknown", [0.0, 0.3])
@pytest.mark.parametrize("name", ["exploring_bundle", "sharing_bundle"])
def test_robots_that_see_what_they_explored_fly_the_same(
    request: pytest.FixtureRequest, name: str, unknown: float
) -> None:
    bundle = unknown_matters(request.getfixturevalue(name), unknown)
    flown = [HARD, Scenario(robots=3, duration_s=5.0, world_size=200)]
    for batched, scenario in zip(fly_batch(flown, bundle), flown, strict=True):
        assert_same(batched, fly_points(scenario, bundle))


@pytest.mark.slow
@pytest.mark.parametrize(
    "scenario",
    [
        Scenario(seed=2, robots=4, loss=0.3, payload="float32"),
        Scenario(seed=3, robots=40, duration_s=3.0, world_size=1024, communication_range=128.0),
        Scenario(seed=4, robots=30, duration_s=5.0, radio=ModelledRadio("multicast", SLOW)),
        dataclasses.replace(HARD, duration_s=20.0),
    ],
    ids=[
        "60 s",
        "the paper's density",
        "a full channel",
        "all at once",
    ],
)
def test_long_and_large_flights_too(shipped_bundle: Bundle, scenario: Scenario) -> None:
    [batched] = fly_batch([scenario], shipped_bundle)
    assert_same(batched, fly_points(scenario, shipped_bundle))


def test_payloads_arrive_as_they_are_encoded(shipped_bundle: Bundle) -> None:
    halves, whole = Scenario(duration_s=5.0), Scenario(duration_s=5.0, payload="float32")
    flown = fly_batch([halves, whole], shipped_bundle)
    assert not np.array_equal(flown[0].positions_m, flown[1].positions_m)
    assert np.float32(np.float16(flown[0].largest_payload)) == flown[0].largest_payload
    assert np.float32(np.float16(flown[1].largest_payload)) != flown[1].largest_payload


def test_worlds_of_a_batch_do_not_touch_one_another(shipped_bundle: Bundle) -> None:
    flown = [HARD, Scenario(robots=3, duration_s=2.0), Scenario(seed=9, duration_s=4.05)]
    together = fly_batch(flown, shipped_bundle)
    for scenario, flight in zip(flown, together, strict=True):
        assert_same(flight, *fly_batch([scenario], shipped_bundle))
    assert fly_batch([], shipped_bundle) == []


def test_agents_one_by_one_fly_the_same(
    shipped_bundle: Bundle, exploring_bundle: Bundle, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What serves families that have no batches of their own."""
    bundles = shipped_bundle, exploring_bundle
    expected = [fly_batch([HARD], bundle) for bundle in bundles]
    monkeypatch.setattr("lpac.sim.batch.flights.make_agents", SingleAgents)
    for bundle, flights in zip(bundles, expected, strict=True):
        assert_same(*fly_batch([HARD], bundle), *flights)


def test_a_perception_is_computed_once_for_all_steps_that_follow_it(
    shipped_bundle: Bundle, monkeypatch: pytest.MonkeyPatch
) -> None:
    computed: list[int] = []
    compute = LpacAgents.features

    def counted(agents: LpacAgents, robots: Sequence[int], inputs: Sequence[Inputs]) -> list[F32]:
        computed.extend(robots)
        return compute(agents, robots, inputs)

    monkeypatch.setattr(LpacAgents, "features", counted)
    clocks = Clocks(perception_s=0.5, policy_s=0.1)
    scenario = Scenario(robots=3, duration_s=4.0, clocks=clocks)
    [flight] = fly_batch([scenario], shipped_bundle)
    assert flight.message_counts["broadcasts"] > 3 * 35 and len(computed) <= 3 * 9
    assert_same(flight, fly_points(scenario, shipped_bundle))


@settings(max_examples=60, deadline=None)
@given(
    data=st.data(),
    unknown=st.sampled_from([0.0, 0.25]),
    tells=st.sampled_from([(False, 0), (True, 0), (False, 8), (True, 4), (True, 16)]),
    world_size=st.integers(8, 300),
)
def test_what_was_seen_is_what_a_robot_remembers(
    data: st.DataObject, unknown: float, tells: tuple[bool, int], world_size: int
) -> None:
    """Of two robots, too, that tell each other."""
    parameters = PerceptionParameters(world_size, 64, 16, 50.0, unknown, *tells)
    importance = np.random.default_rng(0).random((world_size, world_size), np.float32)
    coordinates = st.floats(-0.2 * world_size, 1.2 * world_size)
    path = data.draw(st.lists(st.tuples(coordinates, coordinates), min_size=1, max_size=12))
    shown = ShownWorld(importance, parameters)
    sensor = WorldSensor(importance, parameters.sensor_size)
    robots = [(SeenMap(shown), RobotMemory(parameters)) for _ in range(2)]
    room = np.empty((64, 64), np.float32)
    told: SharedMap | None = None
    for place in map(np.array, path):
        for (seen, memory), at in zip(robots, (place, world_size - place), strict=True):
            seen.observe(at)
            memory.observe(at, sensor.view(at))
            if told is not None:
                seen.merge(told)
                memory.merge(told)
            np.testing.assert_array_equal(seen.local_map(at, room), memory.local_map(at))
            told, also = seen.shared_map(at), memory.shared_map(at)
            assert (told is None) == (also is None) == (not tells[1])
            if told and also:
                assert told.corner == also.corner
                np.testing.assert_array_equal(told.codes, also.codes)


def test_inputs_at_a_moment_are_what_robots_perceived(
    shipped_bundle: Bundle, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And to look at them changes nothing."""
    latest: dict[int, Perceived] = {}
    perceive = ClockedPac.perceive

    def noted(pac: ClockedPac, now_s: float) -> Perceived | None:
        perceived = perceive(pac, now_s)
        assert perceived is not None
        latest[pac._robot_id] = perceived
        return perceived

    monkeypatch.setattr(ClockedPac, "perceive", noted)
    scenario = dataclasses.replace(HARD, duration_s=1.9)
    expected = fly_points(scenario, shipped_bundle)
    flights = BatchedFlights([scenario], shipped_bundle)
    for [moment] in flights.moments(expected.time_s.tolist()):
        inputs = moment.inputs()
    np.testing.assert_array_equal(moment.positions_m, expected.positions_m[-1])
    assert inputs.robots == (0, 1, 2, 4, 5, 6, 7, 8, 9)  # 3 has failed
    assert inputs.arrays["images"].shape == (9, 4, 32, 32)
    for name, values in inputs.arrays.items():
        for robot, value in zip(inputs.robots, values, strict=True):
            logged = latest[robot].inputs[name]
            np.testing.assert_array_equal(value, logged.reshape(value.shape))


def test_a_moment_tells_who_is_there(shipped_bundle: Bundle) -> None:
    starts_m = ((16.0, 16.0), (20.0, 16.0), (16.0, 26.0), (17.0, 17.0))
    scenario = Scenario(
        robots=4, starts_m=starts_m, communication_range=128.0, failures=(Failure(3, 0.0),)
    )
    flights = BatchedFlights([scenario] * 2, shipped_bundle)
    for moment in next(flights.moments([0.0])):
        assert moment.alive.tolist() == [True, True, True, False]
        assert np.argwhere(moment.adjacency).tolist() == [[0, 1], [1, 0]]
        np.testing.assert_array_equal(moment.positions, np.array(starts_m) * 16.0)
        assert moment.inputs().robots == ()


def test_who_failed_stands_still_and_does_not_count(shipped_bundle: Bundle) -> None:
    failures = (Failure(0, 2.0), Failure(1, 1.0, until_s=3.0))
    scenario = Scenario(robots=4, duration_s=5.0, failures=failures)
    [flight] = fly_batch([scenario], shipped_bundle)
    at_s = flight.time_s
    paths = flight.positions_m
    assert np.all(paths[at_s >= 2.0, 0] == paths[-1, 0])
    out = (at_s >= 1.0) & (at_s <= 3.0)
    assert np.all(paths[out, 1] == paths[out, 1][0])
    assert np.any(paths[-1, 1] != paths[out, 1][0])
    for k, counted in ((0, [0, 1, 2, 3]), (1, [0, 2, 3]), (2, [2, 3]), (3, [1, 2, 3])):
        [sample] = np.flatnonzero(np.isclose(at_s, k))
        positions = FIELD_SCALE.position_to_model(paths[sample, counted])
        assert flight.coverage is not None
        importance = flight.coverage.importance
        assert flight.cost[k] == pytest.approx(coverage_cost(importance, positions))


def test_who_comes_back_has_forgotten_what_it_saw(shipped_bundle: Bundle) -> None:
    """Its image is then that of a robot which knows little more than what its sensor shows."""
    unknown = 1.5  # more than any cell's importance
    bundle = unknown_matters(shipped_bundle, unknown)
    perception = bundle.manifest.perception
    assert perception is not None
    starts_m = ((10.0, 10.0), (11.0, 10.0))
    known = []
    for failures in ((), (Failure(0, 6.0, until_s=6.5),)):
        flown = Scenario(robots=2, duration_s=7.0, starts_m=starts_m, failures=failures)
        for [moment] in BatchedFlights([flown], bundle).moments([6.8]):
            importance, *_, outside = moment.inputs().arrays["images"][0]
            share = np.mean(importance + unknown * outside < 0.9 * unknown)
            known.append(share * perception.local_map_size**2)
    assert known[1] < 2.0 * perception.sensor_size**2 < known[0]


def test_what_it_does_not_fly_is_named(shipped_bundle: Bundle) -> None:
    with pytest.raises(ValueError, match="'clairvoyant-cvt': must be 'lpac' in batches"):
        fly_batch([Scenario(controller="clairvoyant-cvt")], shipped_bundle)
    manifest = dataclasses.replace(shipped_bundle.manifest, payload_limit=1e-3)
    narrow = dataclasses.replace(shipped_bundle, manifest=manifest)
    with pytest.raises(PolicyFailedError, match="payload_limit"):
        fly_batch([Scenario(duration_s=2.0)], narrow)


@pytest.mark.parametrize(
    ("method", "gives", "said"),
    [
        ("observe", np.zeros(2, np.float32), "policy: observe gives a ndarray: must be a Perceiv"),
        ("step", None, "policy: step gives a NoneType: must be a PolicyStep"),
        ("observe", KeyError("map"), r"policy: KeyError: 'map' \(sim/test_batch.py, line "),
        ("step", KeyError("hops"), r"policy: KeyError: 'hops' \(sim/test_batch.py, line "),
    ],
)
def test_what_an_agent_does_wrong_is_one_line(
    shipped_bundle: Bundle,
    monkeypatch: pytest.MonkeyPatch,
    method: str,
    gives: object,
    said: str,
) -> None:
    def wrong(*_: object) -> object:
        if isinstance(gives, Exception):
            raise gives
        return gives

    monkeypatch.setattr(LpacAgent, method, wrong)
    flights = BatchedFlights([Scenario(robots=2)], shipped_bundle, agents=SingleAgents)
    with pytest.raises(PolicyFailedError, match=said):
        flights.advance([2.0])
