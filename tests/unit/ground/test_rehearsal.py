"""What is shown to somebody who carries a robot."""

import math
from dataclasses import replace

import pytest

from lpac.ground.rehearsal import carried_robot, describe_velocity
from tests.unit.ground.snapshots import FENCE, ORIGIN, status


@pytest.mark.parametrize(
    ("velocity_m_s", "nose_deg", "arrow", "words"),
    [
        ((0.0, 0.8), 0.0, "↑", "0.8 m/s, ahead 0 deg right"),
        ((0.8, 0.0), 0.0, "→", "0.8 m/s, right 90 deg"),
        ((0.8, 0.0), 90.0, "→", "0.8 m/s, ahead 0 deg right"),
        ((0.0, 0.8), 35.0, "↑", "0.8 m/s, ahead-left 35 deg"),
        ((0.0, 0.8), 10.0, "↑", "0.8 m/s, ahead 10 deg left"),
        ((-0.5, -0.5), 350.0, "↙", "0.7 m/s, behind-left 125 deg"),
        ((-0.5, 0.5), 315.0, "↖", "0.7 m/s, ahead 0 deg right"),
        ((0.0, -1.0), None, "↓", "1.0 m/s"),
        ((0.01, 0.0), 0.0, "·", "still"),
        ((math.nan, 0.0), 0.0, "·", "still"),
    ],
)
def test_command_is_told_in_the_field_and_from_the_nose(
    velocity_m_s: tuple[float, float], nose_deg: float | None, arrow: str, words: str
) -> None:
    told = describe_velocity(velocity_m_s, nose_deg)
    assert (told.arrow, told.words) == (arrow, words)


def test_a_carried_robot_is_inside_the_fence_that_it_has() -> None:
    heading_rad = math.radians(ORIGIN.heading_deg - 10.0)
    said = status(1, heading_rad=heading_rad, policy_velocity_m_s=(0.0, 0.8))
    seen = carried_robot(said, replace(FENCE, vertices_m=((0.0, 0.0), (99.0, 0.0), (0.0, 99.0))))
    assert (seen.position_m, seen.fence_m) == ((5.0, 12.0), 7.0)
    assert seen.nose_deg == pytest.approx(350.0)
    assert seen.commanded is not None and seen.commanded.words.endswith("ahead 10 deg right")
