"""What a ground says to more robots than a radio has time for, each by itself."""

from dataclasses import dataclass, field

import pytest

from edge.identity.envelope import HEAD_BYTES
from edge.identity.guard import Unguarded
from edge.messages.codec import decode, encode
from edge.messages.mission import GroundState
from edge.messages.topics import STATE, STATUS, Topic
from lpac.ground.station.node import GroundNode
from lpac.ground.station.protocol import SafetyCommand
from tests.unit.ground.snapshots import setup, status

TICK_S = 0.2


@dataclass
class Ground:
    """Its clock, its link and who is told, for one that is alone."""

    now_s: float = 0.0
    said: list[tuple[float, GroundState]] = field(default_factory=list)

    def monotonic_s(self) -> float:
        return self.now_s

    def unix_s(self) -> float:
        return 1e9 + self.now_s

    def publish(self, topic: Topic, data: bytes) -> None:
        if topic == STATE:
            payload = topic.unpacked(data[HEAD_BYTES:])
            assert payload is not None
            self.said.append((self.now_s, decode(GroundState, payload)))

    def is_claimed(self, _: int) -> bool:
        return False

    def peers(self) -> int:
        return 1

    def refused(self) -> int:
        return 0

    def published(self, _: object) -> None:
        pass

    def progressed(self) -> None:
        pass

    def state_changed(self, _: object) -> None:
        pass


def flown(
    robots: int, duration_s: float, *, ground_age_s: float | None = None
) -> tuple[Ground, GroundNode]:
    """A ground that commands, and hears of each robot twice a second, of all at their own times."""
    ground = Ground()
    node, robot_guard = GroundNode(setup(robots), ground, ground, Unguarded(1)), Unguarded(1)
    node.attach(ground)
    hear = node.subscriptions[STATUS]
    node.station.election.take_command()
    for tick in range(round(duration_s / TICK_S)):
        for late in range(2):
            ground.now_s = TICK_S * (tick + late / 2)
            for robot in range(robots):
                # Ten moments in a second, of which each robot has two.
                if (2 * tick + late - robot) % 5 == 0:
                    said = status(
                        robot, uptime_s=ground.now_s, sequence=tick, ground_age_s=ground_age_s
                    )
                    hear(f"robot/{robot}/status", robot_guard.seal(STATUS, encode(said)))
        ground.now_s = TICK_S * (tick + 1)
        node.tick()
    return ground, node


@pytest.mark.parametrize("robots", [10, 300])
def test_states_are_said_as_often_as_the_table_of_topics_says(robots: int) -> None:
    ground, _ = flown(robots, 10.0)
    assert len(ground.said) / 10.0 == pytest.approx(STATE.rate_hz, rel=0.1)


@pytest.mark.parametrize(
    ("ground_age_s", "states_hz"), [(0.4, STATE.rate_hz), (1.2, 1.0 / TICK_S), (9.0, STATE.rate_hz)]
)
def test_states_are_said_at_each_tick_while_a_robot_hears_them_late(
    ground_age_s: float, states_hz: float
) -> None:
    ground, _ = flown(10, 10.0, ground_age_s=ground_age_s)
    assert len(ground.said) / 10.0 == pytest.approx(states_hz, rel=0.1)


@pytest.mark.parametrize("robots", [32, 100])
def test_each_robot_is_echoed_in_its_turn(robots: int) -> None:
    ground, _ = flown(robots, 20.0)
    echoed_s: dict[str, list[float]] = {str(robot): [0.0] for robot in range(robots)}
    for at_s, state in ground.said:
        assert len(state.echoes) <= 32
        for robot, echo in state.echoes.items():
            assert echo.uptime_s + echo.held_s == pytest.approx(at_s)
            echoed_s[robot].append(at_s)
    longest_s = max(
        after_s - before_s
        for times_s in echoed_s.values()
        for before_s, after_s in zip(times_s, [*times_s[1:], 20.0], strict=True)
    )
    assert longest_s < (1.0 if robots <= 32 else 4.0)


def test_what_is_new_is_said_at_once() -> None:
    ground, node = flown(100, 5.0)
    before = len(ground.said)
    ground.now_s += 0.01
    node.begin(SafetyCommand("hold"))
    (at_s, state) = ground.said[before]
    assert at_s == ground.now_s and state.safety_action == "hold"
