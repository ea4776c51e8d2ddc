"""Position faults of a simulated vehicle are judged as docs/faults.md states.

The vehicle reports over its link, and the judge of a robot decides. Nothing runs in real
time.
"""

from collections.abc import Callable
from typing import Any

import pytest

from edge.core.position import PositionCause, PositionQuality
from lpac.sim.px4.estimator import GPS_REJECTED_S
from lpac.sim.px4.vehicle import Px4Vehicle, SimulatedSensor
from tests.sim.sim.watched import READY_S, TICK_S, Watched

_Q = PositionQuality


def flying(seed: int = 5) -> Watched:
    watched = Watched(seed, endurance_s=1200.0)
    while watched.vehicle.time_s < READY_S:
        watched.tick()
    assert watched.vehicle.armed and watched.judgement.quality is _Q.GOOD
    return watched


def run(
    watched: Watched, seconds: float
) -> list[tuple[float, PositionQuality, PositionCause | None]]:
    """What the position was worth as that changed: s from now on, with the cause."""
    began_s, changes = watched.vehicle.time_s, []
    for _ in range(round(seconds / TICK_S)):
        before = watched.judgement.quality
        watched.tick()
        judgement = watched.judgement
        if judgement.quality is not before:
            changes.append((watched.vehicle.time_s - began_s, judgement.quality, judgement.cause))
    return changes


def sets(**fields: Any) -> Callable[[object], None]:
    def do(of: object) -> None:
        for name, value in fields.items():
            setattr(of, name, value)

    return do


def receiver(**fields: Any) -> Callable[[Px4Vehicle], None]:
    def do(vehicle: Px4Vehicle) -> None:
        sets(**fields)(vehicle.receiver)

    return do


def jumps(north_m: float) -> Callable[[Px4Vehicle], None]:
    return sets(gps_jump_m=(north_m, 0.0, 0.0))


# Fault, cause of the doubt, and seconds until the position is doubted: the report and 0.4 s. Then
# the seconds until it is lost, 2 s after the report; None if it is not.
LASTING = [
    pytest.param(sets(gps_lost=True), PositionCause.NO_FIX, 0.8, 2.7, id="no fix"),
    pytest.param(
        # PX4 reports it after a second.
        lambda vehicle: vehicle.dead_sensors.add(SimulatedSensor.GPS), PositionCause.NO_FIX, 2.0,
        3.9,
        id="no driver",
    ),
    pytest.param(sets(estimate_frozen=True), PositionCause.FROZEN, 1.5, 3.4, id="frozen"),
    pytest.param(
        sets(gps_accuracy_override_m=11.0), PositionCause.INACCURATE, 0.8, 2.5, id="hopeless"
    ),
    pytest.param(
        sets(gps_accuracy_override_m=6.0), PositionCause.INACCURATE, 0.8, None, id="inaccurate"
    ),
    pytest.param(jumps(7.0), PositionCause.DISAGREES, 0.8, 2.5, id="jumps"),
    pytest.param(receiver(stuck=True), PositionCause.GPS_STUCK, 1.2, 2.8, id="stuck"),
    pytest.param(
        receiver(creep_m_s=(2.0, 0.0, 0.0)), PositionCause.SLIPS, 3.5, 5.5, id="creeps"
    ),
    pytest.param(
        receiver(velocity_bias_m_s=(0.0, 3.0, 0.0)), PositionCause.VELOCITY_DISAGREES, 0.8,
        # In between the estimate follows it.
        4.3,
        id="wrong velocity",
    ),
]  # fmt: skip


@pytest.mark.parametrize(("fault", "cause", "doubted_s", "lost_s"), LASTING)
def test_what_goes_wrong_is_noticed_in_time(
    fault: Callable[[Px4Vehicle], Any], cause: PositionCause, doubted_s: float, lost_s: float | None
) -> None:
    watched = flying()
    fault(watched.vehicle)
    (at_s, quality, why), *later = run(watched, 6.0)
    assert quality is _Q.DOUBTFUL and why is cause
    assert 0.4 <= at_s <= doubted_s
    assert [quality for _, quality, _ in later] == ([_Q.LOST] if lost_s else [])
    if lost_s:
        assert 2.0 <= later[0][0] <= lost_s


def test_an_accuracy_that_stays_bad_is_lost_after_a_minute() -> None:
    watched = flying()
    watched.vehicle.gps_accuracy_override_m = 6.0
    assert [quality for _, quality, _ in run(watched, 59.0)] == [_Q.DOUBTFUL]
    assert [quality for _, quality, _ in run(watched, 2.0)] == [_Q.LOST]


def test_a_jump_is_rejected_for_a_while_and_then_believed() -> None:
    """PX4 takes the GPS for wrong, starts over from it, and the robot flies on by the new place."""
    watched = flying()
    vehicle = watched.vehicle
    error_m = vehicle.estimated_position_m - vehicle.position_m
    vehicle.gps_jump_m = (7.0, 0.0, 0.0)
    causes = set()
    for _ in range(round((GPS_REJECTED_S - 0.5) / TICK_S)):
        watched.tick()
        causes.add(watched.judgement.cause)
    still_m = vehicle.estimated_position_m - vehicle.position_m
    assert still_m == pytest.approx(error_m, abs=0.5)
    assert vehicle.estimator.doubts_gps and PositionCause.DISAGREES in causes
    # For a second after it was believed the jump speaks against it; then three seconds of nothing.
    (good,) = run(watched, 7.0)
    assert good[1] is _Q.GOOD and 0.5 + 3.0 <= good[0] <= 0.5 + 1.0 + 3.0 + 1.5
    moved_m = vehicle.estimated_position_m - vehicle.position_m - error_m
    assert moved_m == pytest.approx([7.0, 0.0, 0.0], abs=0.7)
    assert not vehicle.estimator.doubts_gps


def test_a_jump_that_is_near_enough_to_be_true_is_followed_smoothly() -> None:
    """Nobody notices: it is within what margins are for."""
    watched = flying()
    vehicle = watched.vehicle
    error_m = vehicle.estimated_position_m - vehicle.position_m
    vehicle.gps_jump_m = (0.0, -3.0, 0.0)
    assert run(watched, 12.0) == []
    moved_m = vehicle.estimated_position_m - vehicle.position_m - error_m
    assert moved_m == pytest.approx([0.0, -3.0, 0.0], abs=0.7)


def test_a_good_receiver_is_noisy_late_and_believed() -> None:
    """Its fix is not the estimate, and no further from it than a position may be."""
    watched = flying()
    assert run(watched, 20.0) == []
    assert 0.3 < watched.greatest_offset_m < 4.5
    vehicle = watched.vehicle
    assert 8 <= vehicle.gps_satellites <= 16
    assert 0.8 <= vehicle.gps_accuracy_m[0] <= 1.4


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_a_good_position_is_never_doubted(seed: int) -> None:
    watched = flying(seed)
    assert run(watched, 300.0) == []
    assert watched.vehicle.armed and watched.greatest_offset_m < 5.0
