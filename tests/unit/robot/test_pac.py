"""One robot's steps: what they do, and what they do when something is missing."""

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.core import F32, F64, Bools
from edge.core.aggregation import AggregatedMessage
from edge.core.fleet_time import FleetTime
from edge.core.frames import ModelScale
from edge.core.part import PartError
from edge.core.ports import Look, Odometry
from edge.core.wire import Rejection, decode, encode
from edge.messages.beacon import Beacon, tag
from edge.policy.bundle import Bundle, BundleError, Manifest
from edge.policy.family import (
    GoldenCheck,
    Neighbourhood,
    Observation,
    Perceived,
    Policy,
    PolicyStep,
)
from edge.policy.lpac.policy import LpacPolicy
from edge.robot.pac import Pac, PacParameters

PARAMETERS = PacParameters(scale=ModelScale(16.0, 0.25), max_speed_m_s=1.25)
GROUND = 7


@dataclass
class World:
    """A sensor and a position that a test can change or take away."""

    position: tuple[float, float, float] | None = (16.0, 16.0, 3.0)
    seen: F32 | None = field(default_factory=lambda: np.full((64, 64), 0.5, np.float32))

    def view(self, position: F64) -> F32 | None:
        assert position.shape == (2,)
        return self.seen

    def odometry(self) -> Odometry | None:
        return Odometry(self.position, (0.5, 0.0, 0.0)) if self.position else None


def make_robot(
    policy: Policy, world: World, robot_id: int = 1, parameters: PacParameters = PARAMETERS
) -> Pac:
    robot = Pac(
        robot_id=robot_id, policy=policy, sensor=world, odometry=world,
        parameters=parameters,
    )  # fmt: skip
    robot.clock.update(GROUND, 0.0, echoed_at_s=0.0, held_s=0.0, now_s=0.0)
    return robot


def fill(policy: LpacPolicy, value: float) -> F32:
    return np.full(policy.geometry.message_size, value, np.float32)


class Said(NamedTuple):
    beacon: Beacon
    number: tuple[int, int]
    data: bytes


def message(
    policy: LpacPolicy, robot_id: int = 2, value: float = 0.1, sequence: int = 1, **changes: Any
) -> Said:
    told: dict[str, Any] = {
        "robot_id": robot_id, "sent": FleetTime(GROUND, 0.0, 0.0),
        "position_m": (18.0, 16.0, 3.0), "velocity_m_s": (0.0, 0.0, 0.0), "frame_id": 0,
        "bundle_tag": tag(policy.bundle_id.hex()), **changes,
    }  # fmt: skip
    data = encode(AggregatedMessage(fill(policy, value)), "float32")
    return Said(Beacon(**told), (1, sequence), data)


def test_a_robot_perceives_infers_and_moves_within_the_speed_limit(
    shipped_policy: LpacPolicy,
) -> None:
    slow = PacParameters(scale=ModelScale(16.0, 0.25), max_speed_m_s=0.01)
    world = World()
    fast_robot = make_robot(shipped_policy, world)
    slow_robot = make_robot(shipped_policy, world, parameters=slow)
    for robot in (fast_robot, slow_robot):
        robot.perceive(0.0)
        assert robot.infer(0.0) is not None
    fast, slowed = fast_robot.control(0.1), slow_robot.control(0.1)
    assert fast is not None and slowed is not None
    assert 0.01 < np.hypot(*fast) <= 1.25
    assert np.hypot(*slowed) == pytest.approx(0.01)
    np.testing.assert_allclose(slowed / 0.01, fast / np.hypot(*fast))


def test_nothing_moves_before_the_first_inference(shipped_policy: LpacPolicy) -> None:
    robot = make_robot(shipped_policy, World())
    assert robot.infer(0.0) is None
    robot.perceive(0.0)
    assert robot.control(0.0) is None


@pytest.mark.parametrize("missing", ["position", "seen"])
def test_without_position_or_sensor_the_robot_stops(
    shipped_policy: LpacPolicy, missing: str
) -> None:
    world = World()
    robot = make_robot(shipped_policy, world)
    robot.perceive(0.0)
    robot.infer(0.0)
    setattr(world, missing, None)
    for tick in range(1, 10):
        now_s = tick * 0.4
        robot.perceive(now_s)
        sent = robot.infer(now_s)
        assert (sent is not None) == (missing == "seen" and now_s <= 1.0)
    assert robot.control(1.0 if missing == "position" else 1.8) is not None
    assert robot.control(2.0) is None


def test_a_position_that_is_not_a_number_is_none(shipped_policy: LpacPolicy) -> None:
    robot = make_robot(shipped_policy, World(position=(16.0, float("nan"), 3.0)))
    robot.perceive(0.0)
    assert robot.infer(0.0) is None


@pytest.mark.parametrize(
    ("view", "problem"),
    [
        (np.full((64, 64), np.nan, np.float32), "sensor: view has values that are not finite"),
        (np.zeros((32, 32), np.float32), "sensor: view has shape (32, 32): must be (64, 64)"),
        (None, "sensor: it shows nothing"),
    ],
    ids=["not finite", "wrong size", "none"],
)
def test_a_bad_view_does_not_enter_the_map(
    shipped_policy: LpacPolicy, view: F32 | None, problem: str
) -> None:
    world = World(seen=view)
    robot = make_robot(shipped_policy, world)
    assert f"sensor: {robot.try_sensor((1.0, 1.0, 5.0))}" == problem
    robot.perceive(0.0)
    assert robot.infer(0.0) is None
    assert (robot.problem, robot.action_age_s(0.1)) == (problem, None)
    world.seen = np.zeros((64, 64), np.float32)
    robot.perceive(0.2)
    assert robot.infer(0.2) is not None
    assert robot.problem == ""
    assert robot.action_age_s(0.3) == pytest.approx(0.1)


def test_a_sensor_that_raises_is_tried_without_harm(
    shipped_policy: LpacPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = make_robot(shipped_policy, World(seen=np.zeros((64, 64), np.float32)))
    assert robot.try_sensor((1.0, 1.0, 5.0)) == ""

    def unplugged(_: F64) -> F32:
        raise OSError("no /dev/video7")

    monkeypatch.setattr(robot.sensor, "view", unplugged)
    line = unplugged.__code__.co_firstlineno + 1
    what = f"OSError: no /dev/video7 (robot/test_pac.py, line {line})"
    assert robot.try_sensor((1.0, 1.0, 5.0)) == what
    with pytest.raises(PartError) as error:
        robot.perceive(0.0)
    assert str(error.value) == f"robot 1: sensor: {what}"
    assert robot.problem == f"sensor: {what}"


def test_by_the_papers_rule_a_silent_neighbour_still_counts_once(
    shipped_policy: LpacPolicy,
) -> None:
    """The degree is that of the neighbour table, not the number of messages in this tick."""
    once = PacParameters(
        scale=ModelScale(16.0, 0.25), max_speed_m_s=1.25, max_message_age_s=0.0, payload="float32"
    )
    robot = make_robot(shipped_policy, World(), parameters=once)
    own = []
    for tick, heard in enumerate(((2, 3), (2,), ())):
        now_s = 0.4 * tick
        for robot_id in heard:
            robot.receive(*message(shipped_policy, robot_id, sequence=tick + 1), now_s)
        robot.perceive(now_s)
        sent = robot.infer(now_s)
        assert sent is not None
        own.append(decode(sent.message, message_size=870))
    # The last values of x_0 are the position, times 1/sqrt(degree).
    x = [m.payload[33] for m in own if isinstance(m, AggregatedMessage)]
    np.testing.assert_allclose(x, np.array([1.0, 1.0, np.sqrt(2.0)]) / np.sqrt(2.0), rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"max_speed_m_s": float("nan")}, "max_speed_m_s = nan: must be above 0 and finite"),
        ({"max_input_age_s": -1.0}, "max_input_age_s = -1.0"),
        ({"payload": "float64"}, "payload = 'float64'"),
    ],
)
def test_impossible_settings_are_named(change: dict[str, object], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        dataclasses.replace(PARAMETERS, **change)  # type: ignore[arg-type]


@pytest.mark.parametrize("robot_id", [-1, 2**16])
def test_an_id_that_no_message_can_hold_is_refused(
    shipped_policy: LpacPolicy, robot_id: int
) -> None:
    with pytest.raises(ValueError, match=f"robot_id = {robot_id}: must be from 0 to 65535"):
        make_robot(shipped_policy, World(), robot_id)


def test_an_action_without_a_successor_grows_old(shipped_policy: LpacPolicy) -> None:
    robot = make_robot(shipped_policy, World())
    robot.perceive(0.0)
    robot.infer(0.0)
    assert robot.control(1.0) is not None
    assert robot.control(1.001) is None


def test_a_neighbour_changes_what_the_robot_does_and_is_forgotten_when_silent(
    shipped_policy: LpacPolicy,
) -> None:
    velocities = []
    for heard in ([], [message(shipped_policy)], [message(shipped_policy, position_m=(40, 16, 3))]):
        robot = make_robot(shipped_policy, World())
        for said in heard:
            assert robot.receive(*said, 0.0) is None
        robot.perceive(0.0)
        robot.infer(0.0)
        velocity = robot.control(0.0)
        assert velocity is not None
        velocities.append(velocity)
    alone, beside_near, beside_far = velocities
    assert not np.allclose(alone, beside_near)
    np.testing.assert_array_equal(alone, beside_far)  # 24 m is beyond the range of 16 m

    robot = make_robot(shipped_policy, World())
    robot.receive(*message(shipped_policy), 0.0)
    robot.perceive(0.8)
    robot.infer(0.8)
    velocity = robot.control(0.8)
    assert velocity is not None
    np.testing.assert_array_equal(velocity, alone)


def test_what_a_robot_must_not_hear_is_counted(shipped_policy: LpacPolicy) -> None:
    robot = make_robot(shipped_policy, World())
    good = message(shipped_policy)
    cases = {
        Rejection.OWN: message(shipped_policy, robot_id=1),
        Rejection.OTHER_RELEASE: message(shipped_policy, other_release="01", sequence=2),
        Rejection.OTHER_BUNDLE: message(shipped_policy, bundle_tag=1, sequence=3),
        Rejection.COMPRESSION: good._replace(number=(1, 4), data=good.data[:20]),
        Rejection.NON_FINITE: message(shipped_policy, value=float("nan"), sequence=5),
        Rejection.STALE: message(shipped_policy, sequence=6, sent=FleetTime(GROUND, -1.0, 0.0)),
        Rejection.AGE_UNKNOWN: message(shipped_policy, sequence=7, sent=None),
        Rejection.OUTDATED: message(shipped_policy, sequence=7),
    }
    assert robot.receive(*good, 0.0) is None
    for reason, said in cases.items():
        assert robot.receive(*said, 0.0) is reason
        assert robot.table.counts()[reason] == 1
    assert robot.table.counts()["accepted"] == 1


def test_absurd_neighbours_stop_the_robot_instead_of_driving_it(shipped_bundle: Bundle) -> None:
    """Of a policy whose payloads have no limit: the shipped one's robots do not listen to them."""
    shipped = LpacPolicy(shipped_bundle)
    robot = make_robot(shipped, World())
    absurd = message(shipped, value=3e38)
    assert robot.receive(*absurd, 0.0) is Rejection.PAYLOAD_RANGE
    without = dataclasses.replace(shipped_bundle.manifest, payload_limit=None)
    robot = make_robot(LpacPolicy(dataclasses.replace(shipped_bundle, manifest=without)), World())
    assert robot.receive(*absurd, 0.0) is None
    assert robot.receive(*message(shipped, robot_id=3, value=3e38), 0.0) is None
    robot.perceive(0.0)
    with np.errstate(over="ignore", invalid="ignore"):
        assert robot.infer(0.0) is None
    assert robot.control(0.0) is None


@pytest.mark.parametrize(
    ("position", "feature"),
    [((0.0, 512.0), (0.5, 1.5)), ((256.0, 128.0), (1.0, 0.75)), ((-90.0, 600.0), (0.5, 1.5))],
)
def test_position_features_are_those_of_training(
    shipped_policy: LpacPolicy, position: tuple[float, float], feature: tuple[float, float]
) -> None:
    """Outside the world, those of its nearest point."""
    robot = make_robot(shipped_policy, World((position[0] / 16.0, position[1] / 16.0, 3.0)))
    perceived = robot.perceive(0.0)
    assert perceived and tuple(perceived.inputs["position_feature"]) == feature
    assert tuple(perceived.features[-2:]) == feature


@given(st.tuples(*[st.floats(-100.0, 100.0)] * 2))
@settings(deadline=None, max_examples=30)
def test_outside_the_world_the_view_is_that_from_its_border(
    shipped_policy: LpacPolicy, position_m: tuple[float, float]
) -> None:
    """With nothing seen, so that only the place shows."""
    inside_m = np.clip(position_m, 0.0, 32.0).tolist()
    outside, border = (
        make_robot(shipped_policy, World((x, y, 3.0), np.zeros((64, 64), np.float32))).perceive(0.0)
        for x, y in (position_m, inside_m)
    )
    assert outside and border
    np.testing.assert_array_equal(outside.inputs["images"], border.inputs["images"])
    np.testing.assert_array_equal(outside.features, border.features)


def test_a_bundle_without_perception_drives_no_robot(shipped_bundle: Bundle) -> None:
    blind = LpacPolicy(shipped_bundle)
    blind.manifest = dataclasses.replace(blind.manifest, perception=None)
    with pytest.raises(BundleError, match="has no perception"):
        make_robot(blind, World())


@dataclass
class Watching:
    """A policy of another family, and its agent, which keeps the maps that it is shown."""

    manifest: Manifest
    bundle_id: bytes = bytes(32)
    message_size: int = 0
    local_maps: list[F32] = field(default_factory=list)
    neighbours: Neighbourhood | None = None

    def agent(self) -> "Watching":
        return self

    def verify(self) -> Iterator[GoldenCheck]:
        return iter(())

    def observe(self, observation: Observation) -> Perceived:
        self.local_maps.append(observation.local_map.copy())
        return Perceived(np.zeros(2, np.float32), {})

    def step(self, features: F32, neighbours: Neighbourhood) -> PolicyStep:
        self.neighbours = neighbours
        return PolicyStep(features, np.zeros(0, np.float32))

    def reset(self) -> None:
        pass


def raises() -> None:
    np.stack([])


@pytest.mark.parametrize("method", ["observe", "step", "reset"])
def test_a_policy_that_raises_is_blamed_in_one_line(
    shipped_bundle: Bundle, monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    manifest = dataclasses.replace(shipped_bundle.manifest, family="watching", parameters={})
    policy = Watching(manifest)
    robot = make_robot(policy, World())
    robot.perceive(0.0)
    robot.infer(0.0)
    robot.forget()
    monkeypatch.setattr(policy, method, lambda *_: raises())
    line = raises.__code__.co_firstlineno + 1
    what = f"policy: ValueError: need at least one array to stack (robot/test_pac.py, line {line})"
    with pytest.raises(PartError) as error:
        robot.perceive(0.2)
        robot.infer(0.2)
    assert str(error.value) == f"robot 1: {what}"
    assert robot.problem == what
    assert robot.control(0.9) is not None  # by the last answer, until that is too old
    assert robot.control(1.1) is None
    monkeypatch.undo()
    robot.perceive(1.2)
    assert robot.infer(1.2) is not None
    assert robot.problem == ""


@pytest.mark.parametrize(
    ("method", "gives", "problem"),
    [
        ("observe", np.zeros(2, np.float32), "observe gives a ndarray: must be a Perceived"),
        ("observe", Perceived([0.0], {}), "features are a list: must be a numpy array"),  # type: ignore[arg-type]
        ("step", None, "step gives a NoneType: must be a PolicyStep"),
        (
            "step",
            PolicyStep([0.0, 0.0], np.zeros(0, np.float32)),  # type: ignore[arg-type]
            "velocity is of type list: must be a numpy array of floats, of shape (2,)",
        ),
        (
            "step",
            PolicyStep(np.zeros(2, np.float32), np.zeros(3, np.float32)),
            "payload has shape (3,): must be (0,)",
        ),
        (
            "step",
            PolicyStep(np.array([np.nan, 0.0], np.float32), np.zeros(0, np.float32)),
            "velocity has values that are not finite",
        ),
    ],
)
def test_what_no_policy_may_give_is_not_used(
    shipped_bundle: Bundle,
    monkeypatch: pytest.MonkeyPatch,
    method: str,
    gives: object,
    problem: str,
) -> None:
    manifest = dataclasses.replace(shipped_bundle.manifest, family="watching", parameters={})
    policy = Watching(manifest)
    robot = make_robot(policy, World())
    monkeypatch.setattr(policy, method, lambda *_: gives)
    robot.perceive(0.0)
    assert robot.infer(0.0) is None
    assert robot.control(0.1) is None
    assert robot.problem == f"policy: {problem}"


def test_a_policy_is_shown_what_is_unseen_if_its_manifest_asks(shipped_bundle: Bundle) -> None:
    manifest = dataclasses.replace(shipped_bundle.manifest, family="watching", parameters={})
    assert manifest.perception is not None
    asks = dataclasses.replace(manifest.perception, unseen_as_nan=True)
    shown = []
    for policy in (
        Watching(manifest),
        Watching(dataclasses.replace(manifest, perception=asks)),
    ):
        robot = make_robot(policy, World(position=(0.0, 16.0, 3.0)))  # at x = 0, y = 256
        robot.perceive(0.0)
        robot.forget()
        robot.perceive(0.1)
        first, again = policy.local_maps
        np.testing.assert_array_equal(first, again)
        shown.append(first)
    plain, marked = shown
    seen = np.zeros((256, 256), np.bool_)
    seen[96:160, 96:160] = True
    np.testing.assert_array_equal(plain[128:], np.where(seen, np.float32(0.5), 0.0)[128:])
    np.testing.assert_array_equal(np.isnan(marked), ~seen & (np.arange(256) >= 128)[:, None])
    np.testing.assert_array_equal(np.nan_to_num(marked), plain)
    assert not plain[:128].any()  # outside the world


def test_a_policy_knows_where_its_neighbours_are_and_how_old_their_messages(
    shipped_bundle: Bundle,
) -> None:
    manifest = dataclasses.replace(shipped_bundle.manifest, family="watching", parameters={})
    policy = Watching(manifest)
    robot = make_robot(policy, World(position=(16.0, 16.0, 3.0)))
    robot.clock.update(GROUND, 0.0, echoed_at_s=0.0, held_s=0.0, now_s=0.0)
    nothing = encode(AggregatedMessage(np.zeros(0, np.float32)), "float32")
    for robot_id, x_m in ((7, 18.0), (3, 14.0), (9, 120.0)):
        beacon = Beacon(
            robot_id=robot_id, sent=FleetTime(GROUND, 0.1, 0.0), position_m=(x_m, 17.0, 3.0),
            velocity_m_s=(0.5, -0.25, 0.1), frame_id=0, bundle_tag=tag(policy.bundle_id.hex()),
        )  # fmt: skip
        assert robot.receive(beacon, (1, 1), nothing, 0.2) is None
    robot.perceive(0.2)
    tick = robot.infer(0.5)
    seen = policy.neighbours
    assert seen is not None and tick is not None
    assert seen.robot_ids == (3, 7) and seen.degree == 2
    # 16 model units a metre, a quarter of the speed in the model: ModelScale(16, 0.25).
    np.testing.assert_allclose(seen.positions, [[-32.0, 16.0], [32.0, 16.0]])
    np.testing.assert_allclose(seen.velocities, np.tile([2.0, -1.0], (2, 1)))
    np.testing.assert_allclose(seen.ages_s, 0.4, atol=0.02)
    assert tick.senders == (3, 7)
    np.testing.assert_array_equal(tick.positions, seen.positions)


@dataclass
class LeftHalf:
    """A camera that sees the left half of its square, and is told from where it looks."""

    importance: F32 = field(default_factory=lambda: np.full((64, 64), 0.5, np.float32))
    seen: Bools = field(default_factory=lambda: np.arange(64 * 64).reshape(64, 64) < 32 * 64)
    heights: list[float] = field(default_factory=list)

    def look(self, position: F64, height: float) -> Look | None:
        assert position.tolist() == [256.0, 256.0]
        self.heights.append(height)
        return Look(self.importance, self.seen)


def test_a_camera_gets_its_height_and_unseen_cells_stay_unseen(
    shipped_bundle: Bundle,
) -> None:
    manifest = dataclasses.replace(shipped_bundle.manifest, family="watching", parameters={})
    assert manifest.perception is not None
    policy = Watching(
        dataclasses.replace(
            manifest, perception=dataclasses.replace(manifest.perception, unseen_as_nan=True)
        )
    )
    robot = make_robot(policy, World())
    robot.sensor = camera = LeftHalf()
    assert robot.perceive(0.0) is not None
    assert camera.heights == [48.0]  # 3 m
    (local,) = policy.local_maps
    np.testing.assert_array_equal(local[96:128, 96:160], np.float32(0.5))
    assert np.isnan(local[128:]).all()
    assert robot.explored().sum() == 4 * 8


@pytest.mark.parametrize(
    ("importance", "seen"),
    [
        (np.zeros((64, 63), np.float32), np.ones((64, 63), np.bool_)),
        (np.zeros((64, 64), np.float32), np.ones((64, 1), np.bool_)),
        (np.zeros((64, 64), np.float32), np.ones((64, 64), np.float32)),
        (np.full((64, 64), np.nan, np.float32), np.zeros((64, 64), np.bool_)),
    ],
)
def test_a_look_that_is_none_is_not_used(
    shipped_policy: LpacPolicy, importance: F32, seen: Bools
) -> None:
    robot = make_robot(shipped_policy, World())
    robot.sensor = LeftHalf(importance, seen)
    assert robot.perceive(0.0) is None
    assert not robot.explored().any()


def test_a_new_mission_forgets_map_and_messages(shipped_policy: LpacPolicy) -> None:
    flown, fresh = (make_robot(shipped_policy, World()) for _ in range(2))
    flown.receive(*message(shipped_policy), 0.0)
    flown.perceive(0.0)
    assert flown.infer(0.0) is not None
    flown.forget()
    assert flown.table.neighbours(0.0) == ()
    assert flown.infer(0.1) is None  # no features yet
    dark = World(seen=np.zeros((64, 64), np.float32))
    for robot in (flown, fresh):
        robot.sensor = dark
    ticks = [robot.perceive(0.2) for robot in (flown, fresh)]
    assert ticks[0] and ticks[1]
    np.testing.assert_array_equal(ticks[0].inputs["images"], ticks[1].inputs["images"])


def test_messages_of_another_mission_frame_are_not_listened_to(shipped_policy: LpacPolicy) -> None:
    robot = make_robot(shipped_policy, World())
    robot.frame_id = 8
    assert robot.receive(*message(shipped_policy), 0.0) is Rejection.OTHER_FRAME
    assert robot.receive(*message(shipped_policy, frame_id=8, sequence=2), 0.0) is None


def test_others_maps_are_merged_within_one_mission(sharing_bundle: Bundle) -> None:
    """Whoever begins the next one later still tells of the last, and is not heard."""
    policy = LpacPolicy(sharing_bundle)
    here, there = World(position=(16.0, 16.0, 3.0)), World(position=(12.0, 16.0, 3.0))
    robot, other = make_robot(policy, here, 1), make_robot(policy, there, 2)

    def explored(now_s: float) -> float:
        """How much the robot knows of, in model units squared, after the other one has spoken."""
        other.perceive(now_s)
        tick = other.infer(now_s)
        assert tick is not None
        number = 1, round(10.0 * now_s)
        assert robot.receive(other.beacon(now_s), number, tick.message, now_s) is None
        perceived = robot.perceive(now_s)
        assert perceived is not None
        return float(perceived.inputs["images"][0, 3].mean()) * 256**2

    both, alone = 2 * 64**2, 64**2
    assert explored(0.0) == pytest.approx(both, rel=0.01)
    robot.forget("second")
    assert explored(0.4) == pytest.approx(alone, rel=0.01)
    other.forget("second")
    assert explored(0.8) == pytest.approx(both, rel=0.01)
    # What somebody out of range has seen is not taken, also where it comes near later.
    there.position = (2.0, 2.0, 3.0)
    assert explored(1.2) == pytest.approx(both, rel=0.01)
    here.position = (6.0, 6.0, 3.0)
    perceived = robot.perceive(9.0)
    assert perceived is not None
    assert float(perceived.inputs["images"][0, 3].mean()) * 256**2 == pytest.approx(alone, rel=0.01)


def test_no_message_goes_without_a_map_while_a_new_mission_begins(sharing_bundle: Bundle) -> None:
    """Its neighbours would refuse it; each loop is a thread of its own."""
    policy = LpacPolicy(sharing_bundle)
    meanwhile: list[Callable[[], None]] = []

    class Looking(World):
        def view(self, position: F64) -> F32 | None:
            if meanwhile:
                meanwhile.pop()()
            return super().view(position)

    robot, other = make_robot(policy, Looking()), make_robot(policy, World(), 2)
    told: list[Rejection | None] = []

    def infer() -> None:
        tick = robot.infer(0.2)
        assert tick is not None
        told.append(other.receive(robot.beacon(0.2), (1, 1), tick.message, 0.2))

    meanwhile.append(lambda: robot.forget("second"))
    robot.perceive(0.0)
    meanwhile.append(infer)
    robot.perceive(0.2)
    assert told == [None] and not meanwhile
    # The map is still that of the mission before.
    (neighbour,) = other.table.neighbours(0.2)
    assert neighbour.message.shared is not None and neighbour.message.trial == 0
