"""What is shown to somebody who carries a robot."""

import math

import pytest

from lpac.ground.rehearsal import commanded


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
    told = commanded(velocity_m_s, nose_deg)
    assert (told.arrow, told.words) == (arrow, words)
