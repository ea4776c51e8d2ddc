"""The faults that are flown, each with what docs/safety.md promises then, and its bounds.

Bounds are stated here, before anything is flown. Where a fault may carry a robot out of the fence
by its nature, `beyond_fence_m` says how far; all else counts in every flight (`bounds.always`).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

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
    SentNothing,
    Stands,
    StaysDown,
    StaysNear,
    StraightDown,
    TakesOff,
    Whose,
    always,
)
from lpac.sim.drill.injections import (
    BatteryIs,
    CarriedToPad,
    ClockSteps,
    CompassJumps,
    DiskFills,
    Do,
    Drain,
    EstimateDrifts,
    EstimateFreezes,
    EstimateIsRight,
    EstimateJumpsOut,
    FenceCleared,
    FenceWithout,
    GroundClockSteps,
    GroundDies,
    GroundStarts,
    GroundStops,
    HeightJumps,
    LoopHangs,
    LoseGps,
    ModeIs,
    MotorWeakens,
    OperatorOrders,
    OriginJumps,
    ParameterIs,
    PilotFlies,
    PilotFliesOver,
    PilotLands,
    ProgramDies,
    ProgramEnds,
    ProgramStarts,
    ProgramStops,
    RadioCut,
    RadioIs,
    ReceiverJumps,
    ReceiverLies,
    ReceiverReports,
    ReceiverSticks,
    RemoteControl,
    SecondGroundDies,
    SecondGroundHolds,
    SecondGroundJoins,
    SecondGroundTakesCommand,
    SecondProgram,
    SensorDies,
    WatchdogDies,
    WindBlows,
    WireIs,
)
from lpac.sim.px4.errors import GREATEST_WIND_M_S
from lpac.sim.px4.modes import Px4Mode
from lpac.sim.px4.vehicle import Airframe, SimulatedSensor
from lpac.sim.px4.wire import MavlinkWire

Phase = Literal["ready", "takeoff", "mission", "return"]
Settings = Mapping[str, Mapping[str, object]]

EVER = math.inf
# From the greatest height of four robots, at PX4's speed of a landing without a position.
_DESCENT_S = 20.0 / 0.7
# Without GPS nothing holds a place any more, and the wind has it all the way down.
ADRIFT_M = POSITION_ERROR_M + GREATEST_WIND_M_S * _DESCENT_S
# A storm, and the greatest wind besides, carry a vehicle as fast as they blow beyond its airspeed,
# and until it has stopped: no margin covers that.
_STORM_M_S, _STORM_S = 16.0, 10.0
_CARRIED_M_S = _STORM_M_S + GREATEST_WIND_M_S - Airframe().max_airspeed_m_s
_CARRIED_M = _CARRIED_M_S * (_STORM_S + 2.0)
# A hold is asked for 0.5 s after the last tick, and PX4 brakes.
_STANDS_AFTER_S = 2.5
# The watchdog asks for it 0.5 s after the last tick; 1 s after the last setpoint PX4 would land.
_HOLDS = Holds(0.8)
# From any height of four robots down to the ground, and until the motors stop.
_LANDING_S = 45.0
# Across the field at full speed, and down.
_HOME_S = 35.0 + _LANDING_S
# Told to stop after 1.1 s, or 1.9 s, it is slower by then even with a lag of 1.3 s, and has not yet
# begun to land.
_BRAKED = Stands(2.0, 5.0, speed_m_s=0.8)
_BRAKED_LATER = Stands(2.6, 6.0, speed_m_s=0.8)
# Displaced by a receiver that lies, as long as PX4 keeps a place without it.
_NEAR_STILL = StaysNear(0.0, 5.0, 10.0)
# Without a ground they stand, but part before they come down where they are.
_WAIT = Stands(7.0, 12.5, "all", may_part=True)
# Full thrust lifts less than the weight: the vehicle sinks at 1.2 m/s in the end, or 0.3 m/s.
_SINKS, _SINKS_SLOWLY = MotorWeakens(0.57), MotorWeakens(0.525)
# Off its height by 1.5 m for 2 s, as estimated; control and estimate may be half a metre off.
_SINKING_NOTICED = LeavesMission(below_m=2.0, within_s=2.3)
# By no more than landing points lie apart; before that they stop, and gusts carry them.
_PARTS_M = 8.0 + 3.0
_PART = StaysNear(3.8, 12.5, _PARTS_M, "all")
# Its receiver's error walks by up to 0.8 m between takeoff and landing, and gusts carry it.
_AT_PAD_M = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """A fault done to a fleet: its injections, their times, and what is promised then.

    `what` happens, `promise` in words; both are for people. It begins in the `phase`, at a time
    that the seed draws, and hits so many robots, which the seed draws too (0: the whole fleet, at
    once). The operator looks on for `watched_s`, then brings all home; `home` is False where he
    does nothing any more. With `exact` the robots know where they are. `settings` are further keys
    of robot.toml. The fault by its nature brings who is `carried` so far outside the fence.
    `uncovered` says what no margin and no check prevents then, "" if there is nothing.
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
    carried: Whose = "hit"
    uncovered: str = ""

    @property
    def judged_by(self) -> tuple[Criterion, ...]:
        """Bounds of every flight, and the fault's own."""
        return (*always(self.beyond_fence_m, self.carried), *self.bounds)


def _once(*injections: object) -> tuple[Do, ...]:
    return tuple(Do(0.0, injection) for injection in injections)  # type: ignore[arg-type]


# PX4 acts, by thresholds that preflight allows, before the robot does.
_CRITICAL_FOR_PX4 = ParameterIs("BAT_LOW_THR", 0.5), ParameterIs("BAT_CRIT_THR", 0.4), Drain(0.38)
# What another ground station does again and again, for as long as a takeoff may take.
_EACH_SECOND = range(180)
# Noticed after 3 s at most, and set back at once.
_SET_BACK_S = 5.0
_NOBODY = "nothing happens"
_ADRIFT = "without a position the wind carries it as it comes down, over the fence or onto another"

NOMINAL = Fault(
    name="none", what="nothing fails",
    promise="takeoff, mission, return, each to its own pad",
    does=(), hits=0, watched_s=20.0,
    bounds=(FliesOn(20.0, 0.95, "all"), Moves(2.0, 20.0), LandsAtPad(_AT_PAD_M, "all")),
)  # fmt: skip

_PROGRAMS = (
    Fault(
        name="program-dies", what="a robot's program dies (kill -9, crash)",
        promise="PX4 lands the vehicle where it is, 1 s after its last setpoint",
        does=_once(ProgramDies()),
        bounds=(Lands(1.3), StraightDown(3.0), Down(_LANDING_S), FliesOn(20.0)),
    ),
    Fault(
        name="program-hangs", what="a robot's program stands still (SIGSTOP, the interpreter held)",
        promise="the watchdog has PX4 hold after 0.5 s; it lands 60 s later",
        does=_once(ProgramStops(EVER)), watched_s=75.0,
        bounds=(
            _HOLDS, Stands(_STANDS_AFTER_S, 55.0), NotLandedBefore(55.0), Lands(62.0),
            Down(62.0 + _LANDING_S), FliesOn(20.0),
        ),
    ),
    Fault(
        name="program-goes-on", what="a stopped program is continued after 5 s (SIGCONT)",
        promise="nothing is sent for 2 s; it holds where the vehicle is, until start is ordered",
        does=(*_once(ProgramStops(5.0)), Do(20.0, OperatorOrders("start"), mark="start")),
        watched_s=35.0,
        bounds=(
            _HOLDS, MissionEnds(0.6, 19.9), SentNothing(0.3, 6.9), Stands(_STANDS_AFTER_S, 19.9),
            NotLandedBefore(35.0),
            FliesOn(14.0, 0.8, "hit", 4.0, "start"), FliesOn(20.0), LandsAtPad(_AT_PAD_M, "all"),
        ),
    ),
    Fault(
        name="control-hangs", what="the control loop alone hangs, for 3 s",
        promise="the watchdog has PX4 hold after 0.5 s; the robot holds until start is ordered",
        does=_once(LoopHangs("control", 3.0)),
        bounds=(
            _HOLDS, MissionEnds(0.6), SentNothing(0.3, 4.9), Stands(_STANDS_AFTER_S, 20.0),
            NotLandedBefore(20.0), FliesOn(20.0),
        ),
    ),
    Fault(
        name="left-alone", what="the control loop hangs for 3 s, and nobody answers",
        promise="the robot lands where it is after 60 s",
        does=_once(LoopHangs("control", 3.0)), watched_s=70.0,
        bounds=(
            _HOLDS, MissionEnds(0.6), Stands(_STANDS_AFTER_S, 60.0), NotLandedBefore(55.0),
            Lands(66.0), StraightDown(3.0),
        ),
    ),
    Fault(
        name="watchdog-dies-too", what="a program stands still, and its watchdog is dead",
        promise="PX4 lands 1 s after the last setpoint",
        does=_once(WatchdogDies(), ProgramStops(EVER)),
        bounds=(Lands(1.3), StraightDown(3.0), Down(_LANDING_S), FliesOn(20.0)),
    ),
    Fault(
        name="program-restarts", what="a program hangs for 3 s, and systemd starts it again",
        promise="the new one only observes; the vehicle stays in hold and lands 60 s later",
        does=(*_once(ProgramStops(EVER)), Do(3.5, ProgramStarts())), watched_s=80.0,
        bounds=(
            _HOLDS, Stands(_STANDS_AFTER_S, 59.0), NotLandedBefore(55.0), Lands(66.0),
            Down(66.0 + _LANDING_S),
        ),
    ),
    Fault(
        name="program-restarts-at-once", what="a program dies, and starts again 0.5 s later",
        promise="it only observes: PX4 lands, as it would without",
        does=(*_once(ProgramDies()), Do(0.5, ProgramStarts())),
        bounds=(Lands(1.3), Down(_LANDING_S), FliesOn(20.0)),
    ),
    Fault(
        name="policy-dies", what="a robot's policy gives no answer any more",
        promise="the robot holds within 1 s, until start is ordered, which is refused",
        does=(*_once(LoopHangs("policy", EVER)), Do(8.0, OperatorOrders("start"))),
        bounds=(
            MissionEnds(1.3), Stands(4.0, 20.0), NotLandedBefore(20.0), FliesOn(20.0),
            LandsAtPad(_AT_PAD_M, "all"),
        ),
    ),
    Fault(
        name="sensor-dies", what="a robot's perception gives nothing any more",
        promise="the robot holds within 2 s",
        does=_once(LoopHangs("perception", EVER)),
        bounds=(
            MissionEnds(2.3), Stands(5.0, 20.0), NotLandedBefore(20.0), FliesOn(20.0),
            LandsAtPad(_AT_PAD_M, "all"),
        ),
    ),
    Fault(
        name="autopilot-silent",
        what="the wire between a robot's computer and its autopilot is cut",
        promise="PX4 lands 1 s after the last setpoint that reached it",
        does=_once(WireIs(MavlinkWire(loss=1.0))),
        bounds=(Lands(1.3), StraightDown(3.0), Down(_LANDING_S), FliesOn(20.0)),
    ),
    Fault(
        name="disk-fills", what="all robots' disks are full in flight",
        promise="an alarm; the mission goes on",
        does=_once(DiskFills()), hits=0,
        bounds=(FliesOn(20.0, 0.95, "all"), LandsAtPad(_AT_PAD_M, "all")),
    ),
    Fault(
        name="clock-steps", what="a robot's wall clock steps by an hour",
        promise=_NOBODY,
        does=_once(ClockSteps(3600.0)),
        bounds=(FliesOn(20.0, 0.95, "all"), LandsAtPad(_AT_PAD_M, "all")),
    ),
    Fault(
        name="clocks-step", what="all robots' wall clocks step back by an hour, the laptop's ahead",
        promise=_NOBODY,
        does=_once(ClockSteps(-3600.0), GroundClockSteps(3600.0)), hits=0,
        bounds=(FliesOn(20.0, 0.95, "all"), LandsAtPad(_AT_PAD_M, "all")),
    ),
    Fault(
        name="second-program", what="another computer says that it is one of the robots",
        promise="that one does not take off",
        phase="ready", does=_once(SecondProgram()),
        bounds=(StaysDown(), TakesOff("others")),
    ),
    Fault(
        name="program-ends", what="a robot's program is stopped in flight, and on_stop = land",
        promise="it has PX4 land the vehicle where it is, and ends",
        # Sooner than PX4 misses its setpoints.
        does=_once(ProgramEnds()),
        bounds=(Lands(0.9), StraightDown(3.0), Down(_LANDING_S), FliesOn(20.0)),
    ),
    Fault(
        name="program-dies-in-takeoff", what="a robot's program dies while it climbs",
        promise="PX4 lands it where it is",
        phase="takeoff", does=(Do(9.0, ProgramDies()),),
        bounds=(TakesOff("others"), Down(9.0 + _LANDING_S)),
    ),
)  # fmt: skip

_MISSION_GOES_ON = (FliesOn(20.0, 0.95, "all"), LandsAtPad(_AT_PAD_M, "all"))

_WIRES = (
    *(
        Fault(
            name=f"link-loses-{percent}",
            what=f"{percent} % of all MAVLink messages are lost, either way",
            promise="the mission goes on, with an alarm that names the share",
            does=_once(WireIs(MavlinkWire(loss=percent / 100.0))), hits=0, bounds=_MISSION_GOES_ON,
        )
        for percent in (5, 10, 20, 30)
    ),
    Fault(
        name="link-loses-30-before",
        what="30 % of all MAVLink messages are lost, from before takeoff on",
        promise="a takeoff may have to be ordered again; who takes off flies and comes home",
        phase="ready", does=_once(WireIs(MavlinkWire(loss=0.3))), hits=0, watched_s=60.0,
        bounds=(LandsAtPad(_AT_PAD_M, "all"),),
    ),
    Fault(
        name="link-repeats", what="MAVLink messages come twice, once 60 to 110 ms late",
        promise="the mission goes on, with an alarm that says so",
        does=_once(WireIs(MavlinkWire(twice=1.0))), hits=0, bounds=_MISSION_GOES_ON,
    ),
    Fault(
        name="link-repeats-late", what="MAVLink messages come twice, once 2 s late",
        promise="the mission goes on, with an alarm that says so",
        does=_once(WireIs(MavlinkWire(twice=1.0, late_s=(1.9, 2.1)))), hits=0,
        bounds=_MISSION_GOES_ON,
    ),
    Fault(
        name="link-reorders", what="each fifth MAVLink message is overtaken, by 60 to 110 ms",
        promise="it counts as lost; the mission goes on",
        does=_once(WireIs(MavlinkWire(late=0.2))), hits=0, bounds=_MISSION_GOES_ON,
    ),
)  # fmt: skip

_RADIO = (
    Fault(
        name="neighbours-silent", what="robots hear nothing of each other, but the ground",
        promise="they are forgotten after 0.8 s; the mission goes on",
        does=_once(RadioCut("from each other")), hits=0,
        bounds=(FliesOn(20.0, 0.95, "all"),),
    ),
    Fault(
        name="neighbours-silent-before",
        what="robots hear nothing of each other before takeoff, but the ground",
        promise="nobody takes off: they would not keep apart",
        phase="ready", does=_once(RadioCut("from each other")), hits=0, home=False,
        bounds=(StaysDown("all"),),
    ),
    Fault(
        name="ground-lost", what="no robot hears the ground any more, nor it them, for 10 s",
        promise="they hold after 3 s, and until start is ordered",
        does=(*_once(RadioCut("from the ground")), Do(10.0, RadioCut("none"))), hits=0,
        watched_s=25.0,
        bounds=(
            MissionEnds(3.8, whose="all"), Stands(7.0, 25.0, "all", may_part=True),
            StaysNear(3.8, 25.0, _PARTS_M, "all"),
            NotLandedBefore(25.0, "all"), LandsAtPad(_AT_PAD_M, "all"),
        ),
    ),
    Fault(
        name="ground-lost-for-good", what="the ground is never heard again",
        promise="hold after 3 s, land where they are after 13 s",
        does=_once(RadioCut("from the ground")), hits=0, home=False, watched_s=30.0,
        bounds=(
            MissionEnds(3.8, whose="all"), _WAIT, _PART, NotLandedBefore(12.5, "all"),
            Lands(14.0, "all"), StraightDown(3.0, "all"), LandApart(),
            Down(14.0 + _LANDING_S, "all"),
        ),
    ),
    Fault(
        name="radio-dies", what="an access point that never comes back: nobody hears anybody",
        promise="hold after 3 s, land where they are after 13 s",
        does=_once(RadioCut("all")), hits=0, home=False, watched_s=30.0,
        bounds=(
            MissionEnds(3.8, whose="all"), Stands(7.0, 12.5, "all"), NotLandedBefore(12.5, "all"),
            Lands(14.0, "all"), StraightDown(3.0, "all"), Down(14.0 + _LANDING_S, "all"),
        ),
    ),
    Fault(
        name="radio-silent", what="all radios are silent at once, for 8 s",
        promise="they hold after 3 s, and until start is ordered",
        does=(*_once(RadioCut("all")), Do(8.0, RadioCut("none")), Do(15.0, OperatorOrders("start"),
              "all", "start")),
        hits=0, watched_s=35.0,
        bounds=(
            MissionEnds(3.8, 14.9, "all"), NotLandedBefore(35.0, "all"),
            FliesOn(19.0, 0.8, "all", 5.0, "start"), LandsAtPad(_AT_PAD_M, "all"),
        ),
    ),
    Fault(
        name="cut-in-halves", what="the swarm is cut in halves for 20 s, the ground with the first",
        promise="the first half flies on; the second holds after 3 s, and lands after 13 s",
        does=(*_once(RadioCut("in halves")), Do(20.0, RadioCut("none"))), hits=0, watched_s=40.0,
        bounds=(
            FliesOn(20.0, 0.95, "first half"), MissionEnds(3.8, 20.0, "second half"),
            Stands(7.0, 12.5, "second half", may_part=True),
            StaysNear(3.8, 12.5, _PARTS_M, "second half"),
            NotLandedBefore(12.5, "second half"), Lands(14.0, "second half"),
            LandApart("second half"), Down(14.0 + _LANDING_S, "second half"),
        ),
    ),
    Fault(
        name="radio-loses-half", what="every other message is lost",
        promise="the mission goes on",
        does=_once(RadioIs(loss=0.5)), hits=0,
        bounds=(FliesOn(20.0, 0.95, "all"), LandsAtPad(_AT_PAD_M, "all")),
    ),
    Fault(
        name="radio-late", what="all messages come 3 s late, 1.5 to 4.5 s",
        promise="a robot that has no word from the ground younger than 3 s holds; none lands",
        does=_once(RadioIs(delay_s=3.0)), hits=0, watched_s=30.0,
        bounds=(NotLandedBefore(30.0, "all"), LandsAtPad(_AT_PAD_M, "all")),
    ),
    Fault(
        name="radio-very-late", what="all messages come 8 s late, 4 to 12 s",
        promise="a late ground is a lost one: hold after 3 s; it still lands them",
        does=_once(RadioIs(delay_s=8.0)), hits=0, watched_s=30.0,
        bounds=(
            MissionEnds(3.8, whose="all"), _WAIT, _PART, NotLandedBefore(12.5, "all"),
            Lands(14.0, "all"),
        ),
    ),
    Fault(
        name="radio-repeats", what="all messages come twice, and overtake each other",
        promise="the mission goes on",
        does=_once(RadioIs(duplication=1.0, delay_s=0.4)), hits=0,
        bounds=(FliesOn(20.0, 0.95, "all"), LandsAtPad(_AT_PAD_M, "all")),
    ),
    Fault(
        name="radio-corrupts", what="every other message arrives with a flipped bit",
        promise="it is not used; the mission goes on",
        does=_once(RadioIs(corruption=0.5)), hits=0,
        bounds=(FliesOn(20.0, 0.95, "all"), LandsAtPad(_AT_PAD_M, "all")),
    ),
    Fault(
        name="ground-sleeps", what="the operator's laptop sleeps for 60 s",
        promise="hold after 3 s, land where they are after 13 s; they stay down when it wakes",
        does=_once(GroundStops(60.0)), hits=0, watched_s=70.0,
        bounds=(
            MissionEnds(3.8, whose="all"), _WAIT, _PART, NotLandedBefore(12.5, "all"),
            Lands(14.0, "all"), LandApart(), Down(14.0 + _LANDING_S, "all"),
        ),
    ),
    Fault(
        name="ground-dies", what="the operator's laptop is gone",
        promise="hold after 3 s, land where they are after 13 s",
        does=_once(GroundDies()), hits=0, home=False, watched_s=30.0,
        bounds=(
            MissionEnds(3.8, whose="all"), _WAIT, _PART, NotLandedBefore(12.5, "all"),
            Lands(14.0, "all"), LandApart(), Down(14.0 + _LANDING_S, "all"),
        ),
    ),
    Fault(
        name="ground-restarts", what="the operator's laptop is gone, and back after 6 s",
        promise="hold after 3 s, and until start is ordered",
        does=(
            *_once(GroundDies()), Do(6.0, GroundStarts()),
            Do(16.0, OperatorOrders("start"), "all", "start"),
        ),
        hits=0, watched_s=36.0,
        bounds=(
            MissionEnds(3.8, 15.9, "all"), NotLandedBefore(36.0, "all"),
            FliesOn(19.0, 0.8, "all", 5.0, "start"), LandsAtPad(_AT_PAD_M, "all"),
        ),
    ),
    Fault(
        name="ground-dies-in-takeoff", what="the operator's laptop is gone while they climb",
        promise="the takeoff goes on meanwhile; they land where they are after 13 s",
        phase="takeoff", does=(Do(12.0, GroundDies(), mark="gone"),), hits=0, home=False,
        watched_s=30.0,
        bounds=(Lands(14.5, "all", "gone"), Down(12.0 + 14.5 + _LANDING_S, "all")),
    ),
    Fault(
        name="ground-dies-in-return", what="the operator's laptop is gone on the way home",
        promise="a robot on its way holds after 3 s, lands after 13 s; one that lands goes on",
        phase="return", does=_once(GroundDies()), hits=0, home=False, watched_s=30.0,
        bounds=(Lands(14.0, "all"), Down(14.0 + _LANDING_S, "all")),
    ),
)  # fmt: skip

_POSITIONS = (
    Fault(
        name="gps-lost", what="a robot's receiver has no fix any more",
        promise="it stands within 1.1 s, and lands 2.4 s after the loss; the wind has it from 5 s",
        uncovered=_ADRIFT,
        does=_once(LoseGps()), beyond_fence_m=ADRIFT_M,
        bounds=(_BRAKED, Lands(3.3), Down(_LANDING_S), FliesOn(20.0)),
    ),
    Fault(
        name="gps-lost-for-a-moment", what="a robot's receiver has no fix for 1 s",
        promise="it stands, and flies on once all was well for 3 s",
        does=(*_once(LoseGps()), Do(1.0, LoseGps(lost=False))), watched_s=25.0,
        bounds=(
            _BRAKED, NotLandedBefore(25.0), FliesOn(24.0, 0.8, "hit", 10.0), FliesOn(20.0),
            LandsAtPad(_AT_PAD_M, "all"),
        ),
    ),
    Fault(
        name="gps-flickers", what="a robot's fix comes and goes, for longer than a minute",
        promise="it stands, and lands after 60 s",
        does=tuple(
            Do(t + gap_s, LoseGps(lost=gap_s == 0.0)) for t in range(70) for gap_s in (0.0, 0.6)
        ),
        watched_s=75.0, beyond_fence_m=ADRIFT_M,
        bounds=(Stands(4.0, 58.0), NotLandedBefore(55.0), Lands(66.0), FliesOn(20.0)),
    ),
    Fault(
        name="receiver-silent", what="a robot's receiver says nothing any more",
        promise="it stands 1.9 s after the receiver's last word, and lands after 3.5 s",
        uncovered=_ADRIFT,
        does=_once(SensorDies(SimulatedSensor.GPS)), beyond_fence_m=ADRIFT_M,
        bounds=(_BRAKED_LATER, Lands(4.5), Down(_LANDING_S), FliesOn(20.0)),
    ),
    Fault(
        name="gps-inaccurate", what="a robot's receiver says that it is accurate to 7 m only",
        promise="it stands where it is, and lands after 60 s",
        does=_once(ReceiverReports(7.0)), watched_s=75.0,
        bounds=(Stands(4.0, 58.0), NotLandedBefore(55.0), Lands(63.0), FliesOn(20.0)),
    ),
    Fault(
        name="gps-useless", what="a robot's receiver says that it is accurate to 15 m only",
        promise="it stands, and lands after 2 s",
        does=_once(ReceiverReports(15.0)),
        bounds=(_BRAKED, Lands(3.5), StraightDown(3.0), Down(_LANDING_S), FliesOn(20.0)),
    ),
    Fault(
        name="gps-jumps", what="a robot's fix jumps by 9 m, and back after 5 s",
        promise="it stands, and lands after 2.5 s",
        does=(*_once(ReceiverJumps(9.0)), Do(5.0, ReceiverJumps(0.0))), watched_s=30.0,
        beyond_fence_m=POSITION_ERROR_M + 10.0,
        bounds=(_BRAKED, Lands(3.5), StaysNear(0.0, 60.0, 10.0), Down(_LANDING_S), FliesOn(20.0)),
    ),
    Fault(
        name="gps-jumps-for-a-moment", what="a robot's fix jumps by 9 m, and back after 1 s",
        promise="it stands, and flies on once nothing spoke against it for 3 s",
        does=(*_once(ReceiverJumps(9.0)), Do(1.0, ReceiverJumps(0.0))), watched_s=30.0,
        beyond_fence_m=POSITION_ERROR_M + 9.0,
        bounds=(
            NotFaster(2.2, 25.0), NotLandedBefore(30.0), FliesOn(30.0, 0.9, "hit", 12.0),
            FliesOn(20.0),
        ),
    ),
    Fault(
        name="receiver-stuck", what="a robot's receiver repeats its last fix, with a velocity of 0",
        promise="it stops within 1.5 s, lands 2 s later, and the wind has it from 5 s on",
        uncovered=_ADRIFT,
        does=_once(ReceiverSticks()), beyond_fence_m=ADRIFT_M,
        bounds=(_BRAKED, Lands(3.5), _NEAR_STILL, Down(_LANDING_S), FliesOn(20.0)),
    ),
    Fault(
        name="receiver-stuck-in-still-air", what="the same, and no wind blows",
        promise="it stops within 1.5 s, lands 2 s later, and is displaced by at most 10 m",
        does=_once(ReceiverSticks()), beyond_fence_m=POSITION_ERROR_M + 10.0, exact=True,
        bounds=(Lands(3.5), StaysNear(0.0, 60.0, 10.0), Down(_LANDING_S), FliesOn(20.0)),
    ),
    Fault(
        name="receiver-creeps", what="a robot's fix walks off at 2 m/s, and its velocity is honest",
        promise="it stops within 3.7 s, lands 2 s later, and the wind has it 5 s later",
        uncovered=_ADRIFT,
        does=_once(ReceiverLies(creep_m_s=2.0)), beyond_fence_m=ADRIFT_M,
        bounds=(Lands(6.5), _NEAR_STILL, Down(_LANDING_S), FliesOn(20.0)),
    ),
    Fault(
        name="receiver-races", what="a robot's receiver tells a velocity that is wrong by 3 m/s",
        promise="it stops within 1 s, lands 5 s after the fault, and the wind has it 5 s later",
        uncovered=_ADRIFT,
        does=_once(ReceiverLies(velocity_bias_m_s=3.0)), beyond_fence_m=ADRIFT_M,
        bounds=(Lands(5.5), _NEAR_STILL, Down(_LANDING_S), FliesOn(20.0)),
    ),
    Fault(
        name="receiver-scatters", what="a robot's fixes scatter by 10 m, and claim to be accurate",
        promise="it stops within 1.5 s, and lands; 5 s after PX4 rejects it the wind has it",
        uncovered=_ADRIFT,
        does=_once(ReceiverLies(scatter_m=10.0)), beyond_fence_m=ADRIFT_M,
        bounds=(Lands(35.0), _NEAR_STILL, Down(_LANDING_S), FliesOn(20.0)),
    ),
    Fault(
        name="receiver-stuck-in-takeoff", what="a robot's receiver repeats its fix as it climbs",
        promise="it lands, and the wind has it from 5 s on",
        uncovered=_ADRIFT,
        phase="takeoff", does=(Do(10.0, ReceiverSticks()),), beyond_fence_m=ADRIFT_M,
        bounds=(Down(60.0), TakesOff("others")),
    ),
    Fault(
        name="receiver-stuck-in-return", what="a robot's receiver repeats its fix on its way home",
        promise="it lands, and the wind has it from 5 s on",
        uncovered=_ADRIFT,
        phase="return", does=_once(ReceiverSticks()), beyond_fence_m=ADRIFT_M,
        bounds=(_NEAR_STILL, Down(60.0), LandsAtPad(_AT_PAD_M, "others")),
    ),
    Fault(
        name="estimate-freezes", what="a robot's autopilot tells the same position again and again",
        promise="it stands after 1.4 s, and lands 3 s after the freeze",
        uncovered=_ADRIFT,
        does=_once(EstimateFreezes()), beyond_fence_m=ADRIFT_M,
        bounds=(_BRAKED_LATER, Lands(4.0), Down(_LANDING_S), FliesOn(20.0)),
    ),
    Fault(
        name="gps-drifts", what="a robot's position drifts by 8 m in 40 s: more than its budget",
        promise="nothing notices it, and no margin covers it: beyond the fence by so much",
        uncovered="it comes as near to the others, and to the fence, as its error is too large",
        does=(*_once(EstimateDrifts(inwards_m_s=0.2)), Do(40.0, EstimateDrifts())), watched_s=45.0,
        beyond_fence_m=POSITION_ERROR_M + 8.0,
        bounds=(FliesOn(20.0),),
    ),
    Fault(
        name="height-drifts", what="a robot's height drifts by 2 m within 40 s: its whole budget",
        promise="nothing notices it; the heights' distance covers it",
        does=(*_once(EstimateDrifts(down_m_s=0.05)), Do(40.0, EstimateDrifts())), watched_s=45.0,
        bounds=(FliesOn(40.0, 0.9, "all"), LandsAtPad(_AT_PAD_M, "all")),
    ),
    Fault(
        name="height-jumps", what="a robot's estimate of height jumps by 5 m",
        promise="it stays at its height, and flies on after 3 s",
        does=_once(HeightJumps(5.0)), watched_s=25.0,
        bounds=(KeepsHeight(1.6, 20.0), FliesOn(24.0, 0.8, "hit", 10.0), FliesOn(20.0)),
    ),
    Fault(
        name="origin-jumps", what="the estimator's origin moves, by 7 m in the plane and 5.6 m up",
        promise="the position is held back and then followed: no dash, and the height stays",
        does=_once(OriginJumps((5.6, -4.2, 5.6))),
        bounds=(
            KeepsHeight(1.5, 15.0), NotFaster(2.2, 15.0), FliesOn(20.0, 0.8, "all"),
            LandsAtPad(_AT_PAD_M, "all"),
        ),
    ),
    Fault(
        name="compass-jumps", what="a robot's heading is reset by 35 degrees in flight",
        promise="it flies on",
        does=_once(CompassJumps(35.0)), beyond_fence_m=POSITION_ERROR_M + 1.0,
        bounds=(FliesOn(20.0, 0.9, "all"), LandsAtPad(_AT_PAD_M + 1.0, "all")),
    ),
    Fault(
        name="gps-lost-in-takeoff", what="a robot's receiver has no fix any more while it climbs",
        promise="it lands",
        uncovered=_ADRIFT,
        phase="takeoff", does=(Do(10.0, LoseGps()),), beyond_fence_m=ADRIFT_M,
        bounds=(Down(60.0), TakesOff("others")),
    ),
    Fault(
        name="gps-lost-before", what="a robot's receiver has no fix before takeoff",
        promise="it does not take off",
        phase="ready", does=_once(LoseGps()),
        bounds=(StaysDown(), TakesOff("others")),
    ),
)  # fmt: skip

_ENERGY_AND_AIR = (
    Fault(
        name="battery-low", what="a robot's battery falls below 25 %",
        promise="it returns, and lands at its pad",
        does=_once(Drain(0.245)), watched_s=60.0,
        bounds=(MissionEnds(4.0), FliesOn(20.0), LandsAtPad(_AT_PAD_M), Down(_HOME_S)),
    ),
    Fault(
        name="batteries-low", what="five batteries, or all, fall below 25 % at once",
        promise="all return, at their own heights, and land at their pads",
        does=_once(Drain(0.245)), hits=5, home=False, watched_s=60.0,
        bounds=(MissionEnds(4.0), LandsAtPad(_AT_PAD_M), Down(_HOME_S)),
    ),
    Fault(
        name="battery-critical", what="a robot's battery falls below 15 %",
        promise="it lands where it is, at once",
        does=_once(Drain(0.145)),
        bounds=(Lands(3.5), StraightDown(3.0), Down(_LANDING_S), FliesOn(20.0)),
    ),
    Fault(
        name="battery-critical-for-px4", what="a battery is critical for PX4, not for the robot",
        promise="PX4 holds, and then lands; the robot does not take it from PX4",
        does=_once(*_CRITICAL_FOR_PX4),
        bounds=(MissionEnds(1.5), Lands(8.0), Down(8.0 + _LANDING_S), FliesOn(20.0)),
    ),
    Fault(
        name="battery-silent", what="nothing is told of a robot's battery any more",
        promise="an alarm; the mission goes on",
        does=_once(SensorDies(SimulatedSensor.BATTERY)),
        bounds=(FliesOn(20.0, 0.9, "all"),),
    ),
    Fault(
        name="storm", what="a storm of 16 m/s carries a robot over the fence, for 10 s",
        promise="it is flown back; 5 m beyond the fence PX4 holds it, and it lands after 60 s",
        uncovered="wind beyond its airspeed carries it, whatever it is told",
        does=(*_once(WindBlows(_STORM_M_S)), Do(_STORM_S, WindBlows())), watched_s=90.0,
        beyond_fence_m=POSITION_ERROR_M + 5.0 + _CARRIED_M,
        bounds=(ComesBack(_STORM_S + 30.0), FliesOn(20.0)),
    ),
    Fault(
        name="gusts", what="gusts of 2 m/s (standard deviation) besides the wind, on all",
        promise="the mission goes on",
        does=_once(WindBlows(gusts_m_s=2.0)), hits=0, beyond_fence_m=POSITION_ERROR_M + 2.0,
        bounds=(FliesOn(20.0, 0.9, "all"), LandsAtPad(_AT_PAD_M + 2.0, "all")),
    ),
    Fault(
        name="motor-weakens", what="a motor weakens in flight, by a third of all thrust",
        promise="the mission goes on",
        does=_once(MotorWeakens(0.33)),
        bounds=(FliesOn(20.0, 0.9, "all"), LandsAtPad(_AT_PAD_M, "all")),
    ),
    Fault(
        name="sinks", what="a robot's motors lift too little in flight, and it sinks",
        promise="1.5 m below its height for 2 s: it holds, apart from others, and lands 3 s later",
        does=_once(_SINKS),
        bounds=(_SINKING_NOTICED, Lands(8.5), Down(8.5 + _LANDING_S), FliesOn(20.0)),
    ),
    Fault(
        name="sinks-slowly", what="a robot's motors lift a little too little: it sinks at 0.3 m/s",
        promise="as one that sinks faster, but later",
        does=_once(_SINKS_SLOWLY), watched_s=30.0,
        bounds=(_SINKING_NOTICED, Lands(15.0), Down(15.0 + _LANDING_S), FliesOn(30.0)),
    ),
    Fault(
        name="sinks-in-takeoff", what="a robot's motors lift too little while it climbs",
        promise="it holds, and lands 3 s later",
        phase="takeoff", does=(Do(9.0, _SINKS),),
        bounds=(TakesOff("others"), Down(20.0 + _LANDING_S)),
    ),
    Fault(
        name="sinks-in-return", what="a robot's motors lift too little on its way home",
        promise="it holds, apart from others, and lands 3 s later",
        phase="return", does=_once(_SINKS), hits=2,
        bounds=(Down(20.0 + _LANDING_S), LandsAtPad(_AT_PAD_M, "others")),
    ),
    Fault(
        name="sinks-for-a-while", what="a robot's motors lift too little for 7 s",
        promise="it lands all the same, and does not climb to its height again",
        does=(*_once(_SINKS), Do(7.0, MotorWeakens(0.0))),
        bounds=(
            _SINKING_NOTICED, Lands(8.5), Climbs(2.0), Down(8.5 + _LANDING_S), FliesOn(20.0),
        ),
    ),
    Fault(
        name="does-not-climb", what="a robot's motors do not lift it",
        promise="it gives up after 15 s: LAND, disarm",
        phase="ready", does=_once(MotorWeakens(1.0)), watched_s=30.0,
        bounds=(TakesOff("others"), Down(60.0)),
    ),
    Fault(
        name="sensor-dead-before", what="a robot's barometer is dead before takeoff",
        promise="it does not take off",
        phase="ready", does=_once(SensorDies(SimulatedSensor.BAROMETER)),
        bounds=(StaysDown(), TakesOff("others")),
    ),
    Fault(
        name="battery-low-before", what="a robot's battery is at 30 % before takeoff",
        promise="it does not take off",
        phase="ready", does=_once(BatteryIs(0.30)),
        bounds=(StaysDown(), TakesOff("others")),
    ),
)  # fmt: skip

_RC = ("failsafe", "rc", "pilot")

_PEOPLE = (
    Fault(
        name="pilot-takes-it", what="a pilot takes a robot by remote control, and flies it 15 s",
        promise="nothing is sent to it any more; it is its own until the operator orders rejoin",
        settings=(_RC,),
        does=(
            *_once(PilotFlies(0.0, 0.0)), Do(2.0, PilotFlies(-1.0, 0.0)), Do(8.0, PilotFlies()),
            Do(15.0, OperatorOrders("rejoin")), Do(20.0, OperatorOrders("start"), mark="start"),
        ),
        watched_s=35.0,
        bounds=(
            FallsSilent(1.1, 14.9), MissionEnds(1.1, 19.9), FliesOn(14.0, 0.8, "hit", 4.0, "start"),
            FliesOn(20.0), LandsAtPad(_AT_PAD_M, "all"),
        ),
    ),
    Fault(
        name="pilot-lands-it", what="a pilot takes a robot, and lands it",
        promise="nothing is sent to it any more",
        settings=(_RC,),
        does=(*_once(PilotFlies()), Do(6.0, PilotLands())),
        bounds=(FallsSilent(1.1), Down(8.0 + _LANDING_S), FliesOn(20.0)),
    ),
    Fault(
        name="ground-station-holds-it", what="somebody's ground station sets PX4's hold",
        promise="the program lets go: nothing is sent to it any more, until rejoin",
        does=(*_once(ModeIs(Px4Mode.HOLD)), Do(12.0, OperatorOrders("rejoin"))),
        bounds=(
            FallsSilent(1.2, 11.9), Stands(3.0, 20.0), NotLandedBefore(20.0), FliesOn(20.0),
        ),
    ),
    Fault(
        name="ground-station-lands-it", what="somebody's ground station sets PX4's landing",
        promise="it is not fought for: it lands",
        does=_once(ModeIs(Px4Mode.LAND)),
        bounds=(Lands(0.5), StraightDown(3.0), Down(_LANDING_S), FliesOn(20.0)),
    ),
    Fault(
        name="parameter-changed",
        what="another ground station lets PX4 fly on without its program, which dies 5 s later",
        promise="an alarm, and the robot has set it back: PX4 lands the vehicle",
        does=(
            *_once(
                ParameterIs("COM_OBL_RC_ACT", 5), ParameterIs("COM_OF_LOSS_T", 30.0),
                ParameterIs("GF_ACTION", 0),
            ),
            Do(_SET_BACK_S, ProgramDies(), mark="dies"),
        ),
        bounds=(
            FliesOn(_SET_BACK_S, 0.9, "hit"), Lands(1.3, after="dies"),
            Down(_SET_BACK_S + _LANDING_S), FliesOn(20.0),
        ),
    ),
    Fault(
        name="fence-cleared",
        what="another ground station clears PX4's fence; 5 s later the robot is 3 m beyond it",
        promise="an alarm, and the robot has uploaded it again: PX4 holds the vehicle",
        does=(
            *_once(FenceCleared()), Do(_SET_BACK_S, EstimateJumpsOut(8.0)),
            # Where it really is: it was carried nowhere.
            Do(_SET_BACK_S + 5.0, ModeIs(Px4Mode.LAND)),
        ),
        uncovered="who does not know where it is tells the others a wrong place as it comes down",
        bounds=(
            FliesOn(_SET_BACK_S, 0.9, "hit"), Holds(_SET_BACK_S + 1.5), FliesOn(20.0),
            Down(_SET_BACK_S + 5.0 + _LANDING_S),
        ),
    ),
    Fault(
        name="parameter-changed-before",
        what="another ground station sets a parameter of PX4 each second before takeoff",
        promise="it does not take off",
        phase="ready",
        does=tuple(Do(at_s, ParameterIs("COM_OBL_RC_ACT", 5)) for at_s in _EACH_SECOND),
        bounds=(StaysDown(), TakesOff("others")),
    ),
    Fault(
        name="fence-cleared-before",
        what="another ground station clears PX4's fence each second before takeoff",
        promise="it does not take off",
        phase="ready", does=tuple(Do(at_s, FenceCleared()) for at_s in _EACH_SECOND),
        bounds=(StaysDown(), TakesOff("others")),
    ),
    Fault(
        name="remote-control-lost", what="a robot's remote control is lost, and rc_lost = alarm",
        promise="an alarm; the mission goes on",
        settings=(_RC,), does=(Do(0.0, RemoteControl(on=False)),),
        bounds=(FliesOn(20.0, 0.9, "all"),),
    ),
    Fault(
        name="remote-control-lost-lands", what="a remote control is lost, and rc_lost = land",
        promise="it is told to land after 1.5 s; PX4 holds it for COM_FAIL_ACT_T (5 s) first",
        settings=(_RC, ("failsafe", "rc_lost", "land")),
        does=(Do(0.0, RemoteControl(on=False)),),
        bounds=(MissionEnds(2.5), Lands(7.5), Down(7.5 + _LANDING_S)),
    ),
    Fault(
        name="killed", what="the operator kills a robot",
        promise="the motors stop, and the vehicle falls; the others fly on",
        does=_once(OperatorOrders("kill")),
        bounds=(MotorsOff(0.6), FliesOn(20.0)),
    ),
    Fault(
        name="held", what="the operator holds all",
        promise="they stand where they are, until start is ordered",
        does=(Do(0.0, OperatorOrders("hold"), "all"),), hits=0,
        bounds=(
            MissionEnds(0.6, whose="all"), Stands(4.0, 20.0, "all"), NotLandedBefore(20.0, "all"),
        ),
    ),
    Fault(
        name="second-ground", what="a second operator's ground joins, and commands nothing",
        promise="robots go on obeying the first one",
        does=_once(SecondGroundJoins()), hits=0,
        bounds=(FliesOn(20.0, 0.95, "all"), LandsAtPad(_AT_PAD_M, "all")),
    ),
    Fault(
        name="second-ground-holds", what="a second operator, who does not command, holds all",
        promise="they hold at once, until start is ordered",
        does=(*_once(SecondGroundJoins()), Do(6.0, SecondGroundHolds())), hits=0, watched_s=26.0,
        bounds=(
            FliesOn(6.0, 0.95, "all"), MissionEnds(7.0, whose="all"), Stands(10.0, 26.0, "all"),
            NotLandedBefore(26.0, "all"), LandsAtPad(_AT_PAD_M, "all"),
        ),
    ),
    Fault(
        name="second-ground-takes-command",
        what="a second operator takes the command, and the first one orders hold, then land",
        promise="the mission goes on; they hold and land for the first one, too",
        does=(
            *_once(SecondGroundJoins()), Do(6.0, SecondGroundTakesCommand()),
            Do(16.0, OperatorOrders("hold"), "all"),
            Do(24.0, OperatorOrders("land"), "all", "landed"),
        ),
        hits=0, watched_s=30.0, home=False,
        bounds=(
            FliesOn(16.0, 0.95, "all"), MissionEnds(17.0, whose="all"), Stands(20.0, 24.0, "all"),
            NotLandedBefore(24.0, "all"), Lands(1.5, "all", "landed"), StraightDown(3.0, "all"),
            Down(25.5 + _LANDING_S, "all"),
        ),
    ),
    Fault(
        name="second-ground-dies-in-command",
        what="a second operator takes the command, and is gone; the first one only looks on",
        promise="hold after 3 s, land where they are after 13 s",
        does=(
            *_once(SecondGroundJoins()), Do(6.0, SecondGroundTakesCommand()),
            Do(12.0, SecondGroundDies(), mark="gone"),
        ),
        hits=0, watched_s=40.0, home=False,
        bounds=(
            FliesOn(12.0, 0.95, "all"), MissionEnds(3.8, whose="all", after="gone"),
            Stands(7.0, 12.5, "all", after="gone", may_part=True),
            StaysNear(3.8, 12.5, _PARTS_M, "all", after="gone"), NotLandedBefore(24.5, "all"),
            Lands(14.0, "all", "gone"), LandApart(), Down(26.0 + _LANDING_S, "all"),
        ),
    ),
    Fault(
        name="landed", what="the operator lands all where they are",
        promise="they come straight down",
        does=(Do(0.0, OperatorOrders("land"), "all"),), hits=0, home=False,
        bounds=(Lands(1.0, "all"), StraightDown(3.0, "all"), Down(_LANDING_S, "all")),
    ),
    Fault(
        name="landed-in-takeoff", what="the operator lands all while they take off",
        promise="they come straight down",
        phase="takeoff", does=(Do(10.0, OperatorOrders("land"), "all", "ordered"),),
        hits=0, home=False,
        bounds=(Lands(1.5, "all", "ordered"), Down(12.0 + _LANDING_S, "all")),
    ),
    Fault(
        name="swapped-pads", what="two robots were set on each other's pads",
        promise="neither takes off: each stands where another one lands",
        phase="ready", does=(Do(0.0, CarriedToPad()), Do(0.0, CarriedToPad(-1), "next")),
        bounds=(StaysDown(), StaysDown("next")),
    ),
    Fault(
        name="pad-taken-before", what="a robot stands beside another's landing point at first",
        promise="the other one does not take off",
        # It stays there: its own battery is too low for a takeoff.
        phase="ready", does=_once(CarriedToPad(beside_m=2.0), BatteryIs(0.30)), watched_s=30.0,
        exact=True,
        bounds=(StaysDown(), StaysDown("next")),
    ),
    Fault(
        name="pad-taken-in-flight", what="a robot that landed is carried to another's pad",
        promise="that one lands beside it",
        does=(
            *_once(OperatorOrders("land")), *(Do(t, CarriedToPad()) for t in (55.0, 60.0)),
        ),
        watched_s=65.0, exact=True,
        bounds=(FliesOn(20.0), LandsAtPad(8.0, "next")),
    ),
    Fault(
        name="fence-without-a-pad", what="the operator sets a fence without one landing point",
        promise="that robot does not take off",
        phase="ready", does=_once(FenceWithout()), watched_s=30.0,
        bounds=(StaysDown(),),
    ),
    Fault(
        name="somebody-over-the-pad", what="a pilot hovers above another's pad, at its height",
        promise="the one that comes home keeps 1 m away, and waits",
        settings=(_RC,),
        does=(
            *(Do(float(t), PilotFliesOver()) for t in range(80)),
            Do(45.0, OperatorOrders("return"), "next"),
            # Up and home: whom the pilot flies into or lands on, nobody else can save.
            Do(80.5, PilotFlies(0.0, 2.0)),
            *(Do(84.0 + t, PilotFliesOver(0)) for t in range(20)), Do(104.0, PilotLands()),
        ),
        watched_s=105.0, exact=True,
        bounds=(KeepsAway(1.0), LandsAtPad(_AT_PAD_M, "next")),
    ),
    Fault(
        name="start-outside", what="a held robot is beyond the fence; resume is ordered",
        promise="start is refused outside: it is flown back first",
        does=(
            *_once(OperatorOrders("hold")), Do(4.0, EstimateJumpsOut(4.5)),
            Do(8.5, OperatorOrders("resume"), mark="start"),
            # Who errs by that much comes down anywhere, which no margin covers.
            Do(20.0, EstimateIsRight()),
        ),
        watched_s=32.0,
        # Later it may be back inside, and fly on.
        bounds=(MissionEnds(0.0, 1.2, after="start"), FliesOn(20.0)),
    ),
)  # fmt: skip


_PAIRS = (
    Fault(
        name="critical-and-held", what="a critical battery, and the operator holds all 1 s later",
        promise="the landing comes before the hold",
        does=(*_once(Drain(0.145)), Do(5.0, OperatorOrders("hold"), "all")),
        bounds=(
            Lands(3.5), Down(_LANDING_S), Stands(9.0, 20.0, "others", may_part=True),
            StaysNear(6.0, 20.0, _PARTS_M, "others"),
            NotLandedBefore(20.0, "others"),
        ),
    ),
    Fault(
        name="critical-while-piloted", what="a battery is critical while a pilot flies",
        promise="the pilot comes before it: nothing is sent",
        settings=(_RC,),
        does=(*_once(PilotFlies()), Do(3.0, Drain(0.145)), Do(12.0, PilotLands())),
        bounds=(FallsSilent(1.1), NotLandedBefore(11.9), FliesOn(20.0)),
    ),
    Fault(
        name="killed-while-piloted", what="the operator kills a robot that a pilot flies",
        promise="kill comes before the pilot",
        settings=(_RC,),
        does=(*_once(PilotFlies()), Do(3.0, OperatorOrders("kill"))),
        bounds=(MotorsOff(3.6), FliesOn(20.0)),
    ),
    Fault(
        name="piloted-while-it-hangs", what="a control loop hangs, and a pilot takes it meanwhile",
        promise="what comes back does not take it from the pilot",
        settings=(_RC,),
        does=(*_once(LoopHangs("control", 3.0)), Do(1.5, PilotFlies()), Do(12.0, PilotLands())),
        bounds=(_HOLDS, FallsSilent(0.6), FliesOn(20.0)),
    ),
    Fault(
        name="low-battery-and-no-ground", what="a low battery, and the ground is lost 2 s later",
        promise="it returns, holds after 3 s, and lands after 13 s",
        does=(*_once(Drain(0.245)), Do(2.0, RadioCut("from the ground"))),
        home=False, watched_s=30.0,
        bounds=(
            MissionEnds(6.0, whose="all"), Lands(16.5, "all"), Down(17.0 + _LANDING_S, "all"),
        ),
    ),
    Fault(
        name="gps-lost-and-radio-dies", what="a robot loses GPS, and the radio dies with it",
        promise="that one lands for its position, all others for the ground",
        uncovered=_ADRIFT,
        does=_once(LoseGps(), RadioCut("all")), home=False, watched_s=30.0,
        beyond_fence_m=ADRIFT_M,
        bounds=(Lands(3.3), Lands(14.0, "others"), Down(14.0 + _LANDING_S, "all")),
    ),
    Fault(
        name="two-programs-die", what="two robots' programs die at once",
        promise="PX4 lands both; the others fly on",
        does=_once(ProgramDies()), hits=2,
        bounds=(Lands(1.3), StraightDown(3.0), Down(_LANDING_S), FliesOn(20.0)),
    ),
    Fault(
        name="program-dies-as-the-ground-does", what="a program dies, and the ground with it",
        promise="PX4 lands the one after 1 s, the others land after 13 s",
        does=_once(ProgramDies(), GroundDies()), home=False, watched_s=30.0,
        bounds=(Lands(1.3), Lands(14.0, "others"), Down(14.0 + _LANDING_S, "all")),
    ),
    Fault(
        name="px4-lands-and-return", what="a battery is critical for PX4; the operator returns all",
        promise="PX4's failsafe comes before the return",
        does=(
            *_once(*_CRITICAL_FOR_PX4),
            Do(2.0, OperatorOrders("return"), "all"),
        ),
        bounds=(Lands(8.0), Down(8.0 + _LANDING_S), LandsAtPad(_AT_PAD_M, "others")),
    ),
    Fault(
        name="gps-lost-in-return", what="a robot's receiver has no fix any more on its way home",
        promise="it lands",
        uncovered=_ADRIFT,
        phase="return", does=_once(LoseGps()), beyond_fence_m=ADRIFT_M,
        bounds=(Down(60.0), LandsAtPad(_AT_PAD_M, "others")),
    ),
    Fault(
        name="hangs-on-a-bad-radio", what="a program stops for 4 s while half of all is lost",
        promise="it holds until start is ordered; the others fly on",
        does=_once(RadioIs(loss=0.5), ProgramStops(4.0)),
        bounds=(
            _HOLDS, MissionEnds(0.6), Stands(_STANDS_AFTER_S, 20.0), NotLandedBefore(20.0),
            FliesOn(20.0),
        ),
    ),
    Fault(
        name="origin-jumps-as-it-hangs", what="a control loop hangs for 2 s; the origin jumps",
        promise="it holds where it is",
        does=(*_once(LoopHangs("control", 2.0)), Do(1.0, OriginJumps((5.6, -4.2, 0.0)))),
        bounds=(
            _HOLDS, MissionEnds(0.6), Stands(_STANDS_AFTER_S, 20.0), NotLandedBefore(20.0),
            FliesOn(20.0),
        ),
    ),
    Fault(
        name="rejoin-without-gps", what="a pilot has a robot that loses GPS; rejoin is ordered",
        promise="rejoin is refused: the pilot has it",
        uncovered=_ADRIFT,
        settings=(_RC,),
        does=(
            *_once(PilotFlies()), Do(3.0, LoseGps()), Do(8.0, OperatorOrders("rejoin")),
            Do(9.0, PilotLands()),
        ),
        beyond_fence_m=ADRIFT_M,
        bounds=(FallsSilent(1.1), FliesOn(20.0)),
    ),
    Fault(
        name="storm-and-low-battery", what="gusts on all, and a robot's battery is low",
        promise="it returns, and lands at its pad",
        does=(Do(0.0, WindBlows(gusts_m_s=2.0), "all"), Do(1.0, Drain(0.245))), watched_s=60.0,
        beyond_fence_m=POSITION_ERROR_M + 2.0, carried="all",
        bounds=(MissionEnds(5.0), LandsAtPad(_AT_PAD_M + 2.0), Down(1.0 + _HOME_S)),
    ),
)  # fmt: skip

FAULTS: Mapping[str, Fault] = {
    fault.name: fault
    for fault in (
        NOMINAL, *_PROGRAMS, *_WIRES, *_RADIO, *_POSITIONS, *_ENERGY_AND_AIR, *_PEOPLE, *_PAIRS,
    )
}  # fmt: skip
