"""What robots count of each other's messages, against what the simulated radio did to them."""

from dataclasses import replace

import pytest

from lpac.analysis.snapshot import FleetSnapshot
from lpac.ground.alarms import AlarmCode, alarms
from lpac.ground.station.protocol import SetOrigin
from lpac.radio.pairs import Pair, Window, pairs
from lpac.sim.fleet.layout import ORIGIN
from tests.sim.ground.field import Field, a_field

# More than the ten seconds of which alarms tell.
SETTLED_S = 14.0


def picture(field: Field) -> FleetSnapshot:
    return field.fleet.ground.node.snapshot


def listened(field: Field, duration_s: float) -> tuple[Pair, ...]:
    """What `lpac fleet radio` would find."""
    windows: dict[str, Window] = {}
    end_s = field.now_s + duration_s
    while field.now_s < end_s:
        field.step()
        for robot in picture(field).robots:
            if robot.status is not None and robot.status.radio_counts is not None:
                known = windows.get(robot.name)
                first = robot.status if known is None else known.first
                windows[robot.name] = Window(first, robot.status)
    return pairs(windows)


def test_on_the_ground_all_is_heard_of_all_also_before_anybody_is_enabled() -> None:
    field = a_field(3)
    field.done(SetOrigin(ORIGIN))
    field.run(3.0)
    found = listened(field, 22.0)
    assert len(found) == 6
    for pair in found:
        assert pair.sent >= 30, "two a second here"
        assert pair.received == pair.sent
        assert pair.late == 0
        assert pair.age_p99_s is not None and pair.age_p99_s <= 0.2


@pytest.mark.slow
def test_what_the_radio_loses_is_counted_as_lost_whatever_comes_twice_or_overtaken() -> None:
    field = a_field(3, "ready", seed=2)
    field.air = replace(field.air, loss=0.3, duplication=0.1)
    found = listened(field, 120.0)
    share = sum(pair.received for pair in found) / sum(pair.sent for pair in found)
    assert share == pytest.approx(0.7, abs=0.04)
    # Two a second, from the first status that tells of them to the last: one in 2 s does, and the
    # radio loses those, too.
    assert all(2.0 * 110.0 < pair.sent <= 2.0 * 120.0 for pair in found)


def test_who_is_cut_off_is_heard_by_nobody() -> None:
    field = a_field(3, "ready")
    field.air = replace(field.air, partition=(frozenset({1}), frozenset({0, 2})))
    by_link = {(pair.sender, pair.receiver): pair.delivered for pair in listened(field, 22.0)}
    heard = {link for link, share in by_link.items() if share > 0.1}
    assert heard == {("r0", "r2"), ("r2", "r0")}


def told(field: Field) -> dict[str, str]:
    found = alarms(field.fleet.ground.node.station.setup, picture(field))
    return {a.robot: a.text for a in found if a.code is AlarmCode.NEIGHBOURS}


def test_in_flight_late_messages_are_an_alarm_as_lost_ones() -> None:
    field = a_field(3, "flying")
    field.run(SETTLED_S)
    assert told(field) == {}
    field.air = replace(field.air, delay_s=0.9)
    field.run(SETTLED_S)
    assert told(field)
    field.air = replace(field.air, delay_s=0.01, loss=0.6)
    field.run(SETTLED_S)
    # Now and then the statuses that would tell of it are lost, too.
    field.until(lambda: bool(told(field)), 5.0)
