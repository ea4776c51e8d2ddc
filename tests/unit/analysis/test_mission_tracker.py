"""Detection of missions."""

from typing import NamedTuple

import pytest

from edge.messages.mission import FlightState
from lpac.analysis.mission_tracker import MissionTracker

_S = FlightState


class Said(NamedTuple):
    state: FlightState
    armed: bool | None = True
    trial: str = "t1"
    boot_nonce: int = 7


@pytest.mark.parametrize(
    ("said", "goes_on"),
    [
        (Said(_S.HOLD), True),
        (Said(_S.LANDED, armed=True), True),
        (Said(_S.LANDED, armed=False), False),
        # Its autopilot may recover.
        (Said(_S.FAULT, armed=None), True),
        # Killed.
        (Said(_S.FAULT, armed=False), False),
        (Said(_S.HOLD, trial=""), False),
    ],
)
def test_who_keeps_a_mission_going(said: Said, goes_on: bool) -> None:
    mission_tracker = MissionTracker()
    assert mission_tracker.begins(1, Said(_S.MISSION), 10.0)
    assert not mission_tracker.begins(1, said, 11.0)
    assert mission_tracker.robots == ({1} if goes_on else set())
    # Another robot flies the same trial.
    assert mission_tracker.begins(2, Said(_S.MISSION), 12.0) is not goes_on
