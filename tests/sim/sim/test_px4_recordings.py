"""The simulated PX4 sends what a real one sent: recordings of a real PX4 v1.17 are replayed.

Each recording (tests/data/px4_v1.17, see its README) holds what a robot and its PX4 sent to each
other. The robot's side goes to a simulated vehicle together with what was done to the vehicle
meanwhile, and then the messages of both are compared: contents, rates and times of changes.

All times are PX4's own, s since it started: the machine that it ran on was slow, in jerks, and so
were the seconds of its README. Nothing here runs in real time. `ON_PURPOSE` lists in what the two
may differ, and why.
"""

import functools
import itertools
import struct
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from lpac.sim.px4.link import Px4Link
from lpac.sim.px4.modes import Px4Mode
from lpac.sim.px4.vector import plus
from lpac.sim.px4.vehicle import CHECKS_PERIOD_S, LANDED_AFTER_S, Px4Vehicle, SimulatedSensor
from tests.px4_recordings import frames

STEP_S = 0.02
GROUND_STATION = 255
EVENT = "EVENT"
# Messages that pymavlink does not have.
UNNAMED = {
    "UNKNOWN_8": "LINK_NODE_STATUS",
    "UNKNOWN_380": "TIME_ESTIMATE_TO_TARGET",
    "UNKNOWN_411": "CURRENT_EVENT_SEQUENCE",
    "UNKNOWN_436": "CURRENT_MODE",
    "UNKNOWN_441": "GNSS_INTEGRITY",
}

# What the simulated PX4 does otherwise than the real one, and why.
ON_PURPOSE = {
    # Messages that it does not send: nothing of ours listens.
    "ALTITUDE": "no client reads it",
    "ATTITUDE_QUATERNION": "no client reads it",
    "ATTITUDE_TARGET": "no client reads it",
    "COMMAND_LONG": "what PX4 commands itself; no client reads it",
    "CURRENT_MODE": "no client reads it: the mode is HEARTBEAT's",
    "DISTANCE_SENSOR": "the simulated vehicle has no range finder",
    "GNSS_INTEGRITY": "no client reads it",
    "HIGHRES_IMU": "no client reads it",
    "LINK_NODE_STATUS": "no client reads it",
    "MISSION_CURRENT": "no client reads it",
    "OPEN_DRONE_ID_LOCATION": "no client reads it",
    "OPEN_DRONE_ID_SYSTEM": "no client reads it",
    "PING": "no client reads it",
    "POSITION_TARGET_GLOBAL_INT": "no client reads it",
    "POSITION_TARGET_LOCAL_NED": "no client reads it",
    "SCALED_PRESSURE": "no client reads it",
    "SERVO_OUTPUT_RAW": "no client reads it",
    "SYSTEM_TIME": "no client reads it",
    "TIMESYNC": "no client reads it",
    "TIME_ESTIMATE_TO_TARGET": "no client reads it",
    "VIBRATION": "no client reads it",
    # What it does send, but otherwise.
    "ATTITUDE": "50 Hz instead of 100: the simulated vehicle takes 50 steps a second",
    "PARAM_VALUE": "PX4 also sends parameters that it changes itself, as calibrations",
    "ESTIMATOR_STATUS POS_VERT_AGL": "the range finder's, which the simulated vehicle lacks",
    "ESTIMATOR_STATUS ACCEL_ERROR": "at the touch of the ground; not read by anybody",
    "height": "it is never lost, as without GPS and barometer (`sensors_die` after 18 s), by then "
    "a vehicle is down",
    "REQUEST_MESSAGE DENIED": "once in an hour, for a message that PX4 had sent just before",
    "EVENT": "some are not sent, see OTHER_EVENTS; levels are those for the outside alone",
    "COMMAND_ACK": "a slow PX4 lost some of the commands: kinds are compared, numbers are not",
    "STATUSTEXT mission computer": "the companion's heartbeats are not watched (COM_OBC_LOSS_T)",
    "on its way down": "how long that takes is the airframe's affair; without GPS PX4 takes long "
    "to see that it is down. The simulated vehicle is made to touch down when the real one did",
    "RC_CHANNELS": "the simulated pilot has a remote control, the recorded one a joystick",
    "battery": "how fast it drains is the airframe's affair, and PX4's simulator recharges it on "
    "the ground: the simulated vehicle is given the recorded charge",
}


class Stamped(NamedTuple):
    """One message, and when: s of PX4's own clock."""

    at_s: float
    name: str
    message: Any


IGNORED_FLAGS = mavlink.ESTIMATOR_POS_VERT_AGL | mavlink.ESTIMATOR_ACCEL_ERROR


@dataclass(frozen=True)
class Track:
    """What is compared as it changes: fields of a message, which comes every `period_s`."""

    message: str
    fields: tuple[str, ...]
    period_s: float
    ignored: int = 0

    def values(self, messages: list[Stamped]) -> list[tuple[float, tuple[int, ...]]]:
        """The values in turn, each with the time of its first message."""
        changes: list[tuple[float, tuple[int, ...]]] = []
        for at_s, name, message in messages:
            if name == self.message:
                value = tuple(int(getattr(message, f)) & ~self.ignored for f in self.fields)
                if not changes or changes[-1][1] != value:
                    changes.append((at_s, value))
        return changes


SENSORS = "onboard_control_sensors_"
TRACKS = (
    Track("HEARTBEAT", ("base_mode", "custom_mode", "system_status"), 1.0),
    Track("EXTENDED_SYS_STATE", ("landed_state",), 0.2),
    Track("SYS_STATUS", tuple(SENSORS + f for f in ("present", "enabled", "health")), 0.5),
    Track(
        "GPS_RAW_INT",
        ("fix_type", "satellites_visible", "eph", "epv", "h_acc", "v_acc", "vel_acc"),
        0.5,
    ),
    Track("ESTIMATOR_STATUS", ("flags",), 1.0, IGNORED_FLAGS),
    Track("BATTERY_STATUS", ("charge_state",), 2.0),
)
# A message that comes just before a change and one that comes just after are a period apart; the
# rest is PX4's loop, and how well its clock is known.
SLACK_S = 0.15


@dataclass(frozen=True)
class Scenario:
    """What was done to the vehicle, by the README's seconds; and the README's phases."""

    phases_s: tuple[float, ...]
    done: tuple[tuple[float, Callable[[Px4Vehicle], object]], ...] = ()
    given_battery: bool = False
    gcs_on_link_from_s: float = 1e9
    until_s: float = 1e9


def sets(**fields: Any) -> Callable[[Px4Vehicle], None]:
    def do(vehicle: Px4Vehicle) -> None:
        for name, value in fields.items():
            setattr(vehicle, name, value)

    return do


def parameter(name: str, value: int) -> Callable[[Px4Vehicle], None]:
    return lambda vehicle: vehicle.parameters.update({name: value})


def dies(*sensors: SimulatedSensor) -> Callable[[Px4Vehicle], None]:
    return lambda vehicle: vehicle.dead_sensors.update(sensors)


def drifts(north_m: float) -> Callable[[Px4Vehicle], None]:
    def do(vehicle: Px4Vehicle) -> None:
        vehicle.gps_bias_m = plus(vehicle.gps_bias_m, (north_m, 0.0, 0.0))

    return do


def ground_station(
    from_s: float, to_s: float
) -> tuple[tuple[float, Callable[[Px4Vehicle], object]], ...]:
    """Its heartbeats on PX4's other link."""
    return tuple(
        (from_s + second, Px4Vehicle.ground_station_heartbeat)
        for second in range(round(to_s - from_s))
    )


SCENARIOS = {
    "normal": Scenario((0.0, 7.8, 18.0, 48.0, 64.9, 69.1)),
    "gps": Scenario(
        (0.0, 6.4, 16.9, 26.9, 53.2, 58.2, 70.5),
        (
            (26.86, sets(gps_lost=True)),
            # What PX4 dead reckons leaves the fence, while it stands on the ground.
            (50.7, drifts(100.0)),
            (58.24, sets(gps_lost=False)),
            (59.5, drifts(-100.0)),
        ),
    ),
    "kill": Scenario((0.0, 6.4, 15.1, 23.1, 42.4, 45.6)),
    "stop": Scenario((0.0, 7.3, 16.3, 24.3, 34.3, 44.3, 58.7, 62.0)),
    "pilot": Scenario(
        (0.0, 6.4, 15.2, 24.2, 31.2, 42.9, 50.4, 60.9, 75.8, 78.1),
        (
            (21.1, parameter("COM_RC_IN_MODE", 1)),
            (21.3, sets(rc_connected=True)),
            *ground_station(21.16, 78.0),
            (24.16, lambda vehicle: vehicle.set_mode(Px4Mode.HOLD)),
            (42.90, lambda vehicle: vehicle.set_mode(Px4Mode.POSCTL)),
            (43.41, lambda vehicle: vehicle.move_sticks((1.0, 0.0, 0.0))),
            (46.41, lambda vehicle: vehicle.move_sticks(())),
        ),
    ),
    "battery": Scenario((0.0, 6.7, 16.0, 42.0, 50.0, 60.4), given_battery=True),
    "battery_fast": Scenario((0.0, 12.5, 24.7, 28.7, 55.2, 58.5), given_battery=True),
    "refused": Scenario(
        (0.0, 7.3, 9.4, 22.5, 36.5, 52.5, 66.3),
        ((9.35, dies(SimulatedSensor.BAROMETER)), *ground_station(22.52, 66.0)),
        gcs_on_link_from_s=36.5,
    ),
    # One second after arming, says the README; PX4's own timeouts say when.
    "sensors_die": Scenario(
        (0.0, 6.9, 14.1, 18.0),
        (
            (
                7.95,
                dies(SimulatedSensor.BAROMETER, SimulatedSensor.COMPASS, SimulatedSensor.BATTERY),
            ),
            (8.1, dies(SimulatedSensor.GPS)),
        ),
        until_s=18.0,
    ),
}


@dataclass
class Replay:
    """Messages of the real and of the simulated vehicle, and the starts of the phases."""

    real: list[Stamped] = field(default_factory=list)
    simulated: list[Stamped] = field(default_factory=list)
    phases_s: tuple[float, ...] = ()


STREAM_COMMANDS = {mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAV_CMD_REQUEST_MESSAGE}
NOTHING_NEW = (mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAV_RESULT_DENIED)


class Event(NamedTuple):
    """PX4's EVENT, which pymavlink does not have."""

    number: int
    level: int
    arguments: bytes


class Decoder:
    """Decoder of a vehicle's messages."""

    def __init__(self) -> None:
        self._mavlink = mavlink.MAVLink(None)
        self._mavlink.robust_parsing = True

    def decode(self, at_s: float, data: bytes) -> list[Stamped]:
        return [self._stamped(at_s, message) for message in self._mavlink.parse_buffer(data) or ()]

    @staticmethod
    def _stamped(at_s: float, message: Any) -> Stamped:
        name = message.get_type()
        if name != "UNKNOWN_410":
            return Stamped(at_s, UNNAMED.get(name, name), message)
        frame = bytes(message.data)
        payload = frame[10 : 10 + frame[1]].ljust(53, b"\0")
        number, _, _, _, _, level = struct.unpack_from("<IIHBBB", payload)
        return Stamped(
            at_s, EVENT, Event(number & 0xFFFFFF, level & 0xF, payload[13:].rstrip(b"\0"))
        )


# A log file begins, a compass or a barometer fails over, the companion is lost and back, the
# battery would end PX4, a stick is let go.
OTHER_EVENTS = {1203183, 5371654, 9421773, 11123101, 10716939, 5847165, 5623108}
LANDING_DETECTED = 9844908
# Of how many of these messages one was recorded.
THINNED = {"ODOMETRY": 10, "ATTITUDE": 10, "VFR_HUD": 5}


class Clock:
    """PX4's clock at a time of the recording."""

    def __init__(self, recorded: list[Stamped]) -> None:
        times_s = [
            (s.at_s, s.message.time_boot_ms / 1e3)
            for s in recorded
            if s.name == "LOCAL_POSITION_NED"
        ]
        self._recorded_s, self._boot_s = np.array(times_s).T

    def __call__(self, recorded_s: float) -> float:
        boot_s = float(np.interp(recorded_s, self._recorded_s, self._boot_s))
        return boot_s + min(recorded_s - float(self._recorded_s[0]), 0.0)


@functools.cache
def replay(name: str) -> Replay:
    """Messages of both vehicles, by PX4's clock."""
    scenario, decoder = SCENARIOS[name], Decoder()
    log = [entry for entry in frames(name) if entry[0] < scenario.until_s]
    recorded = [
        message
        for at_s, frame in log
        if (frame[5], frame[6]) == (1, 1)
        for message in decoder.decode(at_s, frame)
    ]
    clock = Clock(recorded)
    sent = [
        (clock(at_s), frame)
        for at_s, frame in log
        if frame[6] != 1
        # What PX4 forwards to the companion is not from the companion.
        and (frame[5] != GROUND_STATION or at_s >= scenario.gcs_on_link_from_s)
    ]
    real = [s._replace(at_s=clock(s.at_s)) for s in recorded]
    vehicle = Px4Vehicle(seed=1, ready_after_s=ready_s(real))
    todo = sorted(
        [
            *((clock(at_s), do) for at_s, do in scenario.done),
            *(charges(real) if scenario.given_battery else ()),
        ],
        key=lambda entry: entry[0],
    )
    simulated = run(vehicle, sent, todo, real)
    return Replay(real, simulated, tuple(clock(at_s) for at_s in scenario.phases_s))


def ready_s(real: list[Stamped]) -> float:
    """When the estimator had its position: with the next check PX4 moved home there."""
    homes: list[float] = [s.message.time_usec / 1e6 for s in real if s.name == "HOME_POSITION"]
    return next(home_s for home_s in homes if home_s > 3.5) - CHECKS_PERIOD_S


def charges(real: list[Stamped]) -> list[tuple[float, Callable[[Px4Vehicle], object]]]:
    """Charge of the battery; SYS_STATUS rounds it up."""
    reported = [(s.at_s, s.message.battery_remaining - 0.5) for s in real if s.name == "SYS_STATUS"]
    times_s = np.arange(reported[0][0], reported[-1][0], 0.1)
    remaining = np.interp(times_s, *np.array(reported).T) / 100.0
    return [
        # PX4 reports it at once, and checks it up to a tenth of a second later.
        (float(at_s) + CHECKS_PERIOD_S, sets(battery_remaining=max(float(charge), 0.0)))
        for at_s, charge in zip(times_s, remaining, strict=True)
    ]


def run(
    vehicle: Px4Vehicle,
    sent: list[tuple[float, bytes]],
    todo: list[tuple[float, Callable[[Px4Vehicle], object]]],
    real: list[Stamped],
) -> list[Stamped]:
    """Fly the vehicle through the recording; returns its messages."""
    # PX4 opens its link a second before its first message.
    opened_s = next(s.at_s for s in real if s.name == "HEARTBEAT") - 1.0
    while vehicle.time_s < opened_s:
        vehicle.step(STEP_S)
    link, decoder, messages = Px4Link(vehicle, system_id=1), Decoder(), []
    sent, todo = list(reversed(sent)), list(reversed(todo))
    down_s = touchdown_s(real)
    while vehicle.time_s < real[-1].at_s:
        while sent and sent[-1][0] <= vehicle.time_s:
            link.receive(sent.pop()[1])
        while todo and todo[-1][0] <= vehicle.time_s:
            todo.pop()[1](vehicle)
        if not vehicle.landed and vehicle.position_m[2] >= -0.1:
            # On its way down; see ON_PURPOSE.
            north_m, east_m, _ = vehicle.position_m
            down_m = -0.1 if vehicle.time_s < down_s else 0.0
            vehicle.position_m = np.array([north_m, east_m, down_m])
        vehicle.step(STEP_S)
        for datagram in link.due():
            messages += decoder.decode(vehicle.time_s, datagram)
    return messages


def touchdown_s(real: list[Stamped]) -> float:
    """When the real vehicle touched the ground, as its land detector later saw."""
    times_s = [s.at_s for s in real if s.name == EVENT and s.message.number == LANDING_DETECTED]
    return times_s[0] - LANDED_AFTER_S if times_s else np.inf


@pytest.fixture(params=SCENARIOS)
def replayed(request: pytest.FixtureRequest) -> Replay:
    return replay(request.param)


@pytest.mark.parametrize("track", TRACKS, ids=lambda track: track.message)
def test_the_same_is_told_and_changes_as_soon(replayed: Replay, track: Track) -> None:
    """One after the other the same values, at most one message of that kind earlier or later."""
    real, simulated = track.values(replayed.real), track.values(replayed.simulated)
    assert [v for _, v in simulated] == [v for _, v in real], side_by_side(real, simulated)
    for (real_s, value), (simulated_s, _) in zip(real, simulated, strict=True):
        late_s = abs(simulated_s - real_s)
        assert late_s <= track.period_s + SLACK_S, (value, side_by_side(real, simulated))


def side_by_side(
    real: list[tuple[float, tuple[int, ...]]], simulated: list[tuple[float, tuple[int, ...]]]
) -> str:
    rows = [""]
    for entries, title in ((real, "real"), (simulated, "simulated")):
        rows += [f"{title:10}{at_s:7.2f}  {' '.join(map(hex, value))}" for at_s, value in entries]
    return "\n".join(rows)


def test_the_same_messages_come_as_often(replayed: Replay) -> None:
    """In each phase, by a tenth or by two messages."""
    wrong = []
    for begin_s, end_s in itertools.pairwise(replayed.phases_s):
        real, simulated = (
            Counter(s.name for s in messages if begin_s <= s.at_s < end_s)
            for messages in (replayed.real, replayed.simulated)
        )
        for name in sorted((real | simulated).keys() - ON_PURPOSE.keys()):
            expected = real[name] * THINNED.get(name, 1)
            if abs(simulated[name] - expected) > max(0.1 * expected, 2, THINNED.get(name, 0)):
                wrong.append((begin_s, name, expected, simulated[name]))
    assert not wrong


def answers(messages: list[Stamped]) -> list[tuple[float, tuple[int, ...]]]:
    """The acknowledgements, one for each command, but for those of streams."""
    found: list[tuple[float, tuple[int, ...]]] = []
    for at_s, name, message in messages:
        if name == "COMMAND_ACK" and message.command not in STREAM_COMMANDS:
            to = message.target_system, message.target_component
            answer = (message.command, message.result, *to)
            # PX4 answers DO_SET_MODE once or twice.
            if not found or found[-1][1] != answer or at_s > found[-1][0] + 0.05:
                found.append((at_s, answer))
    return found


def test_commands_are_answered_alike(replayed: Replay) -> None:
    real, simulated = answers(replayed.real), answers(replayed.simulated)
    assert [answer for _, answer in simulated] == [answer for _, answer in real]
    for (real_s, answer), (simulated_s, _) in zip(real, simulated, strict=True):
        assert abs(simulated_s - real_s) < 0.05, answer


def test_streams_and_messages_are_given_or_refused_alike(replayed: Replay) -> None:
    """How many is not compared: a slow PX4 lost some of the commands."""
    real, simulated = (
        {
            (s.message.command, s.message.result)
            for s in messages
            if s.name == "COMMAND_ACK" and s.message.command in STREAM_COMMANDS
        }
        for messages in (replayed.real, replayed.simulated)
    )
    assert simulated == real - {NOTHING_NEW}


def texts(messages: list[Stamped]) -> list[tuple[float, tuple[int, int, str]]]:
    return [
        (s.at_s, (s.message.severity, s.message.chunk_seq, s.message.text))
        for s in messages
        if s.name == "STATUSTEXT" and "mission computer" not in s.message.text
    ]


def test_the_same_texts_come_where_a_ground_station_is_heard(replayed: Replay) -> None:
    real, simulated = texts(replayed.real), texts(replayed.simulated)
    assert [text for _, text in simulated] == [text for _, text in real]
    for (real_s, text), (simulated_s, _) in zip(real, simulated, strict=True):
        assert abs(simulated_s - real_s) < 0.1, text


def events(messages: list[Stamped]) -> list[tuple[float, Event]]:
    return [
        (s.at_s, s.message)
        for s in messages
        if s.name == EVENT and s.message.number not in OTHER_EVENTS
    ]


def test_the_same_events_come(replayed: Replay) -> None:
    """Reports of checks with all their bits, what failsafes say, and the rest."""
    real, simulated = events(replayed.real), events(replayed.simulated)
    assert [event for _, event in simulated] == [event for _, event in real]
    for (real_s, event), (simulated_s, _) in zip(real, simulated, strict=True):
        assert abs(simulated_s - real_s) < 0.75, event


def thrusts(messages: list[Stamped], begin_s: float, end_s: float) -> list[int]:
    """In per cent, as reported."""
    return [
        s.message.throttle for s in messages if s.name == "VFR_HUD" and begin_s < s.at_s < end_s
    ]


def test_the_same_thrust_is_told() -> None:
    """Half of the greatest one to hover, none before takeoff and after landing."""
    flight = replay("normal")
    _, takeoff_s, mission_s, return_s, down_s, end_s = flight.phases_s
    for messages in (flight.real, flight.simulated):
        hovering = thrusts(messages, mission_s + 3.0, return_s)
        assert hovering and all(44 <= thrust <= 56 for thrust in hovering)
        assert max(thrusts(messages, 0.0, takeoff_s) + thrusts(messages, down_s, end_s)) <= 1
