"""What is late is never believed fresh, whatever is delayed by how much and from when on."""

from typing import NamedTuple

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from edge.core.aggregation import AggregatedMessage
from edge.core.fleet_time import FleetClock
from edge.messages.beacon import Beacon
from edge.robot.neighbours import NeighbourTable

MAX_AGE_S = 0.8
GROUND = 7
SENDER, RECEIVER = 1, 2
# Two quartzes' drift while messages travel, which is not aged, and the rounding of floats.
TOLERANCE_S = 0.02

delays_s = st.floats(0.0, 10.0)
# Since what was said before, and then how long it is on its way.
said = st.tuples(st.floats(0.0, 2.0), delays_s)


class Trip(NamedTuple):
    """A robot says something to the ground, which echoes it: all in true time, s."""

    robot: int
    said_s: float
    echoed_s: float
    came_s: float


class Clock(NamedTuple):
    """A monotonic clock, which began somewhere, and drifts."""

    began_s: float
    drift: float

    def at(self, true_s: float) -> float:
        return self.began_s + true_s * (1.0 + self.drift)


clocks = st.builds(Clock, st.floats(-1e5, 1e5), st.floats(-1e-4, 1e-4))


@given(
    own=st.tuples(clocks, clocks),
    ground=clocks,
    trips=st.lists(
        st.tuples(st.sampled_from((SENDER, RECEIVER)), said, st.floats(0.0, 0.3), delays_s),
        max_size=10,
    ),
    messages=st.lists(said, min_size=1, max_size=20),
)
def test_no_place_that_is_older_than_allowed_is_fresh(
    own: tuple[Clock, Clock],
    ground: Clock,
    trips: list[tuple[int, tuple[float, float], float, float]],
    messages: list[tuple[float, float]],
) -> None:
    clock_of = dict(zip((SENDER, RECEIVER), own, strict=True))
    knows, table = {robot: FleetClock() for robot in clock_of}, NeighbourTable(RECEIVER, MAX_AGE_S)
    sent: dict[int, Beacon] = {}

    def echo(trip: Trip) -> None:
        clock = clock_of[trip.robot]
        knows[trip.robot].update(
            GROUND,
            ground.at(trip.echoed_s),
            echoed_at_s=clock.at(trip.said_s),
            held_s=held_s[trip],
            now_s=clock.at(trip.came_s),
        )

    def send(sequence: int, true_s: float) -> None:
        when = knows[SENDER].at(clock_of[SENDER].at(true_s))
        # Where it was is when it was.
        sent[sequence] = Beacon(
            robot_id=SENDER, sent=when, position_m=(true_s, 0.0, 0.0),
            velocity_m_s=(0.0, 0.0, 0.0), frame_id=0, bundle_tag=0,
        )  # fmt: skip

    def receive(sequence: int, true_s: float) -> None:
        beacon, now_s = sent[sequence], clock_of[RECEIVER].at(true_s)
        age = None if beacon.sent is None else knows[RECEIVER].age_s(beacon.sent, now_s)
        message = AggregatedMessage(np.zeros(1, np.float32))
        table.receive(beacon, (1, sequence), message, now_s, None if age is None else age.most_s)

    happens: list[tuple[float, object]] = []
    held_s: dict[Trip, float] = {}
    at_s = 0.0
    for robot, (gap_s, there_s), held, back_s in trips:
        at_s += gap_s
        trip = Trip(robot, at_s, at_s + there_s + held, at_s + there_s + held + back_s)
        held_s[trip] = held
        happens.append((trip.came_s, lambda _, trip=trip: echo(trip)))
    at_s = 0.0
    for sequence, (gap_s, delay_s) in enumerate(messages):
        at_s += gap_s
        happens.append((at_s, lambda t, n=sequence: send(n, t)))
        happens.append((at_s + delay_s, lambda t, n=sequence: receive(n, t)))
    for true_s, do in sorted(happens, key=lambda each: each[0]):
        do(true_s)  # type: ignore[operator]
        for later_s in (0.0, 0.3, MAX_AGE_S):
            now_s = clock_of[RECEIVER].at(true_s + later_s)
            for received in (*table.neighbours(now_s), *table.swap(now_s)):
                assert received.beacon.position_m is not None
                said_at_s, _, _ = received.beacon.position_m
                assert true_s + later_s - said_at_s < MAX_AGE_S + TOLERANCE_S
