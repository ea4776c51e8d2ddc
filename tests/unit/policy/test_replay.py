"""Replay computes the outputs of real robots again, and shows every alteration."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from edge.core import F64
from edge.core.frames import ModelScale
from edge.core.ports import Odometry
from edge.core.wire import PAYLOAD_TYPES, PayloadType
from edge.policy.bundle import Bundle, BundleError
from edge.policy.images import EXPLORED, MAP_CHANNELS
from edge.policy.lpac.policy import LpacPolicy
from edge.robot.pac import Pac, PacParameters
from lpac.analysis.policy_replay import ReplayError, replay

Messages = list[tuple[str, float, dict[str, Any]]]


class Surroundings:
    """A robot's sensor and odometry, drifting over a bumpy world."""

    def __init__(self, robot: int) -> None:
        self._x_m, self._rng = 12.0 + 3.0 * robot, np.random.default_rng(robot)

    def view(self, position: F64) -> np.ndarray[Any, np.dtype[np.float32]]:
        return self._rng.random((64, 64), np.float32)

    def odometry(self) -> Odometry:
        self._x_m += 0.1
        return Odometry((self._x_m, 15.0, 3.0), (0.5, 0.0, 0.0))


def fly(policy: LpacPolicy, payload: PayloadType = "float16", ticks: int = 6) -> Messages:
    """The first of three robots' ticks, in the form that its loops record."""
    parameters = PacParameters(scale=ModelScale(16.0, 0.25), max_speed_m_s=1.0, payload=payload)
    robots = []
    for robot in range(3):
        seen = Surroundings(robot)
        robots.append(
            Pac(
                robot_id=robot, policy=policy, sensor=seen, odometry=seen,
                parameters=parameters,
            )
        )  # fmt: skip
        robots[-1].frame_id = 0x89ABCDEF
        robots[-1].clock.update(1, 0.0, echoed_at_s=0.0, held_s=0.0, now_s=0.0)
    messages: Messages = []
    for tick in range(ticks):
        now_s = 0.4 * tick
        seen_ticks = [robot.perceive(now_s) for robot in robots]
        done = [robot.infer(now_s) for robot in robots]
        for sender, sent in enumerate(done):
            assert sent is not None
            for robot, receiver in enumerate(robots):
                if robot != sender:
                    beacon = robots[sender].beacon(now_s)
                    assert receiver.receive(beacon, (1, tick), sent.message, now_s) is None
        perceived, step = seen_ticks[0], done[0]
        assert perceived is not None and step is not None
        for topic, message in (
            ("perception", {**perceived.inputs, "features": perceived.features}),
            ("policy", dataclasses.asdict(step)),
        ):
            messages.append((topic, 1.7e9 + now_s, message))
        messages.append(("status", 1.7e9 + now_s, {"state": "mission"}))
    return messages


@pytest.mark.parametrize("payload", PAYLOAD_TYPES)
def test_the_same_machine_computes_the_same(
    shipped_policy: LpacPolicy, payload: PayloadType
) -> None:
    flown = fly(shipped_policy, payload)
    assert [len(m["payloads"]) for topic, _, m in flown if topic == "policy"] == [0, 2, 2, 2, 2, 2]
    for comparison in replay(shipped_policy, flown):
        assert (comparison.ticks, comparison.differing) == (6, 0)
        assert comparison.largest_difference == 0.0


def test_what_was_explored_is_logged_with_the_other_images(exploring_bundle: Bundle) -> None:
    policy = LpacPolicy(exploring_bundle)
    flown = fly(policy)
    for comparison in replay(policy, flown):
        assert (comparison.ticks, comparison.differing) == (6, 0)
    [images] = flown[0][2]["images"]
    image = dict(zip(MAP_CHANNELS[5], images, strict=True))
    # One observation around the robot, far from the border: 64 of the local map's 256 cells.
    assert image[EXPLORED].sum() * 16**2 == pytest.approx(64**2, rel=1e-5)
    assert image[EXPLORED][8, 8] == pytest.approx(1.0) and image[EXPLORED][0, 0] == 0.0


def test_ticks_stand_for_themselves(shipped_policy: LpacPolicy) -> None:
    """A log has gaps where the recorder dropped messages."""
    flown = fly(shipped_policy)
    for comparison in replay(shipped_policy, flown[:0:-2]):
        assert comparison.ticks == 3 and comparison.differing == 0


@pytest.mark.parametrize(
    ("topic", "field", "output"),
    [
        ("perception", "features", "features"),
        ("perception", "images", "features"),
        ("policy", "velocity", "velocity"),
        ("policy", "features", "velocity"),
    ],
)
def test_what_was_altered_shows(
    shipped_policy: LpacPolicy, topic: str, field: str, output: str
) -> None:
    flown = fly(shipped_policy)
    altered = [m for name, _, m in flown if name == topic][2][field]
    altered.flat[0] += 0.25
    by_name = {c.name: c for c in replay(shipped_policy, flown)}
    assert by_name[output].differing == 1
    if field == output:
        assert by_name[output].largest_difference == pytest.approx(0.25, rel=1e-4)
    else:
        assert by_name[output].largest_difference > 0.0


def test_an_altered_payload_shows_in_what_was_sent(shipped_policy: LpacPolicy) -> None:
    flown = fly(shipped_policy)
    policy_ticks = [m for topic, _, m in flown if topic == "policy"]
    first, *others = policy_ticks[3]["payloads"]
    policy_ticks[3]["payloads"] = (first + np.float16(1.0), *others)
    _, velocity, message = replay(shipped_policy, flown)
    assert velocity.differing == message.differing == 1
    assert message.largest_difference > 0.1


def test_a_logged_nan_is_a_difference(shipped_policy: LpacPolicy) -> None:
    flown = fly(shipped_policy)
    flown[1][2]["velocity"][0] = np.nan
    _, velocity, _ = replay(shipped_policy, flown)
    assert velocity.differing == 1 and np.isnan(velocity.largest_difference)


@pytest.mark.parametrize(
    ("topic", "alter", "text"),
    [
        ("perception", lambda m: m.pop("images"), "perception at 1700000000.000 s: 'images'"),
        (
            "perception",
            lambda m: m.update(images=m["images"][0]),
            r"images has shape \(4, 32",
        ),
        ("perception", lambda m: m.update(features=None), "features: is NoneType; .* needs"),
        ("policy", lambda m: m.update(degree=1), "degree = 1: must be at least 2, the payloads"),
        ("policy", lambda m: m.update(payloads=[np.zeros(3)]), r"payloads: is \(3,\)"),
        ("policy", lambda m: m.update(message=m["message"][:-1]), "refused: compression"),
        ("policy", lambda m: m.update(message=b""), "refused: truncated"),
    ],
)
def test_what_is_no_tick_of_this_policy_is_named(
    shipped_policy: LpacPolicy, topic: str, alter: Callable[[dict[str, Any]], object], text: str
) -> None:
    flown = fly(shipped_policy, ticks=2)
    flown = [(name, 1.7e9, m) for name, _, m in flown if name == topic][-1:]
    alter(flown[0][2])
    with pytest.raises(ReplayError, match=text):
        replay(shipped_policy, flown)


def test_a_bundle_without_perception_flew_nothing(shipped_bundle: Bundle) -> None:
    blind = LpacPolicy(shipped_bundle)
    flown = fly(blind, ticks=1)
    blind.manifest = dataclasses.replace(blind.manifest, perception=None)
    blind.lpac = dataclasses.replace(blind.lpac, images=None)
    with pytest.raises(BundleError, match="has no perception"):
        replay(blind, flown)
