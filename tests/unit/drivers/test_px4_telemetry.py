"""What the robot concludes, second by second, from the bytes that a real PX4 v1.17 sent."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.position import (
    PositionCause,
    PositionJudgement,
    PositionLimits,
    PositionQuality,
    judge,
)
from edge.core.vehicle import Action, Mode, VehicleState
from edge.drivers.px4.telemetry import Px4Telemetry
from edge.flight.lift import Lift, Motion, update
from edge.flight.state import FlightInputs, FlightMemory
from edge.flight.step import step
from edge.messages.codes import Reason, ReasonCode
from edge.messages.mission import FlightState
from edge.robot.config import load_config
from lpac.sim.px4.modes import CUSTOM_MODES, Px4Mode
from tests.conftest import ROOT
from tests.px4_recordings import RECORDINGS, recorded

TICK_S = 0.1

_Q, _M = PositionQuality, Mode
# A place and a velocity.
STUCK = {"lat": 399526551, "lon": -751650343, "alt": 12743, "vel": 0, "cog": 0}


class Conclusion(NamedTuple):
    """What a control tick knows; s from the recording's first message."""

    time_s: float
    vehicle: VehicleState
    judgement: PositionJudgement


def conclusions(
    name: str,
    receiver: Callable[[float, dict[str, Any]], dict[str, Any]] = lambda _, fields: fields,
) -> list[Conclusion]:
    """One ten times a second; `receiver` alters what GPS_RAW_INT says at a time, s."""
    telemetry, judgement = Px4Telemetry(), PositionJudgement()
    found: list[Conclusion] = []
    for heard_s, message in (r for r in recorded(name) if r.is_px4):
        while (now_s := len(found) * TICK_S) <= heard_s:
            vehicle = telemetry.state(now_s)
            judgement = judge(judgement, vehicle, PositionLimits(), now_s)
            found.append(Conclusion(now_s, vehicle, judgement))
        if message.get_type() in telemetry.messages:
            fields = message.to_dict()
            if message.get_type() == "GPS_RAW_INT":
                fields = receiver(heard_s, fields)
            telemetry.receive(message.get_type(), fields, heard_s)
    return found


def changes(name: str, *fields: str) -> list[tuple[Any, ...]]:
    """When the fields changed, and to what: all but the time in the order asked for."""
    told: list[tuple[Any, ...]] = []
    for time_s, vehicle, judgement in conclusions(name):
        values = tuple(
            getattr(judgement if field in ("quality", "cause") else vehicle, field)
            for field in fields
        )
        if not told or told[-1][1:] != values:
            told.append((round(time_s, 1), *values))
    return told


@pytest.mark.parametrize("name", RECORDINGS)
def test_a_real_px4_is_found_ready_to_arm_and_its_position_good(name: str) -> None:
    """Its prearm check is told in health alone, and its version in a word of four bytes."""
    found = conclusions(name)
    ready = [c for c in found if c.vehicle.armable and c.judgement.quality is _Q.GOOD]
    assert ready and ready[0].time_s < 13.0
    assert ready[0].vehicle.version == "1.17.0"
    assert ready[0].vehicle.voltage_v == pytest.approx(16.2, abs=0.1)
    gps = ready[0].vehicle.gps
    assert gps is not None and gps.accuracy_m == pytest.approx(0.9)
    # In the first second, before its first health report, PX4 says that all is well.
    assert not any(c.vehicle.armable for c in found if c.time_s < 3.0)


def test_a_normal_flight() -> None:
    assert changes("normal", "mode", "armed", "failsafe", "in_air")[2:] == [
        (1.1, _M.HOLD, False, False, False),
        (9.5, _M.OFFBOARD, True, False, False),
        (11.8, _M.OFFBOARD, True, False, True),
        (53.1, _M.LAND, True, False, True),
        (62.7, _M.LAND, True, False, False),
        (64.8, _M.OFFBOARD, False, False, False),
        (66.8, _M.HOLD, False, False, False),
    ]
    assert changes("normal", "quality") == [(0.0, _Q.LOST), (7.9, _Q.GOOD)]


def test_the_thrust_of_a_normal_flight() -> None:
    """None is known before it is told; half lifts the vehicle, and on the ground it falls."""
    found = conclusions("normal")
    assert found[0].vehicle.thrust is None
    flown = [c.vehicle.thrust for c in found if 20.0 < c.time_s < 52.0]
    assert all(thrust is not None and 0.4 < thrust < 0.6 for thrust in flown)
    assert {c.vehicle.thrust for c in found if 63.8 < c.time_s < 66.0} == {0.0}


@pytest.mark.parametrize("name", ["normal", "kill", "stop", "battery", "battery_fast"])
def test_a_flight_by_its_height_and_thrust(name: str) -> None:
    """It holds its height in offboard, never seems to stand in the air, and does once it is down.

    On its legs its estimated height walks by up to 0.7 m.
    """
    lift, stood_m = Lift(), []
    for now_s, vehicle, _ in conclusions(name):
        if not vehicle.armed or vehicle.position_local_m is None:
            continue
        assert vehicle.velocity_local_m_s is not None
        motion = Motion(
            height_m=-vehicle.position_local_m[2],
            climb_m_s=-vehicle.velocity_local_m_s[2],
            wanted_m=4.3 if vehicle.mode is Mode.OFFBOARD else None,
            approach_m_s=0.0,
            thrust=vehicle.thrust,
            in_air=vehicle.in_air,
            ground_below_m=4.5,
        )
        lift = update(lift, motion, now_s, TICK_S)
        assert lift.off_s(now_s) < 0.0
        if lift.stands(now_s):
            stood_m.append(-vehicle.position_local_m[2])
    assert lift.hover_thrust is not None and 0.45 < lift.hover_thrust < 0.55
    assert stood_m and max(stood_m) < 0.8


def test_a_thrust_that_is_not_told_any_more_is_not_known() -> None:
    telemetry = Px4Telemetry()
    telemetry.receive("VFR_HUD", {"throttle": 48}, 10.0)
    assert telemetry.state(12.0).thrust == 0.48
    assert telemetry.state(13.0).thrust is None


def test_a_speed_that_has_the_climb_in_it_is_no_contradiction() -> None:
    """As DroneCAN's receivers tell it."""

    def with_climb(time_s: float, fix: dict[str, Any]) -> dict[str, Any]:
        # In takeoff, at the vehicle's greatest climb rate.
        return fix | {"vel": round(math.hypot(fix["vel"], 150))} if 10.5 < time_s < 13.0 else fix

    found = [c for c in conclusions("normal", with_climb) if 10.5 < c.time_s < 16.0]
    assert {c.judgement.quality for c in found} == {_Q.GOOD}


@pytest.mark.parametrize("name", RECORDINGS)
def test_a_real_receiver_never_contradicts_itself(name: str) -> None:
    found = [c for c in conclusions(name) if c.vehicle.gps is not None and c.vehicle.gps.fix >= 3]
    assert not any(c.judgement.distrusts_gps for c in found)
    gps = [c.vehicle.gps for c in found if c.vehicle.gps is not None]
    assert max(each.repeats for each in gps) == 0
    assert max(each.slip_m for each in gps if each.slip_m is not None) < 3.0
    off_m_s = [each.velocity_offset_m_s for each in gps if each.velocity_offset_m_s is not None]
    assert 0.0 < max(off_m_s) < 1.0


@pytest.mark.parametrize(
    ("lie", "cause"),
    [
        (lambda fix, since_s: fix | STUCK, PositionCause.GPS_STUCK),
        (lambda fix, since_s: fix | {"lat": fix["lat"] + round(180.0 * since_s)},
         PositionCause.DISAGREES),
        (lambda fix, since_s: fix | {"vel": 350}, PositionCause.VELOCITY_DISAGREES),
    ],
)  # fmt: skip
def test_a_receiver_that_lies_in_a_real_flight_is_noticed(
    lie: Callable[[dict[str, Any], float], dict[str, Any]],
    cause: PositionCause,
) -> None:
    """From 30 s on, in the mission: the same fix, a place that walks off, a wrong velocity."""

    def altered(time_s: float, message: dict[str, Any]) -> dict[str, Any]:
        return lie(message, time_s - 30.0) if time_s > 30.0 else message

    found = [c for c in conclusions("normal", altered) if 30.0 < c.time_s < 38.0]
    assert cause in {c.judgement.cause for c in found}
    assert any(c.judgement.distrusts_gps for c in found)
    assert found[-1].judgement.quality is _Q.LOST


def test_gps_lost_in_the_mission() -> None:
    """At 26.9 s; PX4 itself acts at 34.4 s. It is back at 58.2 s, with a jump of 24 m."""
    assert changes("gps", "quality") == [
        (0.0, _Q.LOST),
        (6.2, _Q.GOOD),
        (27.7, _Q.DOUBTFUL),
        (29.2, _Q.LOST),
        (63.6, _Q.GOOD),
    ]
    causes = [c.judgement.cause for c in conclusions("gps") if 27.2 < c.time_s < 58.0]
    # The machine stood still for a moment at 29.3 s.
    assert set(causes) == {PositionCause.NO_FIX, PositionCause.OLD}
    assert PositionCause.JUMPED in {
        c.judgement.cause for c in conclusions("gps") if c.time_s > 59.0
    }
    assert changes("gps", "failsafe")[2:] == [(34.4, True), (53.9, False)]


def test_all_sensors_die_after_takeoff() -> None:
    """Just after 8 s. PX4 goes on to tell of a receiver from which nothing comes."""
    assert changes("sensors_die", "quality", "cause")[-4:] == [
        (9.0, _Q.GOOD, PositionCause.NO_FIX),
        (9.4, _Q.DOUBTFUL, PositionCause.NO_FIX),
        (10.5, _Q.DOUBTFUL, PositionCause.GPS_SILENT),
        (11.0, _Q.LOST, PositionCause.GPS_SILENT),
    ]


def test_a_jump_in_height_that_an_origin_explains_late_is_none() -> None:
    telemetry, told = Px4Telemetry(), []
    heartbeat = {"autopilot": 12, "custom_mode": 6 << 16, "system_status": 4}

    def origin(altitude_m: float) -> None:
        fields = {"latitude": 0, "longitude": 0, "altitude": altitude_m * 1e3}
        telemetry.receive("GPS_GLOBAL_ORIGIN", fields, now_s)

    for tick in range(400):
        now_s, jumped = tick * 0.05, tick >= 200
        if tick == 0:
            origin(400.0)
        if tick == 300:
            origin(394.0)
        if tick % 20 == 0:
            armed = 0x80 if tick >= 40 else 0
            telemetry.receive("HEARTBEAT", {**heartbeat, "base_mode": armed}, now_s)
        down_m = -5.0 - 0.01 * tick - (6.0 if jumped else 0.0) - (4.0 if tick < 20 else 0.0)
        position = {"x": 0.0, "y": 0.0, "z": down_m, "vx": 0.0, "vy": 0.0, "vz": -0.2}
        telemetry.receive("LOCAL_POSITION_NED", {**position, "time_boot_ms": now_s * 1e3}, now_s)
        told.append(telemetry.state(now_s).height_jumped_m)
    assert set(told[:200]) == {0.0}  # On the ground it may jump.
    assert told[230:300] == pytest.approx([6.0] * 70, abs=0.01)
    assert told[301:] == pytest.approx([0.0] * 99, abs=0.02)


def test_what_sys_status_told_is_not_known_once_it_falls_silent() -> None:
    """While all else goes on."""
    found: list[VehicleState] = []
    telemetry = Px4Telemetry()
    for heard_s, message in (r for r in recorded("normal") if r.is_px4):
        kind = message.get_type()
        if kind in telemetry.messages and not (kind == "SYS_STATUS" and heard_s > 30.0):
            telemetry.receive(kind, message.to_dict(), heard_s)
        if 31.0 < heard_s < 35.0:
            found.append(telemetry.state(heard_s))
    told = [(s.battery, s.voltage_v, s.remote_control, s.armable) for s in found]
    assert None not in told[0]
    assert told[-1] == (None, None, None, None)
    assert found[-1].connected and found[-1].position_at_s > 34.0


def test_a_vehicle_is_there_as_long_as_it_says_anything() -> None:
    """Without a heartbeat for ten seconds: its mode is not known then."""
    telemetry = Px4Telemetry()
    for heard_s, message in (r for r in recorded("normal") if r.is_px4):
        kind = message.get_type()
        if kind in telemetry.messages and not (kind == "HEARTBEAT" and heard_s > 30.0):
            telemetry.receive(kind, message.to_dict(), heard_s)
        if 30.0 < heard_s < 44.0:
            connected = telemetry.state(heard_s).connected
            assert connected == (heard_s - telemetry.state(heard_s).heartbeat_at_s < 10.0)
        if heard_s > 44.0:
            break
    assert not connected


def test_after_a_silence_it_is_there_once_its_mode_is_known() -> None:
    telemetry = Px4Telemetry()
    silent_s, connected = (30.0, 35.0), []
    for heard_s, message in (r for r in recorded("normal") if r.is_px4):
        kind = message.get_type()
        if kind in telemetry.messages and not silent_s[0] < heard_s < silent_s[1]:
            telemetry.receive(kind, message.to_dict(), heard_s)
            state = telemetry.state(heard_s)
            connected.append((heard_s, state.connected))
            assert not state.connected or heard_s < 35.0 or state.heartbeat_at_s > 35.0
    back_s = next(s for s, is_there in connected if s > 35.0 and is_there)
    assert 35.0 < back_s < 36.1


def test_battery_critical_while_landing_is_px4s_own_failsafe() -> None:
    assert changes("battery_fast", "mode", "failsafe")[-6:] == [
        (14.0, _M.OFFBOARD, False),
        (34.9, _M.LAND, False),
        (36.1, _M.HOLD, True),
        (41.6, _M.LAND, True),
        (55.9, _M.OFFBOARD, False),
        (58.2, _M.HOLD, False),
    ]


def test_a_landing_that_px4s_own_failsafe_interrupts_is_not_let_go_of() -> None:
    """The program that was recorded let go: "the vehicle left land for hold"."""
    robot = load_config(ROOT / "docs" / "robot.toml").robot(boot_nonce=1)
    home = Reason(ReasonCode.AT_LANDING_POINT, "at the landing point")
    flight = FlightMemory(FlightState.LAND, home, since_s=33.4, land_by="return")
    told: list[tuple[FlightState, tuple[Action, ...], tuple[Reason, ...]]] = []
    for now_s, vehicle, judgement in conclusions("battery_fast"):
        if now_s < flight.since_s or flight.state is FlightState.LANDED:
            continue
        inputs = FlightInputs(
            now_s=now_s, vehicle=vehicle, position=judgement, odometry=None,
            policy_velocity_m_s=None, neighbours=(), closest=None, busy_neighbours=(), ground=None,
            ground_age_s=math.inf,
            safety_request="none", failed_checks=None, not_taken=(), order=None, uptime_s=now_s,
            energy=None,
        )  # fmt: skip
        flight, actions, alarms, _, _ = step(robot, flight, inputs)
        told.append((flight.state, actions, alarms))
    assert dict.fromkeys(state for state, _, _ in told).keys() == {
        FlightState.LAND,
        FlightState.LANDED,
    }
    # Asked for until PX4 was heard to land; then PX4 goes on by itself.
    assert {action for _, actions, _ in told for action in actions} == {Action.LAND}
    assert not any(actions for _, actions, _ in told[20:])
    acting = [
        alarms
        for _, _, alarms in told
        if Reason(ReasonCode.FAILSAFE, "the autopilot's own failsafe acts: hold") in alarms
    ]
    assert 5.0 < TICK_S * len(acting) < 6.0


def test_a_pilot_is_none_of_its_failsafes() -> None:
    assert changes("pilot", "mode", "failsafe", "remote_control")[4:11] == [
        (23.8, _M.OFFBOARD, False, True),
        (24.3, _M.HOLD, False, True),
        (32.7, _M.OFFBOARD, False, True),
        (43.2, _M.POSITION, False, True),
        (51.4, _M.OFFBOARD, False, True),
        (56.2, _M.LAND, False, True),
        (75.6, _M.OFFBOARD, False, True),
    ]


def test_a_driver_that_died_takes_the_readiness() -> None:
    """The barometer's is stopped at 9.3 s."""
    assert changes("refused", "armable")[1:4] == [(0.3, False), (7.3, True), (10.7, False)]


# The vehicle flies until here; later in `kill` the machine stood still for seconds.
FLOWN_UNTIL_S = {"gps": 26.8, "sensors_die": 8.5, "kill": 30.0}


class Said:
    """Telemetry of a flight, fed message by message."""

    def __init__(self) -> None:
        self.telemetry, self.now_s = Px4Telemetry(), 100.0

    def heartbeat(self, *, armed: bool) -> None:
        fields = {"autopilot": 12, "system_status": 4, "base_mode": armed << 7, "custom_mode": 0}
        self.telemetry.receive("HEARTBEAT", fields, self.now_s)

    def landed_state(self, *, in_air: bool) -> None:
        self.telemetry.receive(
            "EXTENDED_SYS_STATE", {"landed_state": 2 if in_air else 1}, self.now_s
        )

    def position(self, boot_s: float) -> None:
        fields = dict.fromkeys(("x", "y", "z", "vx", "vy", "vz"), 0.0)
        fields["time_boot_ms"] = round(1e3 * boot_s)
        self.telemetry.receive("LOCAL_POSITION_NED", fields, self.now_s)

    def fly(self) -> None:
        self.heartbeat(armed=True)
        self.landed_state(in_air=True)
        self.position(self.now_s)

    @property
    def fell(self) -> bool:
        return self.telemetry.state(self.now_s).fell


def test_a_landing_is_told_before_the_motors_stop() -> None:
    said = Said()
    said.fly()
    said.now_s += 1.0
    said.landed_state(in_air=False)
    said.now_s += 0.5
    said.heartbeat(armed=False)
    assert not said.fell


def test_a_landing_that_was_held_up_on_its_way_is_none_the_less_one() -> None:
    """All that was said within two seconds comes in one go."""
    said = Said()
    said.fly()
    boot_s = said.now_s
    said.now_s += 2.4
    said.landed_state(in_air=True)
    said.position(boot_s + 0.2)
    said.landed_state(in_air=False)
    said.position(boot_s + 2.3)
    said.heartbeat(armed=False)
    assert not said.fell


@pytest.mark.parametrize("started_anew", [False, True])
def test_what_is_disarmed_in_the_air_falls(started_anew: bool) -> None:
    said = Said()
    said.fly()
    said.now_s += 1.5
    if started_anew:
        # Its first words come together.
        said.landed_state(in_air=False)
    said.heartbeat(armed=False)
    assert said.fell
    said.now_s += 10.0
    said.heartbeat(armed=False)
    assert said.fell
    said.heartbeat(armed=True)
    assert not said.fell


@pytest.mark.parametrize("started_anew", [False, True])
def test_what_became_of_a_flight_that_was_not_heard_is_told_by_the_vehicles_time(
    started_anew: bool,
) -> None:
    said = Said()
    said.fly()
    said.now_s += 20.0
    said.heartbeat(armed=False)
    said.landed_state(in_air=False)
    assert not said.fell
    said.now_s += 3.0
    said.position(5.0 if started_anew else said.now_s)
    assert said.fell is started_anew


@pytest.mark.parametrize("name", RECORDINGS)
def test_nothing_falls_in_a_recording(name: str) -> None:
    assert not any(vehicle.fell for _, vehicle, _ in conclusions(name))


@pytest.mark.parametrize("name", RECORDINGS)
def test_no_recording_has_a_false_loss(name: str) -> None:
    """A stall of the machine that recorded them makes a robot stop, but not land."""
    until_s = FLOWN_UNTIL_S.get(name, 1e9)
    flown = [c for c in conclusions(name) if c.vehicle.armed and c.time_s < until_s]
    assert not any(c.judgement.quality is _Q.LOST for c in flown)
    assert {c.judgement.cause for c in flown} <= {None, PositionCause.OLD, PositionCause.GPS_SILENT}
    assert all(c.vehicle.jumped_at_s == float("-inf") for c in flown)


@pytest.mark.parametrize(
    ("px4", "mode"),
    [
        (Px4Mode.MANUAL, Mode.MANUAL),
        (Px4Mode.ALTCTL, Mode.ALTITUDE),
        (Px4Mode.POSCTL, Mode.POSITION),
        (Px4Mode.TAKEOFF, Mode.TAKEOFF),
        (Px4Mode.HOLD, Mode.HOLD),
        (Px4Mode.RETURN, Mode.RETURN),
        (Px4Mode.LAND, Mode.LAND),
        (Px4Mode.DESCEND, Mode.LAND),
        (Px4Mode.OFFBOARD, Mode.OFFBOARD),
        (Px4Mode.STABILIZED, Mode.STABILIZED),
    ],
)
def test_modes(px4: Px4Mode, mode: Mode) -> None:
    telemetry = Px4Telemetry()
    main, sub = CUSTOM_MODES[px4]
    heartbeat = {
        "autopilot": 12,
        "base_mode": 0,
        "custom_mode": main << 16 | sub << 24,
        "system_status": 3,
    }
    telemetry.receive("HEARTBEAT", heartbeat, 0.0)
    assert telemetry.state(0.0).mode is mode


@given(
    st.floats(0.5, 20.0),
    st.floats(0.0, 0.01),
    st.lists(st.floats(0.0, 0.02), min_size=20, max_size=20),
)
def test_a_backlog_is_as_old_as_it_is(stop_s: float, burst_s: float, jitter_s: list[float]) -> None:
    """The process stands still, then takes in at once what came meanwhile."""
    telemetry = Px4Telemetry()

    def hear(vehicle_s: float, now_s: float) -> VehicleState:
        fields = dict.fromkeys(("x", "y", "z", "vx", "vy", "vz"), 0.0)
        telemetry.receive("LOCAL_POSITION_NED", {**fields, "time_boot_ms": vehicle_s * 1e3}, now_s)
        return telemetry.state(now_s)

    clocks_differ_s = 1234.5
    now_s = 0.0
    for k, late_s in enumerate(jitter_s):
        now_s = clocks_differ_s + k * 0.05 + late_s
        assert hear(k * 0.05, now_s).position_at_s > now_s - 0.1
    steps = range(len(jitter_s), len(jitter_s) + round(stop_s / 0.05))
    continued_s = clocks_differ_s + steps[-1] * 0.05
    for k in steps:
        arrived_s = max(continued_s + (k - steps[0]) * burst_s / len(steps), now_s)
        due_s = clocks_differ_s + k * 0.05
        assert abs(hear(k * 0.05, arrived_s).position_at_s - due_s) < 0.05


@pytest.mark.parametrize("fields", [{}, {"x": None, "y": 0.0, "z": 0.0}])
def test_a_position_that_is_none_changes_nothing(fields: dict[str, float | None]) -> None:
    telemetry = Px4Telemetry()
    with pytest.raises((KeyError, TypeError)):
        telemetry.receive("LOCAL_POSITION_NED", fields, 0.0)
    assert telemetry.state(0.0) == Px4Telemetry().state(0.0)


def test_a_long_text_comes_in_pieces() -> None:
    telemetry = Px4Telemetry()
    for piece, text in enumerate(("Preflight Fail: Compass needs calibration be", "fore flight\t")):
        fields = {"severity": 2, "text": text, "id": 9, "chunk_seq": piece}
        telemetry.receive("STATUSTEXT", fields, 1.0)
    (problem,) = telemetry.state(2.0).problems
    assert problem.text == "Compass needs calibration before flight"
    assert telemetry.state(60.0).problems == ()
