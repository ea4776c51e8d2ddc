"""Each bound of the drill sees what it is for, in flights that are made up."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from edge.core.fence import Fence
from edge.flight.margins import ErrorBudget
from lpac.analysis.flight import FaultRecord, FlightRecord, GivenOrder
from lpac.analysis.truth import TrueTrack
from lpac.sim.drill.bounds import (
    FALLS_M,
    PILOT_NOTICED_S,
    POSITION_ERROR_M,
    TOUCHDOWN_M_S,
    AllDown,
    AllKnown,
    Apart,
    BelowCeiling,
    CarriedBeyond,
    ComesBack,
    ComesDownGently,
    Criterion,
    Down,
    FallsSilent,
    FewCommands,
    Figure,
    FliesOn,
    Holds,
    InsideFence,
    KeepsAway,
    KeepsHeight,
    LandApart,
    Lands,
    LandsAtPad,
    MissionEnds,
    MotorsOff,
    Moves,
    NobodyFalls,
    NotFaster,
    NotLandedBefore,
    NoUnorderedStart,
    PilotIsAlone,
    RobotGroup,
    SentNothing,
    Stands,
    StaysDown,
    StaysNear,
    StraightDown,
    TakesOff,
    always,
)
from lpac.sim.drill.faults import FAULTS, Fault
from lpac.sim.px4.modes import Px4Mode

FENCE = Fence(((0.0, 0.0), (30.0, 0.0), (30.0, 30.0), (0.0, 30.0)), 1.5, 2.0, 25.0)
TIMES_S = np.arange(0.0, 60.0, 0.04)
ORDERS = (GivenOrder("takeoff", (0, 1), 4.0, 12.0),)
TAKEOFF_S, FAULT_S, LAND_S, DOWN_S = 5.0, 20.0, 40.0, 50.0


def a_vehicle(pad_m: tuple[float, float], height_m: float) -> TrueTrack:
    """Up at 5 s, a mission at 1 m/s along x from 20 s to 40 s, down by 50 s."""
    t = TIMES_S
    x_m = pad_m[0] + np.clip(t - FAULT_S, 0.0, LAND_S - FAULT_S) * 0.2
    up = np.clip((t - TAKEOFF_S) / 5.0, 0.0, 1.0) * np.clip((DOWN_S - t) / 10.0, 0.0, 1.0)
    z_m = height_m * np.where(t < LAND_S, np.clip((t - TAKEOFF_S) / 5.0, 0.0, 1.0), up)
    position_m = np.stack([x_m, np.full_like(t, pad_m[1]), z_m], axis=1)
    armed = (t >= TAKEOFF_S) & (t < DOWN_S)
    mode = np.where(t < LAND_S, Px4Mode.OFFBOARD, Px4Mode.LAND)
    return TrueTrack(
        time_s=t,
        position_m=position_m,
        airborne=z_m > 0.0,
        velocity_m_s=np.gradient(position_m, 0.04, axis=0),
        mode=np.where(armed, mode, Px4Mode.HOLD),
        armed=armed,
        setpoint_at_s=np.where(armed, np.minimum(np.floor(t * 10.0) / 10.0, LAND_S), -math.inf),
        is_velocity=(t >= 10.0) & (t < LAND_S),
        velocity_error_m_s=np.zeros_like(t),
        commands=(3.0 * t).astype(np.int64),
    )


def flight_of(*vehicles: TrueTrack, orders: tuple[GivenOrder, ...] = ORDERS) -> FlightRecord:
    return FlightRecord(
        name="drill", duration_s=0.0, from_s=0.0, to_s=60.0, robots=(), coverage=None,
        sensor_size=64, cost_time_s=np.zeros(0), fence=FENCE,
        truth={str(robot): vehicle for robot, vehicle in enumerate(vehicles)},
        fault=FaultRecord(
            hit=(0,), begin_s=FAULT_S, marks={"later": 30.0}, orders=orders,
            pads_m=np.array([[5.0, 5.0], [15.0, 15.0]]), drone_m=0.5,
        ),
    )  # fmt: skip


def changed(flight: FlightRecord, **fields: Any) -> FlightRecord:
    """The same, but for what the first vehicle did."""
    first, *others = flight.vehicles
    return flight_of(replace(first, **fields), *others)


def after(begin_s: float, value: Any, otherwise: Any, end_s: float = math.inf) -> Any:
    chosen = (begin_s <= TIMES_S) & (end_s > TIMES_S)
    if np.ndim(otherwise) == 2:
        chosen = chosen[:, None]
    return np.where(chosen, value, otherwise)


FIRST, SECOND = a_vehicle((5.0, 5.0), 5.0), a_vehicle((15.0, 15.0), 9.5)
WELL = flight_of(FIRST, SECOND)
FLOWN_M, BESIDE_M = FIRST.position_m, SECOND.position_m
AT_REST = replace(FIRST, velocity_m_s=np.zeros_like(FLOWN_M))
STANDS = flight_of(AT_REST, SECOND)
NEAR = flight_of(AT_REST, replace(SECOND, position_m=BESIDE_M - (8.0, 8.0, 0.0)))
# The second lands 8.5 m from its pad.
BESIDE = flight_of(FIRST, replace(SECOND, position_m=after(45.0, (15.0, 23.5, 0.0), BESIDE_M)))
STANDS_STILL = changed(WELL, position_m=after(FAULT_S, (5.0, 5.0, 5.0), FLOWN_M))
DRIFTS_M_S = after(25.0, (0.9, 0.0, 0.0), FLOWN_M * 0.0, 26.0)
PILOTED = after(25.0, Px4Mode.POSCTL, FIRST.mode, 30.0)
SILENT_S = np.minimum(FIRST.setpoint_at_s, FAULT_S)

# A bound, a flight that keeps it, and one that breaks it.
CASES: list[tuple[Criterion, FlightRecord, FlightRecord]] = [
    (Apart(), WELL, changed(WELL, position_m=after(30.0, BESIDE_M + 0.2, FLOWN_M, 30.1))),
    (
        # The one comes down where the other stands, which has landed.
        Apart(),
        WELL,
        changed(WELL, position_m=after(45.0, BESIDE_M * (1.0, 1.0, 0.0), FLOWN_M)),
    ),
    (
        InsideFence(-POSITION_ERROR_M),
        WELL,
        changed(WELL, position_m=after(30.0, (-7.0, 5.0, 5.0), FLOWN_M, 31.0)),
    ),
    # The fault carries the first one, which is hit, but not the second.
    (
        InsideFence(-POSITION_ERROR_M, "others"),
        changed(WELL, position_m=after(30.0, (-20.0, 5.0, 5.0), FLOWN_M, 31.0)),
        flight_of(FIRST, replace(FIRST, position_m=FLOWN_M - (30.0, 0.0, 0.0))),
    ),
    (
        CarriedBeyond(-25.0, "hit"),
        changed(WELL, position_m=after(30.0, (-20.0, 5.0, 5.0), FLOWN_M, 31.0)),
        changed(WELL, position_m=after(30.0, (-26.0, 5.0, 5.0), FLOWN_M, 31.0)),
    ),
    # Outside it is held, or flown as before.
    (
        ComesBack(3.0),
        changed(
            WELL,
            position_m=after(30.0, (-7.0, 5.0, 5.0), FLOWN_M, 33.0),
            mode=after(30.0, Px4Mode.HOLD, FIRST.mode, 33.0),
        ),
        changed(WELL, position_m=after(30.0, (-7.0, 5.0, 5.0), FLOWN_M, 33.0)),
    ),
    (AllKnown(), WELL, changed(WELL, position_m=after(30.0, math.nan, FLOWN_M, 30.1))),
    (AllKnown(), WELL, changed(WELL, velocity_m_s=after(30.0, math.nan, FLOWN_M, 30.1))),
    # Its motors stop above its pad, and start again on the same order.
    (NobodyFalls(FALLS_M), WELL, changed(WELL, armed=FIRST.armed & (TIMES_S < 45.0))),
    (NoUnorderedStart(), WELL, changed(WELL, armed=after(8.0, False, FIRST.armed, 9.0))),
    (
        NobodyFalls(FALLS_M),
        flight_of(
            replace(FIRST, armed=FIRST.armed & (TIMES_S < 45.0)),
            SECOND,
            orders=(*ORDERS, GivenOrder("kill", (0,), 44.9, 45.0)),
        ),
        changed(WELL, armed=FIRST.armed & (TIMES_S < 45.0)),
    ),
    (ComesDownGently(TOUCHDOWN_M_S), WELL, changed(WELL, velocity_m_s=FIRST.velocity_m_s * 5.0)),
    (Moves(2.0, until_s=15.0), WELL, STANDS_STILL),
    (
        Holds(1.0),
        changed(WELL, mode=after(FAULT_S + 0.6, Px4Mode.HOLD, FIRST.mode)),
        changed(WELL, mode=after(FAULT_S + 1.2, Px4Mode.HOLD, FIRST.mode)),
    ),
    (
        KeepsAway(5.0),
        WELL,
        changed(WELL, position_m=after(30.0, BESIDE_M + 2.0, FLOWN_M, 30.1)),
    ),
    (
        BelowCeiling(ErrorBudget().height_m),
        WELL,
        changed(WELL, position_m=after(30.0, (5.0, 5.0, 30.0), FLOWN_M, 31.0)),
    ),
    (NoUnorderedStart(), WELL, flight_of(FIRST, SECOND, orders=())),
    (
        NoUnorderedStart(),
        WELL,
        flight_of(FIRST, SECOND, orders=(GivenOrder("takeoff", (1,), 4.0, 12.0),)),
    ),
    (
        PilotIsAlone(PILOT_NOTICED_S),
        changed(WELL, mode=PILOTED, setpoint_at_s=np.minimum(FIRST.setpoint_at_s, 25.9)),
        changed(WELL, mode=PILOTED),
    ),
    (AllDown(), WELL, changed(WELL, armed=after(TAKEOFF_S, True, FIRST.armed))),
    (AllDown(), WELL, changed(WELL, position_m=after(45.0, (5.0, 5.0, 3.0), FLOWN_M))),
    (FewCommands(20), WELL, changed(WELL, commands=FIRST.commands + after(30.0, 200, 0))),
    (
        FewCommands(60, within_s=10.0),
        changed(WELL, commands=(5.0 * TIMES_S).astype(np.int64)),
        changed(WELL, commands=(8.0 * TIMES_S).astype(np.int64)),
    ),
    (Lands(20.5), WELL, changed(WELL, mode=after(0.0, Px4Mode.OFFBOARD, FIRST.mode, 45.0))),
    (
        Lands(10.5, after="later"),
        WELL,
        changed(WELL, mode=after(0.0, Px4Mode.HOLD, FIRST.mode, 49.0)),
    ),
    (NotLandedBefore(19.0), WELL, changed(WELL, mode=after(30.0, Px4Mode.LAND, FIRST.mode))),
    (Down(30.5), WELL, changed(WELL, armed=after(TAKEOFF_S, True, FIRST.armed, 55.0))),
    (Down(30.5), WELL, changed(WELL, armed=after(TAKEOFF_S, True, FIRST.armed))),
    (
        Stands(from_s=1.0, until_s=10.0),
        STANDS,
        changed(WELL, velocity_m_s=after(25.0, 0.9, FLOWN_M * 0.0, 26.0)),
    ),
    (
        # As fast as the estimate is wrong, it stands; faster, it does not.
        Stands(from_s=1.0, until_s=10.0),
        changed(STANDS, velocity_m_s=DRIFTS_M_S, velocity_error_m_s=np.full_like(TIMES_S, 0.5)),
        changed(STANDS, velocity_m_s=DRIFTS_M_S, velocity_error_m_s=np.full_like(TIMES_S, 0.3)),
    ),
    (
        # It leaves the other one, which is near; with nobody near it stands.
        Stands(from_s=1.0, until_s=10.0, may_part=True),
        changed(NEAR, velocity_m_s=DRIFTS_M_S),
        changed(STANDS, velocity_m_s=DRIFTS_M_S),
    ),
    (
        StaysNear(3.0, from_s=1.0, until_s=10.0),
        WELL,
        changed(WELL, position_m=after(25.0, 9.0, FLOWN_M, 26.0)),
    ),
    (LandApart(), WELL, changed(WELL, position_m=after(45.0, (19.0, 13.5, 0.0), FLOWN_M))),
    (StraightDown(3.0), WELL, changed(WELL, position_m=after(45.0, (14.0, 5.0, 0.0), FLOWN_M))),
    (LandsAtPad(4.5), WELL, changed(WELL, position_m=after(45.0, (14.0, 5.0, 0.0), FLOWN_M))),
    (
        # Beside the first, which lies 6 m from its pad, and by its own pad's side without a reason.
        LandsAtPad(4.5, "others"),
        changed(BESIDE, position_m=after(45.0, (11.0, 11.0, 0.0), FLOWN_M)),
        BESIDE,
    ),
    (
        FliesOn(0.9, until_s=15.0),
        WELL,
        changed(WELL, is_velocity=after(25.0, False, FIRST.is_velocity)),
    ),
    (MissionEnds(0.2), changed(WELL, is_velocity=TIMES_S < FAULT_S), WELL),
    (FallsSilent(0.2), changed(WELL, setpoint_at_s=SILENT_S), WELL),
    (
        SentNothing(from_s=1.0, until_s=3.0),
        changed(WELL, setpoint_at_s=after(FAULT_S, FAULT_S, FIRST.setpoint_at_s, 24.0)),
        WELL,
    ),
    (StaysDown(), changed(WELL, armed=np.zeros_like(FIRST.armed)), WELL),
    (TakesOff(robots="all"), WELL, changed(WELL, armed=np.zeros_like(FIRST.armed))),
    (MotorsOff(1.0), changed(WELL, armed=FIRST.armed & (TIMES_S < FAULT_S + 0.5)), WELL),
    (
        KeepsHeight(1.0, until_s=15.0),
        WELL,
        changed(WELL, position_m=after(30.0, FLOWN_M + np.array([0.0, 0.0, 2.0]), FLOWN_M, 32.0)),
    ),
    (
        NotFaster(1.0, until_s=15.0),
        WELL,
        changed(WELL, velocity_m_s=after(30.0, 1.5, FLOWN_M * 0.0, 31.0)),
    ),
]


@pytest.mark.parametrize(
    ("bound", "kept", "broken"), CASES, ids=[f"{type(case[0]).__name__}" for case in CASES]
)
def test_a_bound_sees_what_it_is_for(
    bound: Criterion, kept: FlightRecord, broken: FlightRecord
) -> None:
    assert not bound.figure(kept).broken, bound.figure(kept)
    assert bound.figure(broken).broken, bound.figure(broken)


def holds(fault: Fault) -> bool:
    """Whether somebody is to stand for longer than it takes until it has to land."""
    latest_s = {b.robots: b.limit for b in fault.bounds if isinstance(b, Lands)}
    return any(
        isinstance(b, Stands) and b.until_s < latest_s.get(b.robots, math.inf) for b in fault.bounds
    )


HOLDING = [fault for fault in FAULTS.values() if holds(fault)]


@pytest.mark.parametrize("fault", HOLDING, ids=lambda fault: fault.name)
def test_who_is_to_hold_and_lands_instead_breaks_a_promise(fault: Fault) -> None:
    held = tuple(
        replace(v, mode=np.where(v.mode == Px4Mode.OFFBOARD, Px4Mode.HOLD, v.mode))
        for v in STANDS.vehicles
    )
    # Soon after the fault, and softly.
    landed = tuple(replace(v, mode=after(FAULT_S + 3.0, Px4Mode.LAND, v.mode)) for v in held)
    one = flight_of(*landed)
    waits = [bound for bound in fault.bounds if isinstance(bound, NotLandedBefore)]
    assert any(bound.figure(one).broken for bound in waits)


def test_what_is_not_known_is_broken() -> None:
    assert Figure("share", math.nan, 0.5, "", at_least=True).broken
    assert Figure("speed", math.nan, 0.5, "m/s").broken
    assert not Figure("apart", math.inf, 0.5, "m", at_least=True).broken


def test_who_is_not_hit_is_judged_by_the_fence_whatever_carries_the_other() -> None:
    cases: tuple[tuple[RobotGroup, set[str]], ...] = (("hit", {"others", "hit"}), ("all", {"all"}))
    for carried, judged in cases:
        inside = [bound for bound in always(50.0, carried) if isinstance(bound, InsideFence)]
        assert {bound.robots for bound in inside} == judged
    assert [b for b in always(POSITION_ERROR_M, "hit") if isinstance(b, InsideFence)] == [
        InsideFence(-POSITION_ERROR_M)
    ]


def test_a_window_without_a_moment_is_broken() -> None:
    assert FliesOn(0.9, from_s=999.0, until_s=1000.0).figure(WELL).broken
