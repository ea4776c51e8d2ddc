"""Faults of the drill, each with the promise of docs/faults.md and the bounds that follow from it.

Bounds are stated before the flights. `bounds.always` also holds in every flight; a fault that by
its nature may carry robots out of the fence says how far (`beyond_fence_m`).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from lpac.sim.drill import injections as do
from lpac.sim.drill.bounds import (
    POSITION_ERROR_M,
    Climbs,
    ComesBack,
    Criterion,
    Down,
    FallsSilent,
    FliesOn,
    Holds,
    KeepsAway,
    KeepsHeight,
    LandApart,
    Lands,
    LandsAtPad,
    LeavesMission,
    MissionEnds,
    MotorsOff,
    Moves,
    NotFaster,
    NotLandedBefore,
    RobotGroup,
    SentNothing,
    Stands,
    StaysDown,
    StaysNear,
    StraightDown,
    TakesOff,
    always,
)
from lpac.sim.drill.injections import Do
from lpac.sim.px4.errors import GREATEST_WIND_M_S
from lpac.sim.px4.modes import Px4Mode
from lpac.sim.px4.vehicle import Airframe, SimulatedSensor
from lpac.sim.px4.wire import MavlinkWire

Phase = Literal["ready", "takeoff", "mission", "return"]

EVER = math.inf
# From the greatest height of four robots, at PX4's speed of a landing without a position.
_DESCENT_S = 20.0 / 0.7
# Without GPS the vehicle cannot hold its position: it drifts with the wind until it is down.
ADRIFT_M = POSITION_ERROR_M + GREATEST_WIND_M_S * _DESCENT_S
ADRIFT = "without a position the wind carries it as it comes down, over the fence or onto another"
# A storm on top of the greatest wind carries a vehicle by their speed minus its airspeed, until the
# vehicle has stopped after it. No margin covers that.
_STORM_M_S, _STORM_S = 16.0, 10.0
_CARRIED_M_S = _STORM_M_S + GREATEST_WIND_M_S - Airframe().max_airspeed_m_s
_CARRIED_M = _CARRIED_M_S * (_STORM_S + 2.0)
# A hold is asked for 0.5 s after the last tick, and PX4 brakes.
_STANDS_AFTER_S = 2.5
# From any height of four robots down to the ground, and until the motors stop.
_LANDING_S = 45.0
# Across the field at full speed, and down.
_HOME_S = 35.0 + _LANDING_S
# Distance between landing points, and the stopping distance in gusts.
_PARTS_M = 8.0 + 3.0
# The receiver's error walks by up to 0.8 m between takeoff and landing, and gusts displace it.
_AT_PAD_M = 3.0

_OTHERS_FLY_ON = FliesOn(0.9, "others", until_s=20.0)
_OTHERS_TAKE_OFF = TakesOff(robots="others")
_OTHERS_HOME, _ALL_HOME = LandsAtPad(_AT_PAD_M, "others"), LandsAtPad(_AT_PAD_M, "all")
_ALL_FLY_ON = FliesOn(0.95, "all", until_s=20.0)
_MISSION_GOES_ON = (_ALL_FLY_ON, _ALL_HOME)
_STRAIGHT_DOWN, _DOWN = StraightDown(3.0), Down(_LANDING_S)
_PX4_LANDS_IT = (Lands(1.3), _STRAIGHT_DOWN, _DOWN, _OTHERS_FLY_ON)
_ONE_STAYS_DOWN = (StaysDown(), _OTHERS_TAKE_OFF)
# The watchdog commands it 0.5 s after the last tick; PX4 would land 1 s after the last setpoint.
_HOLDS = Holds(0.8)
_STANDS = Stands(from_s=_STANDS_AFTER_S, until_s=20.0)
# Commanded to stop after 1.1 s, or 1.9 s, it has slowed down by then even with a lag of 1.3 s, and
# has not begun to land.
_BRAKED = Stands(0.8, from_s=2.0, until_s=5.0)
_BRAKED_LATER = Stands(0.8, from_s=2.6, until_s=6.0)
# Displacement by a faulty receiver, while PX4 holds its position without it.
_NEAR_STILL = StaysNear(10.0, until_s=5.0)
# Off its height by 1.5 m for 2 s, as estimated; control and estimate may be half a metre off.
_SINKING_NOTICED = LeavesMission(2.3, below_m=2.0)
# Without a ground station robots hold, but move apart before they land in place.
_ALL_STOP = MissionEnds(3.8, "all")
_ALL_WAIT_AND_LAND = (
    _ALL_STOP,
    Stands(robots="all", from_s=7.0, until_s=12.5, may_part=True),
    StaysNear(_PARTS_M, "all", from_s=3.8, until_s=12.5),
    NotLandedBefore(12.5, "all"),
    Lands(14.0, "all"),
)
_ALL_DOWN = Down(14.0 + _LANDING_S, "all")


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of a fleet: injections and their times, and the bounds of a flight with it.

    `what` and `promise` are shown to people, and are of one robot unless they say otherwise. The
    fault begins in the `phase`, at a time drawn from the seed, and hits `hits` robots, also drawn
    (0: the whole fleet). The operator watches for `watched_s` and then brings all home, unless
    `home` is False. With `exact` robots know their
    positions. `settings` are further keys of robot.toml. By its nature the fault may carry the
    `carried` group by `beyond_fence_m` beyond the fence. `uncovered` says what no margin and no
    check prevents.
    """

    name: str
    what: str
    promise: str
    does: tuple[Do, ...]
    bounds: tuple[Criterion, ...]
    phase: Phase = "mission"
    hits: int = 1
    watched_s: float = 20.0
    home: bool = True
    exact: bool = False
    settings: tuple[tuple[str, str, object], ...] = ()
    beyond_fence_m: float = POSITION_ERROR_M
    carried: RobotGroup = "hit"
    uncovered: str = ""

    @property
    def judged_by(self) -> tuple[Criterion, ...]:
        """Bounds of every flight, and the fault's own."""
        return (*always(self.beyond_fence_m, self.carried), *self.bounds)


# Full thrust lifts less than the weight: the vehicle sinks at 1.2 m/s in the end, or 0.3 m/s.
_SINKS, _SINKS_SLOWLY = do.weaken_motors(0.57), do.weaken_motors(0.525)
# PX4 acts, by thresholds that preflight allows, before the robot does.
_CRITICAL_FOR_PX4 = (
    Do(do.set_parameter("BAT_LOW_THR", 0.5)),
    Do(do.set_parameter("BAT_CRIT_THR", 0.4)),
    Do(do.drain(0.38)),
)
# Another ground station repeats itself for as long as a takeoff may take.
_EACH_SECOND = range(180)
# Noticed after 3 s at most, and set back at once.
_SET_BACK_S = 5.0
_RC = ("failsafe", "rc", "pilot")

_FAULTS = (
    Fault(
        "none", "nothing fails",
        "takeoff, mission, return, each to its own pad",
        does=(), bounds=(_ALL_FLY_ON, Moves(2.0, "all", until_s=20.0), _ALL_HOME), hits=0,
        watched_s=20.0,
    ),
    # Programs
    Fault(
        "program-dies", "program dies (kill -9, crash)",
        "PX4 lands it in place, 1 s after its last setpoint",
        does=(Do(do.RobotProgram("dies")),), bounds=_PX4_LANDS_IT,
    ),
    Fault(
        "program-hangs", "program hangs (SIGSTOP)",
        "watchdog has PX4 hold after 0.5 s; lands 60 s later",
        does=(Do(do.ProgramStops(EVER)),),
        bounds=(
            _HOLDS, Stands(from_s=_STANDS_AFTER_S, until_s=55.0), NotLandedBefore(55.0),
            Lands(62.0), Down(62.0 + _LANDING_S), _OTHERS_FLY_ON,
        ),
        watched_s=75.0,
    ),
    Fault(
        "program-goes-on", "stopped program continues after 5 s (SIGCONT)",
        "sends nothing for 2 s; holds until start",
        does=(Do(do.ProgramStops(5.0)), Do(do.OperatorOrders("start"), 20.0, mark="start")),
        bounds=(
            _HOLDS, MissionEnds(0.6, until_s=19.9), SentNothing(from_s=0.3, until_s=6.9),
            Stands(from_s=_STANDS_AFTER_S, until_s=19.9), NotLandedBefore(35.0),
            FliesOn(0.8, from_s=4.0, until_s=14.0, after="start"), _OTHERS_FLY_ON, _ALL_HOME,
        ),
        watched_s=35.0,
    ),
    Fault(
        "control-hangs", "control loop hangs for 3 s",
        "watchdog has PX4 hold after 0.5 s; holds until start",
        does=(Do(do.LoopHangs("control", 3.0)),),
        bounds=(
            _HOLDS, MissionEnds(0.6), SentNothing(from_s=0.3, until_s=4.9), _STANDS,
            NotLandedBefore(20.0), _OTHERS_FLY_ON,
        ),
    ),
    Fault(
        "left-alone", "control loop hangs for 3 s, nobody answers",
        "lands in place after 60 s",
        does=(Do(do.LoopHangs("control", 3.0)),),
        bounds=(
            _HOLDS, MissionEnds(0.6), Stands(from_s=_STANDS_AFTER_S, until_s=60.0),
            NotLandedBefore(55.0), Lands(66.0), _STRAIGHT_DOWN,
        ),
        watched_s=70.0,
    ),
    Fault(
        "watchdog-dies-too", "program hangs, watchdog dead",
        "PX4 lands it 1 s after the last setpoint",
        does=(Do(do.RobotProgram("loses its watchdog")), Do(do.ProgramStops(EVER))),
        bounds=_PX4_LANDS_IT,
    ),
    Fault(
        "program-restarts", "program hangs for 3 s; systemd restarts it",
        "only observes; vehicle holds, lands 60 s later",
        does=(Do(do.ProgramStops(EVER)), Do(do.RobotProgram("starts"), 3.5)),
        bounds=(
            _HOLDS, Stands(from_s=_STANDS_AFTER_S, until_s=59.0), NotLandedBefore(55.0),
            Lands(66.0), Down(66.0 + _LANDING_S),
        ),
        watched_s=80.0,
    ),
    Fault(
        "program-restarts-at-once", "program dies, restarts 0.5 s later",
        "only observes: PX4 lands it",
        does=(Do(do.RobotProgram("dies")), Do(do.RobotProgram("starts"), 0.5)),
        bounds=(Lands(1.3), _DOWN, _OTHERS_FLY_ON),
    ),
    Fault(
        "policy-dies", "policy stops answering",
        "holds within 1 s, until start, which is refused",
        does=(Do(do.LoopHangs("policy", EVER)), Do(do.OperatorOrders("start"), 8.0)),
        bounds=(
            MissionEnds(1.3), Stands(from_s=4.0, until_s=20.0), NotLandedBefore(20.0),
            _OTHERS_FLY_ON, _ALL_HOME,
        ),
    ),
    Fault(
        "sensor-dies", "perception stops",
        "holds within 2 s",
        does=(Do(do.LoopHangs("perception", EVER)),),
        bounds=(
            MissionEnds(2.3), Stands(from_s=5.0, until_s=20.0), NotLandedBefore(20.0),
            _OTHERS_FLY_ON, _ALL_HOME,
        ),
    ),
    Fault(
        "autopilot-silent", "wire between computer and autopilot cut",
        "PX4 lands it 1 s after the last setpoint it got",
        does=(Do(do.disturb_wire(MavlinkWire(loss=1.0))),), bounds=_PX4_LANDS_IT,
    ),
    Fault(
        "disk-fills", "all disks full in flight",
        "alarm; flies on",
        does=(Do(do.DiskFills()),), bounds=_MISSION_GOES_ON, hits=0,
    ),
    Fault(
        "clock-steps", "wall clock steps by an hour",
        "flies on",
        does=(Do(do.ClockSteps(3600.0)),), bounds=_MISSION_GOES_ON,
    ),
    Fault(
        "clocks-step", "robots' wall clocks an hour back, laptop's ahead",
        "all fly on",
        does=(Do(do.ClockSteps(-3600.0)), Do(do.GroundClockSteps(3600.0))), bounds=_MISSION_GOES_ON,
        hits=0,
    ),
    Fault(
        "second-program", "another computer claims a robot's id",
        "that robot does not take off",
        does=(Do(do.SecondProgram()),), bounds=_ONE_STAYS_DOWN, phase="ready",
    ),
    Fault(
        "program-ends", "program stopped in flight, on_stop = land",
        "has PX4 land in place, ends",
        # Sooner than PX4 misses its setpoints.
        does=(Do(do.RobotProgram("ends")),),
        bounds=(Lands(0.9), _STRAIGHT_DOWN, _DOWN, _OTHERS_FLY_ON),
    ),
    Fault(
        "program-dies-in-takeoff", "program dies in the climb",
        "PX4 lands it in place",
        does=(Do(do.RobotProgram("dies"), 9.0),), bounds=(_OTHERS_TAKE_OFF, Down(9.0 + _LANDING_S)),
        phase="takeoff",
    ),
    # The wire to the autopilot
    *(
        Fault(
            f"link-loses-{percent}", f"{percent} % of MAVLink messages lost, either way",
            "alarm names the share; flies on",
            does=(Do(do.disturb_wire(MavlinkWire(loss=percent / 100.0))),), bounds=_MISSION_GOES_ON,
            hits=0,
        )
        for percent in (5, 10, 20, 30)
    ),
    Fault(
        "link-loses-30-before", "30 % of MAVLink messages lost from before takeoff",
        "takeoff may need a second order; those that fly come home",
        does=(Do(do.disturb_wire(MavlinkWire(loss=0.3))),), bounds=(_ALL_HOME,), phase="ready",
        hits=0, watched_s=60.0,
    ),
    Fault(
        "link-repeats", "MAVLink messages doubled, one 60 to 110 ms late",
        "alarm; flies on",
        does=(Do(do.disturb_wire(MavlinkWire(twice=1.0))),), bounds=_MISSION_GOES_ON, hits=0,
    ),
    Fault(
        "link-repeats-late", "MAVLink messages doubled, one 2 s late",
        "alarm; flies on",
        does=(Do(do.disturb_wire(MavlinkWire(twice=1.0, late_s=(1.9, 2.1)))),),
        bounds=_MISSION_GOES_ON, hits=0,
    ),
    Fault(
        "link-reorders", "one in five MAVLink messages overtaken, 60 to 110 ms late",
        "late counts as lost; flies on",
        does=(Do(do.disturb_wire(MavlinkWire(late=0.2))),), bounds=_MISSION_GOES_ON, hits=0,
    ),
    # Radio and ground
    Fault(
        "neighbours-silent", "robots hear the ground, not each other",
        "forgotten after 0.8 s; all fly on",
        does=(Do(do.RadioCut("from each other")),), bounds=(_ALL_FLY_ON,), hits=0,
    ),
    Fault(
        "neighbours-silent-before", "robots do not hear each other before takeoff",
        "nobody takes off",
        does=(Do(do.RadioCut("from each other")),), bounds=(StaysDown(robots="all"),),
        phase="ready", hits=0, home=False,
    ),
    Fault(
        "ground-lost", "robots and ground hear nothing of each other for 10 s",
        "hold after 3 s, until start",
        does=(Do(do.RadioCut("from the ground")), Do(do.RadioCut("none"), 10.0)),
        bounds=(
            _ALL_STOP, Stands(robots="all", from_s=7.0, until_s=25.0, may_part=True),
            StaysNear(_PARTS_M, "all", from_s=3.8, until_s=25.0), NotLandedBefore(25.0, "all"),
            _ALL_HOME,
        ),
        hits=0, watched_s=25.0,
    ),
    Fault(
        "ground-lost-for-good", "ground lost for good",
        "hold after 3 s; land in place after 13 s",
        does=(Do(do.RadioCut("from the ground")),),
        bounds=(*_ALL_WAIT_AND_LAND, StraightDown(3.0, "all"), LandApart(), _ALL_DOWN), hits=0,
        watched_s=30.0, home=False,
    ),
    Fault(
        "radio-dies", "nobody hears anybody again",
        "hold after 3 s; land in place after 13 s",
        does=(Do(do.RadioCut("all")),),
        bounds=(
            _ALL_STOP, Stands(robots="all", from_s=7.0, until_s=12.5), NotLandedBefore(12.5, "all"),
            Lands(14.0, "all"), StraightDown(3.0, "all"), _ALL_DOWN,
        ),
        hits=0, watched_s=30.0, home=False,
    ),
    Fault(
        "radio-silent", "all radios silent for 8 s",
        "hold after 3 s, until start",
        does=(
            Do(do.RadioCut("all")), Do(do.RadioCut("none"), 8.0),
            Do(do.OperatorOrders("start"), 15.0, "all", "start"),
        ),
        bounds=(
            MissionEnds(3.8, "all", until_s=14.9), NotLandedBefore(35.0, "all"),
            FliesOn(0.8, "all", from_s=5.0, until_s=19.0, after="start"), _ALL_HOME,
        ),
        hits=0, watched_s=35.0,
    ),
    Fault(
        "cut-in-halves", "swarm cut in halves for 20 s, ground with the first",
        "first flies on; second holds after 3 s, lands after 13 s",
        does=(Do(do.RadioCut("in halves")), Do(do.RadioCut("none"), 20.0)),
        bounds=(
            FliesOn(0.95, "first half", until_s=20.0),
            MissionEnds(3.8, "second half", until_s=20.0),
            Stands(robots="second half", from_s=7.0, until_s=12.5, may_part=True),
            StaysNear(_PARTS_M, "second half", from_s=3.8, until_s=12.5),
            NotLandedBefore(12.5, "second half"), Lands(14.0, "second half"),
            LandApart(robots="second half"), Down(14.0 + _LANDING_S, "second half"),
        ),
        hits=0, watched_s=40.0,
    ),
    Fault(
        "radio-loses-half", "half of all messages lost",
        "all fly on",
        does=(Do(do.RadioIs(loss=0.5)),), bounds=_MISSION_GOES_ON, hits=0,
    ),
    Fault(
        "radio-late", "messages 1.5 to 4.5 s late",
        "hold without a ground message younger than 3 s; none lands",
        does=(Do(do.RadioIs(delay_s=3.0)),), bounds=(NotLandedBefore(30.0, "all"), _ALL_HOME),
        hits=0, watched_s=30.0,
    ),
    Fault(
        "radio-very-late", "messages 4 to 12 s late",
        "hold after 3 s; land after 13 s",
        does=(Do(do.RadioIs(delay_s=8.0)),), bounds=_ALL_WAIT_AND_LAND, hits=0, watched_s=30.0,
    ),
    Fault(
        "radio-repeats", "messages doubled and out of order",
        "all fly on",
        does=(Do(do.RadioIs(duplication=1.0, delay_s=0.4)),), bounds=_MISSION_GOES_ON, hits=0,
    ),
    Fault(
        "radio-corrupts", "a bit flipped in half of all messages",
        "dropped; all fly on",
        does=(Do(do.RadioIs(corruption=0.5)),), bounds=_MISSION_GOES_ON, hits=0,
    ),
    Fault(
        "ground-sleeps", "laptop sleeps for 60 s",
        "hold after 3 s; land in place after 13 s, stay down",
        does=(Do(do.GroundStops(60.0)),), bounds=(*_ALL_WAIT_AND_LAND, LandApart(), _ALL_DOWN),
        hits=0, watched_s=70.0,
    ),
    Fault(
        "ground-dies", "laptop gone",
        "hold after 3 s; land in place after 13 s",
        does=(Do(do.Laptop("dies")),), bounds=(*_ALL_WAIT_AND_LAND, LandApart(), _ALL_DOWN),
        hits=0, watched_s=30.0, home=False,
    ),
    Fault(
        "ground-restarts", "laptop gone, back after 6 s",
        "hold after 3 s, until start",
        does=(
            Do(do.Laptop("dies")), Do(do.Laptop("starts"), 6.0),
            Do(do.OperatorOrders("start"), 16.0, "all", "start"),
        ),
        bounds=(
            MissionEnds(3.8, "all", until_s=15.9), NotLandedBefore(36.0, "all"),
            FliesOn(0.8, "all", from_s=5.0, until_s=19.0, after="start"), _ALL_HOME,
        ),
        hits=0, watched_s=36.0,
    ),
    Fault(
        "ground-dies-in-takeoff", "laptop gone in the climb",
        "climb on; land in place after 13 s",
        does=(Do(do.Laptop("dies"), 12.0, mark="gone"),),
        bounds=(Lands(14.5, "all", after="gone"), Down(12.0 + 14.5 + _LANDING_S, "all")),
        phase="takeoff", hits=0, watched_s=30.0, home=False,
    ),
    Fault(
        "ground-dies-in-return", "laptop gone on the way home",
        "hold after 3 s, land after 13 s; a landing goes on",
        does=(Do(do.Laptop("dies")),), bounds=(Lands(14.0, "all"), _ALL_DOWN), phase="return",
        hits=0, watched_s=30.0, home=False,
    ),
    # Positions
    Fault(
        "gps-lost", "no fix",
        "stands within 1.1 s, lands after 2.4 s, drifts from 5 s on",
        does=(Do(do.lose_gps()),), bounds=(_BRAKED, Lands(3.3), _DOWN, _OTHERS_FLY_ON),
        beyond_fence_m=ADRIFT_M, uncovered=ADRIFT,
    ),
    Fault(
        "gps-lost-for-a-moment", "no fix for 1 s",
        "stands; flies on after 3 good seconds",
        does=(Do(do.lose_gps()), Do(do.lose_gps(lost=False), 1.0)),
        bounds=(
            _BRAKED, NotLandedBefore(25.0), FliesOn(0.8, from_s=10.0, until_s=24.0), _OTHERS_FLY_ON,
            _ALL_HOME,
        ),
        watched_s=25.0,
    ),
    Fault(
        "gps-flickers", "fix comes and goes for over a minute",
        "stands; lands after 60 s",
        does=tuple(
            Do(do.lose_gps(lost=gap_s == 0.0), t + gap_s) for t in range(70) for gap_s in (0.0, 0.6)
        ),
        bounds=(
            Stands(from_s=4.0, until_s=58.0), NotLandedBefore(55.0), Lands(66.0), _OTHERS_FLY_ON,
        ),
        watched_s=75.0, beyond_fence_m=ADRIFT_M,
    ),
    Fault(
        "receiver-silent", "receiver silent",
        "stands within 1.9 s; lands after 3.5 s",
        does=(Do(do.silence(SimulatedSensor.GPS)),),
        bounds=(_BRAKED_LATER, Lands(4.5), _DOWN, _OTHERS_FLY_ON), beyond_fence_m=ADRIFT_M,
        uncovered=ADRIFT,
    ),
    Fault(
        "gps-inaccurate", "reported accuracy 7 m",
        "stands; lands after 60 s",
        does=(Do(do.report_accuracy(7.0)),),
        bounds=(
            Stands(from_s=4.0, until_s=58.0), NotLandedBefore(55.0), Lands(63.0), _OTHERS_FLY_ON,
        ),
        watched_s=75.0,
    ),
    Fault(
        "gps-useless", "reported accuracy 15 m",
        "stands; lands after 2 s",
        does=(Do(do.report_accuracy(15.0)),),
        bounds=(_BRAKED, Lands(3.5), _STRAIGHT_DOWN, _DOWN, _OTHERS_FLY_ON),
    ),
    Fault(
        "gps-jumps", "fix jumps 9 m, back after 5 s",
        "stands; lands after 2.5 s",
        does=(Do(do.jump_fix(9.0)), Do(do.jump_fix(0.0), 5.0)),
        bounds=(_BRAKED, Lands(3.5), StaysNear(10.0, until_s=60.0), _DOWN, _OTHERS_FLY_ON),
        watched_s=30.0, beyond_fence_m=POSITION_ERROR_M + 10.0,
    ),
    Fault(
        "gps-jumps-for-a-moment", "fix jumps 9 m, back after 1 s",
        "stands; flies on after 3 good seconds",
        does=(Do(do.jump_fix(9.0)), Do(do.jump_fix(0.0), 1.0)),
        bounds=(
            NotFaster(2.2, until_s=25.0), NotLandedBefore(30.0),
            FliesOn(0.9, from_s=12.0, until_s=30.0), _OTHERS_FLY_ON,
        ),
        watched_s=30.0, beyond_fence_m=POSITION_ERROR_M + 9.0,
    ),
    Fault(
        "receiver-stuck", "receiver repeats its fix at velocity 0",
        "stops within 1.5 s, lands 2 s later, drifts from 5 s on",
        does=(Do(do.repeat_fix()),),
        bounds=(_BRAKED, Lands(3.5), _NEAR_STILL, _DOWN, _OTHERS_FLY_ON), beyond_fence_m=ADRIFT_M,
        uncovered=ADRIFT,
    ),
    Fault(
        "receiver-stuck-in-still-air", "receiver repeats its fix, no wind",
        "stops within 1.5 s, lands 2 s later, at most 10 m away",
        does=(Do(do.repeat_fix()),),
        bounds=(Lands(3.5), StaysNear(10.0, until_s=60.0), _DOWN, _OTHERS_FLY_ON), exact=True,
        beyond_fence_m=POSITION_ERROR_M + 10.0,
    ),
    Fault(
        "receiver-creeps", "fix walks off at 2 m/s, its velocity honest",
        "stops within 3.7 s, lands 2 s later, drifts 5 s later",
        does=(Do(do.falsify_fixes(creep_m_s=2.0)),),
        bounds=(Lands(6.5), _NEAR_STILL, _DOWN, _OTHERS_FLY_ON), beyond_fence_m=ADRIFT_M,
        uncovered=ADRIFT,
    ),
    Fault(
        "receiver-races", "reported velocity wrong by 3 m/s",
        "stops within 1 s, lands after 5 s, drifts 5 s later",
        does=(Do(do.falsify_fixes(velocity_bias_m_s=3.0)),),
        bounds=(Lands(5.5), _NEAR_STILL, _DOWN, _OTHERS_FLY_ON), beyond_fence_m=ADRIFT_M,
        uncovered=ADRIFT,
    ),
    Fault(
        "receiver-scatters", "fixes scatter by 10 m, reported as accurate",
        "stops within 1.5 s, lands; drifts 5 s after PX4 rejects them",
        does=(Do(do.falsify_fixes(scatter_m=10.0)),),
        bounds=(Lands(35.0), _NEAR_STILL, _DOWN, _OTHERS_FLY_ON), beyond_fence_m=ADRIFT_M,
        uncovered=ADRIFT,
    ),
    Fault(
        "receiver-stuck-in-takeoff", "receiver repeats its fix in the climb",
        "lands; drifts from 5 s on",
        does=(Do(do.repeat_fix(), 10.0),), bounds=(Down(60.0), _OTHERS_TAKE_OFF), phase="takeoff",
        beyond_fence_m=ADRIFT_M, uncovered=ADRIFT,
    ),
    Fault(
        "receiver-stuck-in-return", "receiver repeats its fix on the way home",
        "lands; drifts from 5 s on",
        does=(Do(do.repeat_fix()),), bounds=(_NEAR_STILL, Down(60.0), _OTHERS_HOME), phase="return",
        beyond_fence_m=ADRIFT_M, uncovered=ADRIFT,
    ),
    Fault(
        "estimate-freezes", "autopilot repeats one position",
        "stands after 1.4 s; lands after 3 s",
        does=(Do(do.freeze_estimate()),), bounds=(_BRAKED_LATER, Lands(4.0), _DOWN, _OTHERS_FLY_ON),
        beyond_fence_m=ADRIFT_M, uncovered=ADRIFT,
    ),
    Fault(
        "gps-drifts", "position drifts 8 m in 40 s, beyond its budget",
        "unnoticed; may leave the fence by as much",
        does=(Do(do.drift_estimate(inwards_m_s=0.2)), Do(do.drift_estimate(), 40.0)),
        bounds=(_OTHERS_FLY_ON,), watched_s=45.0, beyond_fence_m=POSITION_ERROR_M + 8.0,
        uncovered="it comes nearer to the others and to the fence by its error beyond the budget",
    ),
    Fault(
        "height-drifts", "height drifts 2 m in 40 s, its whole budget",
        "unnoticed; the spacing of heights covers it",
        does=(Do(do.drift_estimate(down_m_s=0.05)), Do(do.drift_estimate(), 40.0)),
        bounds=(FliesOn(0.9, "all", until_s=40.0), _ALL_HOME), watched_s=45.0,
    ),
    Fault(
        "height-jumps", "estimated height jumps 5 m",
        "stays at its height; flies on after 3 s",
        does=(Do(do.jump_height(5.0)),),
        bounds=(
            KeepsHeight(1.6, until_s=20.0), FliesOn(0.8, from_s=10.0, until_s=24.0), _OTHERS_FLY_ON,
        ),
        watched_s=25.0,
    ),
    Fault(
        "origin-jumps", "estimator's origin moves 7 m in the plane, 5.6 m up",
        "position held back, then followed: no dash, height stays",
        does=(Do(do.jump_origin(5.6, -4.2, 5.6)),),
        bounds=(
            KeepsHeight(1.5, until_s=15.0), NotFaster(2.2, until_s=15.0),
            FliesOn(0.8, "all", until_s=20.0), _ALL_HOME,
        ),
    ),
    Fault(
        "compass-jumps", "heading reset by 35°",
        "flies on",
        does=(Do(do.jump_heading(35.0)),),
        bounds=(FliesOn(0.9, "all", until_s=20.0), LandsAtPad(_AT_PAD_M + 1.0, "all")),
        beyond_fence_m=POSITION_ERROR_M + 1.0,
    ),
    Fault(
        "gps-lost-in-takeoff", "no fix in the climb",
        "lands",
        does=(Do(do.lose_gps(), 10.0),), bounds=(Down(60.0), _OTHERS_TAKE_OFF), phase="takeoff",
        beyond_fence_m=ADRIFT_M, uncovered=ADRIFT,
    ),
    Fault(
        "gps-lost-before", "no fix before takeoff",
        "does not take off",
        does=(Do(do.lose_gps()),), bounds=_ONE_STAYS_DOWN, phase="ready",
    ),
    # Batteries, motors and air
    Fault(
        "battery-low", "battery below 25 %",
        "returns, lands at its pad",
        does=(Do(do.drain(0.245)),),
        bounds=(MissionEnds(4.0), _OTHERS_FLY_ON, LandsAtPad(_AT_PAD_M), Down(_HOME_S)),
        watched_s=60.0,
    ),
    Fault(
        "batteries-low", "five batteries, or all, below 25 %",
        "return at their own heights, land at their pads",
        does=(Do(do.drain(0.245)),),
        bounds=(MissionEnds(4.0), LandsAtPad(_AT_PAD_M), Down(_HOME_S)), hits=5, watched_s=60.0,
        home=False,
    ),
    Fault(
        "battery-critical", "battery below 15 %",
        "lands in place at once",
        does=(Do(do.drain(0.145)),), bounds=(Lands(3.5), _STRAIGHT_DOWN, _DOWN, _OTHERS_FLY_ON),
    ),
    Fault(
        "battery-critical-for-px4", "battery critical for PX4 alone",
        "PX4 holds, then lands; the robot lets it",
        does=_CRITICAL_FOR_PX4,
        bounds=(MissionEnds(1.5), Lands(8.0), Down(8.0 + _LANDING_S), _OTHERS_FLY_ON),
    ),
    Fault(
        "battery-silent", "battery not reported",
        "alarm; flies on",
        does=(Do(do.silence(SimulatedSensor.BATTERY)),),
        bounds=(FliesOn(0.9, "all", until_s=20.0),),
    ),
    Fault(
        "storm", "storm of 16 m/s for 10 s carries it over the fence",
        "flown back; 5 m beyond PX4 holds, lands after 60 s",
        does=(Do(do.blow(_STORM_M_S)), Do(do.blow(), _STORM_S)),
        bounds=(ComesBack(_STORM_S + 30.0), _OTHERS_FLY_ON), watched_s=90.0,
        beyond_fence_m=POSITION_ERROR_M + 5.0 + _CARRIED_M,
        uncovered="wind beyond its airspeed carries it, whatever it is told",
    ),
    Fault(
        "gusts", "gusts of 2 m/s rms besides the wind, on all",
        "all fly on",
        does=(Do(do.blow(gusts_m_s=2.0)),),
        bounds=(FliesOn(0.9, "all", until_s=20.0), LandsAtPad(_AT_PAD_M + 2.0, "all")), hits=0,
        beyond_fence_m=POSITION_ERROR_M + 2.0,
    ),
    Fault(
        "motor-weakens", "a motor weakens by a third of all thrust",
        "flies on",
        does=(Do(do.weaken_motors(0.33)),), bounds=(FliesOn(0.9, "all", until_s=20.0), _ALL_HOME),
    ),
    Fault(
        "sinks", "motors lift too little",
        "1.5 m low for 2 s: holds apart, lands 3 s later",
        does=(Do(_SINKS),),
        bounds=(_SINKING_NOTICED, Lands(8.5), Down(8.5 + _LANDING_S), _OTHERS_FLY_ON),
    ),
    Fault(
        "sinks-slowly", "sinks at 0.3 m/s",
        "as in sinks, later",
        does=(Do(_SINKS_SLOWLY),),
        bounds=(
            _SINKING_NOTICED, Lands(15.0), Down(15.0 + _LANDING_S),
            FliesOn(0.9, "others", until_s=30.0),
        ),
        watched_s=30.0,
    ),
    Fault(
        "sinks-in-takeoff", "motors lift too little in the climb",
        "holds, lands 3 s later",
        does=(Do(_SINKS, 9.0),), bounds=(_OTHERS_TAKE_OFF, Down(20.0 + _LANDING_S)),
        phase="takeoff",
    ),
    Fault(
        "sinks-in-return", "motors of two lift too little on the way home",
        "hold apart, land 3 s later",
        does=(Do(_SINKS),), bounds=(Down(20.0 + _LANDING_S), _OTHERS_HOME), phase="return", hits=2,
    ),
    Fault(
        "sinks-for-a-while", "motors lift too little for 7 s",
        "lands all the same, without climbing again",
        does=(Do(_SINKS), Do(do.weaken_motors(0.0), 7.0)),
        bounds=(_SINKING_NOTICED, Lands(8.5), Climbs(2.0), Down(8.5 + _LANDING_S), _OTHERS_FLY_ON),
    ),
    Fault(
        "does-not-climb", "motors do not lift it",
        "LAND, disarm after 15 s",
        does=(Do(do.weaken_motors(1.0)),), bounds=(_OTHERS_TAKE_OFF, Down(60.0)), phase="ready",
        watched_s=30.0,
    ),
    Fault(
        "sensor-dead-before", "barometer dead before takeoff",
        "does not take off",
        does=(Do(do.silence(SimulatedSensor.BAROMETER)),), bounds=_ONE_STAYS_DOWN, phase="ready",
    ),
    Fault(
        "battery-low-before", "battery at 30 % before takeoff",
        "does not take off",
        does=(Do(do.change_battery(0.30)),), bounds=_ONE_STAYS_DOWN, phase="ready",
    ),
    # People
    Fault(
        "pilot-takes-it", "pilot takes it, flies 15 s",
        "nothing more is sent until rejoin",
        does=(
            Do(do.pilot_flies(0.0, 0.0)), Do(do.pilot_flies(-1.0, 0.0), 2.0),
            Do(do.pilot_flies(), 8.0), Do(do.OperatorOrders("rejoin"), 15.0),
            Do(do.OperatorOrders("start"), 20.0, mark="start"),
        ),
        bounds=(
            FallsSilent(1.1, until_s=14.9), MissionEnds(1.1, until_s=19.9),
            FliesOn(0.8, from_s=4.0, until_s=14.0, after="start"), _OTHERS_FLY_ON, _ALL_HOME,
        ),
        watched_s=35.0, settings=(_RC,),
    ),
    Fault(
        "pilot-lands-it", "pilot takes it and lands",
        "nothing more is sent",
        does=(Do(do.pilot_flies()), Do(do.pilot_lands(), 6.0)),
        bounds=(FallsSilent(1.1), Down(8.0 + _LANDING_S), _OTHERS_FLY_ON), settings=(_RC,),
    ),
    Fault(
        "ground-station-holds-it", "another ground station sets hold",
        "nothing more is sent until rejoin",
        does=(Do(do.set_mode(Px4Mode.HOLD)), Do(do.OperatorOrders("rejoin"), 12.0)),
        bounds=(
            FallsSilent(1.2, until_s=11.9), Stands(from_s=3.0, until_s=20.0), NotLandedBefore(20.0),
            _OTHERS_FLY_ON,
        ),
    ),
    Fault(
        "ground-station-lands-it", "another ground station sets land",
        "lands, unopposed",
        does=(Do(do.set_mode(Px4Mode.LAND)),),
        bounds=(Lands(0.5), _STRAIGHT_DOWN, _DOWN, _OTHERS_FLY_ON),
    ),
    Fault(
        "parameter-changed",
        "another station has PX4 fly on without its program, which dies 5 s later",
        "alarm; set back in time: PX4 lands it",
        does=(
            Do(do.set_parameter("COM_OBL_RC_ACT", 5)), Do(do.set_parameter("COM_OF_LOSS_T", 30.0)),
            Do(do.set_parameter("GF_ACTION", 0)),
            Do(do.RobotProgram("dies"), _SET_BACK_S, mark="dies"),
        ),
        bounds=(
            FliesOn(0.9, until_s=_SET_BACK_S), Lands(1.3, after="dies"),
            Down(_SET_BACK_S + _LANDING_S), _OTHERS_FLY_ON,
        ),
    ),
    Fault(
        "fence-cleared", "another station clears PX4's fence; 5 s later 3 m beyond it",
        "alarm; uploaded again: PX4 holds",
        does=(
            Do(do.clear_fence()), Do(do.jump_outside(8.0), _SET_BACK_S),
            # Where it really is: it was carried nowhere.
            Do(do.set_mode(Px4Mode.LAND), _SET_BACK_S + 5.0),
        ),
        bounds=(
            FliesOn(0.9, until_s=_SET_BACK_S), Holds(_SET_BACK_S + 1.5), _OTHERS_FLY_ON,
            Down(_SET_BACK_S + 5.0 + _LANDING_S),
        ),
        uncovered="a robot that is wrong about its place reports a wrong place as it comes down",
    ),
    Fault(
        "parameter-changed-before", "another station sets a parameter each second",
        "does not take off",
        does=tuple(Do(do.set_parameter("COM_OBL_RC_ACT", 5), at_s) for at_s in _EACH_SECOND),
        bounds=_ONE_STAYS_DOWN, phase="ready",
    ),
    Fault(
        "fence-cleared-before", "another station clears PX4's fence each second",
        "does not take off",
        does=tuple(Do(do.clear_fence(), at_s) for at_s in _EACH_SECOND), bounds=_ONE_STAYS_DOWN,
        phase="ready",
    ),
    Fault(
        "remote-control-lost", "remote control lost, rc_lost = alarm",
        "alarm; flies on",
        does=(Do(do.lose_remote_control()),), bounds=(FliesOn(0.9, "all", until_s=20.0),),
        settings=(_RC,),
    ),
    Fault(
        "remote-control-lost-lands", "remote control lost, rc_lost = land",
        "LAND after 1.5 s; PX4 first holds for 5 s (COM_FAIL_ACT_T)",
        does=(Do(do.lose_remote_control()),),
        bounds=(MissionEnds(2.5), Lands(7.5), Down(7.5 + _LANDING_S)),
        settings=(_RC, ("failsafe", "rc_lost", "land")),
    ),
    Fault(
        "killed", "operator kills it",
        "motors stop, it falls; others fly on",
        does=(Do(do.OperatorOrders("kill")),), bounds=(MotorsOff(0.6), _OTHERS_FLY_ON),
    ),
    Fault(
        "held", "operator holds all",
        "stand in place until start",
        does=(Do(do.OperatorOrders("hold"), to="all"),),
        bounds=(
            MissionEnds(0.6, "all"), Stands(robots="all", from_s=4.0, until_s=20.0),
            NotLandedBefore(20.0, "all"),
        ),
        hits=0,
    ),
    Fault(
        "second-ground", "second ground joins, commands nothing",
        "robots obey the first",
        does=(Do(do.SecondLaptop("joins")),), bounds=_MISSION_GOES_ON, hits=0,
    ),
    Fault(
        "second-ground-holds", "second operator, not in command, holds all",
        "hold at once, until start",
        does=(Do(do.SecondLaptop("joins")), Do(do.SecondLaptop("holds all"), 6.0)),
        bounds=(
            FliesOn(0.95, "all", until_s=6.0), MissionEnds(7.0, "all"),
            Stands(robots="all", from_s=10.0, until_s=26.0), NotLandedBefore(26.0, "all"),
            _ALL_HOME,
        ),
        hits=0, watched_s=26.0,
    ),
    Fault(
        "second-ground-takes-command",
        "second operator takes command; the first orders hold, then land",
        "fly on; hold and land for the first, too",
        does=(
            Do(do.SecondLaptop("joins")), Do(do.SecondLaptop("takes command"), 6.0),
            Do(do.OperatorOrders("hold"), 16.0, "all"),
            Do(do.OperatorOrders("land"), 24.0, "all", "landed"),
        ),
        bounds=(
            FliesOn(0.95, "all", until_s=16.0), MissionEnds(17.0, "all"),
            Stands(robots="all", from_s=20.0, until_s=24.0), NotLandedBefore(24.0, "all"),
            Lands(1.5, "all", after="landed"), StraightDown(3.0, "all"),
            Down(25.5 + _LANDING_S, "all"),
        ),
        hits=0, watched_s=30.0, home=False,
    ),
    Fault(
        "second-ground-dies-in-command",
        "second operator takes command, is gone; the first looks on",
        "hold after 3 s; land in place after 13 s",
        does=(
            Do(do.SecondLaptop("joins")), Do(do.SecondLaptop("takes command"), 6.0),
            Do(do.SecondLaptop("dies"), 12.0, mark="gone"),
        ),
        bounds=(
            FliesOn(0.95, "all", until_s=12.0), MissionEnds(3.8, "all", after="gone"),
            Stands(robots="all", from_s=7.0, until_s=12.5, after="gone", may_part=True),
            StaysNear(_PARTS_M, "all", from_s=3.8, until_s=12.5, after="gone"),
            NotLandedBefore(24.5, "all"), Lands(14.0, "all", after="gone"), LandApart(),
            Down(26.0 + _LANDING_S, "all"),
        ),
        hits=0, watched_s=40.0, home=False,
    ),
    Fault(
        "landed", "operator lands all",
        "come straight down",
        does=(Do(do.OperatorOrders("land"), to="all"),),
        bounds=(Lands(1.0, "all"), StraightDown(3.0, "all"), Down(_LANDING_S, "all")), hits=0,
        home=False,
    ),
    Fault(
        "landed-in-takeoff", "operator lands all in the climb",
        "come straight down",
        does=(Do(do.OperatorOrders("land"), 10.0, "all", "ordered"),),
        bounds=(Lands(1.5, "all", after="ordered"), Down(12.0 + _LANDING_S, "all")),
        phase="takeoff", hits=0, home=False,
    ),
    Fault(
        "swapped-pads", "two stand on each other's pads",
        "neither takes off",
        does=(Do(do.carry_to_pad()), Do(do.carry_to_pad(-1), to="next")),
        bounds=(StaysDown(), StaysDown(robots="next")), phase="ready",
    ),
    Fault(
        "pad-taken-before", "stands beside another's landing point",
        "the other does not take off",
        # It stays there: its own battery is too low for a takeoff.
        does=(Do(do.carry_to_pad(offset_m=2.0)), Do(do.change_battery(0.30))),
        bounds=(StaysDown(), StaysDown(robots="next")), phase="ready", watched_s=30.0, exact=True,
    ),
    Fault(
        "pad-taken-in-flight", "one that landed is carried to another's pad",
        "the other lands beside it",
        does=(Do(do.OperatorOrders("land")), *(Do(do.carry_to_pad(), t) for t in (55.0, 60.0))),
        bounds=(_OTHERS_FLY_ON, LandsAtPad(8.0, "next")), watched_s=65.0, exact=True,
    ),
    Fault(
        "fence-without-a-pad", "fence set without its landing point",
        "does not take off",
        does=(Do(do.FenceWithout()),), bounds=(StaysDown(),), phase="ready", watched_s=30.0,
    ),
    Fault(
        "somebody-over-the-pad", "pilot hovers over another's pad at its height",
        "the one coming home keeps 1 m away, waits",
        does=(
            *(Do(do.pilot_flies_over(), float(t)) for t in range(80)),
            Do(do.OperatorOrders("return"), 45.0, "next"),
            # Up and home: nobody else could save a robot that the pilot hits or lands on.
            Do(do.pilot_flies(0.0, 2.0), 80.5),
            *(Do(do.pilot_flies_over(0), 84.0 + t) for t in range(20)), Do(do.pilot_lands(), 104.0),
        ),
        bounds=(KeepsAway(1.0), LandsAtPad(_AT_PAD_M, "next")), watched_s=105.0, exact=True,
        settings=(_RC,),
    ),
    Fault(
        "start-outside", "held beyond the fence; resume ordered",
        "start refused outside: flown back first",
        does=(
            Do(do.OperatorOrders("hold")), Do(do.jump_outside(4.5), 4.0),
            Do(do.OperatorOrders("resume"), 8.5, mark="start"),
            # With such an error it would come down anywhere, which no margin covers.
            Do(do.correct_estimate(), 20.0),
        ),
        # Later it may be back inside, and fly on.
        bounds=(MissionEnds(0.0, until_s=1.2, after="start"), _OTHERS_FLY_ON), watched_s=32.0,
    ),
    # Two at once
    Fault(
        "critical-and-held", "critical battery; all held 1 s later",
        "landing precedes hold",
        does=(Do(do.drain(0.145)), Do(do.OperatorOrders("hold"), 5.0, "all")),
        bounds=(
            Lands(3.5), _DOWN, Stands(robots="others", from_s=9.0, until_s=20.0, may_part=True),
            StaysNear(_PARTS_M, "others", from_s=6.0, until_s=20.0),
            NotLandedBefore(20.0, "others"),
        ),
    ),
    Fault(
        "critical-while-piloted", "critical battery under a pilot",
        "pilot precedes: nothing is sent",
        does=(Do(do.pilot_flies()), Do(do.drain(0.145), 3.0), Do(do.pilot_lands(), 12.0)),
        bounds=(FallsSilent(1.1), NotLandedBefore(11.9), _OTHERS_FLY_ON), settings=(_RC,),
    ),
    Fault(
        "killed-while-piloted", "operator kills it under a pilot",
        "kill precedes the pilot",
        does=(Do(do.pilot_flies()), Do(do.OperatorOrders("kill"), 3.0)),
        bounds=(MotorsOff(3.6), _OTHERS_FLY_ON), settings=(_RC,),
    ),
    Fault(
        "piloted-while-it-hangs", "control loop hangs; a pilot takes it meanwhile",
        "the loop, once back, leaves it to the pilot",
        does=(
            Do(do.LoopHangs("control", 3.0)), Do(do.pilot_flies(), 1.5), Do(do.pilot_lands(), 12.0),
        ),
        bounds=(_HOLDS, FallsSilent(0.6), _OTHERS_FLY_ON), settings=(_RC,),
    ),
    Fault(
        "low-battery-and-no-ground", "low battery; ground lost 2 s later",
        "returns, holds after 3 s, lands after 13 s",
        does=(Do(do.drain(0.245)), Do(do.RadioCut("from the ground"), 2.0)),
        bounds=(MissionEnds(6.0, "all"), Lands(16.5, "all"), Down(17.0 + _LANDING_S, "all")),
        watched_s=30.0, home=False,
    ),
    Fault(
        "gps-lost-and-radio-dies", "no fix, and the radio dies",
        "lands for its position, all others for the ground",
        does=(Do(do.lose_gps()), Do(do.RadioCut("all"))),
        bounds=(Lands(3.3), Lands(14.0, "others"), _ALL_DOWN), watched_s=30.0, home=False,
        beyond_fence_m=ADRIFT_M, uncovered=ADRIFT,
    ),
    Fault(
        "two-programs-die", "two programs die",
        "PX4 lands both; others fly on",
        does=(Do(do.RobotProgram("dies")),), bounds=_PX4_LANDS_IT, hits=2,
    ),
    Fault(
        "program-dies-as-the-ground-does", "program and ground die",
        "PX4 lands it after 1 s; others land after 13 s",
        does=(Do(do.RobotProgram("dies")), Do(do.Laptop("dies"))),
        bounds=(Lands(1.3), Lands(14.0, "others"), _ALL_DOWN), watched_s=30.0, home=False,
    ),
    Fault(
        "px4-lands-and-return", "battery critical for PX4; all ordered to return",
        "PX4's failsafe precedes the return",
        does=(*_CRITICAL_FOR_PX4, Do(do.OperatorOrders("return"), 2.0, "all")),
        bounds=(Lands(8.0), Down(8.0 + _LANDING_S), _OTHERS_HOME),
    ),
    Fault(
        "gps-lost-in-return", "no fix on the way home",
        "lands",
        does=(Do(do.lose_gps()),), bounds=(Down(60.0), _OTHERS_HOME), phase="return",
        beyond_fence_m=ADRIFT_M, uncovered=ADRIFT,
    ),
    Fault(
        "hangs-on-a-bad-radio", "program stops for 4 s, half of all messages lost",
        "holds until start; others fly on",
        does=(Do(do.RadioIs(loss=0.5)), Do(do.ProgramStops(4.0))),
        bounds=(_HOLDS, MissionEnds(0.6), _STANDS, NotLandedBefore(20.0), _OTHERS_FLY_ON),
    ),
    Fault(
        "origin-jumps-as-it-hangs", "control loop hangs for 2 s; the origin jumps",
        "holds in place",
        does=(Do(do.LoopHangs("control", 2.0)), Do(do.jump_origin(5.6, -4.2, 0.0), 1.0)),
        bounds=(_HOLDS, MissionEnds(0.6), _STANDS, NotLandedBefore(20.0), _OTHERS_FLY_ON),
    ),
    Fault(
        "rejoin-without-gps", "pilot has it, no fix; rejoin ordered",
        "rejoin refused: the pilot has it",
        does=(
            Do(do.pilot_flies()), Do(do.lose_gps(), 3.0), Do(do.OperatorOrders("rejoin"), 8.0),
            Do(do.pilot_lands(), 9.0),
        ),
        bounds=(FallsSilent(1.1), _OTHERS_FLY_ON), settings=(_RC,), beyond_fence_m=ADRIFT_M,
        uncovered=ADRIFT,
    ),
    Fault(
        "storm-and-low-battery", "gusts on all; its battery low",
        "returns, lands at its pad",
        does=(Do(do.blow(gusts_m_s=2.0), to="all"), Do(do.drain(0.245), 1.0)),
        bounds=(MissionEnds(5.0), LandsAtPad(_AT_PAD_M + 2.0), Down(1.0 + _HOME_S)), watched_s=60.0,
        beyond_fence_m=POSITION_ERROR_M + 2.0, carried="all",
    ),
)  # fmt: skip
FAULTS: Mapping[str, Fault] = {fault.name: fault for fault in _FAULTS}
# By short names for tables, the longest first.
SHARED_BOUNDS: Mapping[str, tuple[Criterion, ...]] = {
    "wait-land": _ALL_WAIT_AND_LAND,
    "px4-lands": _PX4_LANDS_IT,
    "fly-home": _MISSION_GOES_ON,
    "grounded": _ONE_STAYS_DOWN,
    "others-fly": (_OTHERS_FLY_ON,),
    "all-fly": (_ALL_FLY_ON,),
    "home": (_ALL_HOME,),
    "straight": (_STRAIGHT_DOWN,),
    "down": (_DOWN,),
    "px4-holds": (_HOLDS,),
    "brakes": (_BRAKED,),
    "near": (_NEAR_STILL,),
}
