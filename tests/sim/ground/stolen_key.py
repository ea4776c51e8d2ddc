"""A thief with a stolen robot's key: how far it pushes the others, and what it holds up.

The thief is on the radio with the key of a robot that does not fly. It hears what the others say,
and answers with lies in its own robot's name: that it is where they fly, and the largest numbers
that their policies take. Flights are on the simulated clock; each lie is told in a copy of a flight
that goes on undisturbed beside it, so that the difference is the lie's.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path

import numpy as np

from edge.core import F32, F64
from edge.core.aggregation import AggregatedMessage
from edge.core.wire import Rejection, decode, encode
from edge.drivers.registry import load_policy
from edge.identity.guard import Sender
from edge.identity.members import Role
from edge.messages.beacon import BEACON_BYTES, Beacon, decode_beacon, encode_beacon
from edge.messages.mission import FlightState, RobotStatus
from edge.messages.topics import MESSAGE
from lpac.analysis.flight import least_separation
from lpac.analysis.truth import TrueTrack
from lpac.ground.station.protocol import Enable, Request, SetOrigin, Start, Takeoff
from lpac.sim.fleet.layout import ORIGIN
from lpac.sim.fleet.simulated import EPOCH_S, SimulatedFleet
from lpac.sim.scenario import Scenario
from tests.conftest import SHIPPED

_LIES_HZ = 20.0
_BESIDE_M = 0.5
# Who is above somebody brakes nobody, and is heeded by the policy of whoever is below.
_ABOVE_M = 5.0
_READY_S = 60.0
_STEP_S = 0.5
# The thief's program began after all others.
_START = int(1e3 * (EPOCH_S + 3600.0))


class Lie(StrEnum):
    """What the thief says of itself."""

    NOTHING = "nothing"
    BESIDE_ONE = "is 0.5 m before one robot"
    BESIDE_EACH = "is 0.5 m before each robot in turn"
    PAYLOAD = "the largest payload"
    BOTH = "the largest payload, 0.5 m before each"
    TAKES_OFF = "takes off all the time"


@dataclass(frozen=True, slots=True)
class Harm:
    """What came of a lie in one mission.

    `pushed_m` is the most that a robot is from where it is without the lie, `fence_m` the least
    that one is inside the fence, both in truth, `estimated_fence_m` that by its own estimate;
    `left_mission` are robots that do not fly it at the end, `down` those that were disarmed or
    landed at any time.
    """

    pushed_m: float
    separation_m: float
    speed_m_s: float
    fence_m: float
    left_mission: int
    down: int
    estimated_fence_m: float


@dataclass(frozen=True, slots=True)
class HeldUp:
    """Robots kept from takeoff or mission while the thief lies, and once it is revoked.

    Each counts robots.
    """

    on_the_ground: int
    on_the_ground_after: int
    from_mission: int
    from_mission_after: int


class Thief:
    """Whoever has the key of one more robot than `fleet` has, on its radio from now on."""

    def __init__(self, fleet: SimulatedFleet, lie: Lie, seed: int) -> None:
        assert fleet.members is not None
        self._robot_id = len(fleet.robots)
        self.name = f"r{self._robot_id}"
        self._lie = lie
        self._policy = load_policy(fleet.layout.bundle)
        limit = fleet.layout.bundle.manifest.payload_limit
        assert limit is not None
        signs = np.random.default_rng(seed).choice([-1.0, 1.0], self._policy.message_size)
        self._payload: F32 = (limit * signs).astype(np.float32)
        self._heard: dict[int, tuple[Beacon, AggregatedMessage | None]] = {}
        self._said = 0
        clock = fleet.schedule
        guard = fleet.members.guard(
            Role.ROBOT, self.name, self._robot_id, _START, clock.monotonic_s
        )
        link = fleet.radio.link(self._robot_id, guard.subscriptions({MESSAGE: self._hear}))
        self._link = guard.wrap(link)
        clock.every(1.0 / _LIES_HZ, self._speak)

    def _hear(self, key: str, data: bytes, __: Sender) -> None:
        beacon = decode_beacon(data, int(key.split("/")[1]))
        message = decode(data[BEACON_BYTES:], message_size=self._policy.message_size)
        if isinstance(message, Rejection):
            self._heard[beacon.robot_id] = beacon, None
        else:
            self._heard[beacon.robot_id] = beacon, message

    def _speak(self) -> None:
        if self._lie is Lie.NOTHING or not self._heard:
            return
        self._said += 1
        whose = sorted(self._heard)
        victim = whose[0 if self._lie is Lie.BESIDE_ONE else self._said % len(whose)]
        beacon, message = self._heard[victim]
        if beacon.position_m is None or beacon.velocity_m_s is None:
            return
        x_m, y_m, z_m = beacon.position_m
        ahead: F64 = np.array(beacon.velocity_m_s[:2])
        ahead = ahead / np.hypot(*ahead) if ahead.any() else np.array([1.0, 0.0])
        if self._lie is Lie.PAYLOAD:
            place_m = (x_m, y_m, z_m + _ABOVE_M)
        else:
            place_m = (x_m + _BESIDE_M * ahead[0], y_m + _BESIDE_M * ahead[1], z_m)
        told = replace(
            beacon,
            robot_id=self._robot_id,
            position_m=place_m,
            state=FlightState.TAKEOFF if self._lie is Lie.TAKES_OFF else beacon.state,
            system_id=None,
        )
        data = encode_beacon(told)
        if message is not None:
            lies = self._lie in (Lie.PAYLOAD, Lie.BOTH)
            said = replace(message, payload=self._payload if lies else message.payload)
            data += encode(said, "float16")
        self._link.publish(MESSAGE, data)


def ready_fleet(robots: int, seed: int, folder: Path) -> SimulatedFleet:
    """A fleet with keys, ready to take off. Raises RuntimeError if it does not get so far."""
    fleet = SimulatedFleet(Scenario(robots=robots, seed=seed, secure=True), folder, SHIPPED)
    _until_all(fleet, lambda _: True)
    _do(fleet, SetOrigin(ORIGIN))
    _do(fleet, Enable())
    _until_all(fleet, lambda status: status.ready)
    return fleet


def harms(
    fleet: SimulatedFleet, lies: Sequence[Lie], seed: int, mission_s: float
) -> dict[Lie, Harm]:
    """What comes of each lie in the mission of a fleet that hovers."""
    _do(fleet, Start())
    _pass(fleet, 5.0)
    undisturbed = _flown(fleet, Lie.NOTHING, seed, mission_s)
    return {
        lie: _harm(
            undisturbed if lie is Lie.NOTHING else _flown(fleet, lie, seed, mission_s), undisturbed
        )
        for lie in lies
    }


def held_up(ready: SimulatedFleet, hovering: SimulatedFleet, seed: int) -> HeldUp:
    """Count robots that do not take off, or start, beside a thief that claims to take off."""
    counts = []
    for before, request, state in (
        (ready, Takeoff(interval_s=0.0), FlightState.HOLD),
        (hovering, Start(), FlightState.MISSION),
    ):
        fleet = before.copy()
        thief = Thief(fleet, Lie.TAKES_OFF, seed)
        _pass(fleet, 2.0)
        counts.append(_kept_from(fleet, request, state))
        assert fleet.members is not None
        fleet.members.revoke(Role.ROBOT, thief.name)
        # What it said last is forgotten.
        _pass(fleet, 5.0)
        counts.append(_kept_from(fleet, request, state))
    return HeldUp(*counts)


def _kept_from(fleet: SimulatedFleet, request: Request, state: FlightState) -> int:
    fleet.ground.command(request)
    return sum(status is None or status.state is not state for status in _statuses(fleet))


def _do(fleet: SimulatedFleet, request: Request) -> None:
    report = fleet.ground.command(request)
    if not report.done:
        raise RuntimeError(f"the flight did not go as planned: {report}")


def _pass(fleet: SimulatedFleet, duration_s: float) -> None:
    fleet.schedule.run_until(fleet.ground.now_s + duration_s)


def _statuses(fleet: SimulatedFleet) -> list[RobotStatus | None]:
    return [robot.status for robot in fleet.robots]


def _until_all(fleet: SimulatedFleet, holds: Callable[[RobotStatus], bool]) -> None:
    end_s = fleet.ground.now_s + _READY_S
    while not all(status is not None and holds(status) for status in _statuses(fleet)):
        if fleet.ground.now_s >= end_s:
            raise RuntimeError(f"the robots do not become ready: {_statuses(fleet)}")
        _pass(fleet, _STEP_S)


@dataclass(frozen=True, slots=True)
class _Flown:
    """`position_m` (N, T, 3) and `speed_m_s` (N, T), in truth and the mission frame."""

    fleet: SimulatedFleet
    tracks: dict[str, TrueTrack]
    position_m: F64
    speed_m_s: F64
    down: int
    estimated_m: list[tuple[float, float]]


def _flown(before: SimulatedFleet, lie: Lie, seed: int, mission_s: float) -> _Flown:
    fleet = before.copy()
    Thief(fleet, lie, seed)
    for each in fleet.vehicles:
        each.vehicle.truth.clear()
    estimated_m: list[tuple[float, float]] = []
    for _ in range(round(mission_s / _STEP_S)):
        _pass(fleet, _STEP_S)
        estimated_m += [s.position_m[:2] for s in _statuses(fleet) if s and s.position_m]
    truths = [each.vehicle.truth for each in fleet.vehicles]
    return _Flown(
        fleet,
        {
            str(robot): TrueTrack(
                np.array([entry.time_s for entry in truth]),
                np.array([entry.position_m for entry in truth]),
                np.array([not entry.landed for entry in truth], np.bool_),
            )
            for robot, truth in enumerate(truths)
        },
        np.array(
            [
                [fleet.layout.to_mission.local_to_mission(np.array(e.position_m)) for e in truth]
                for truth in truths
            ]
        ),
        np.array([[np.hypot(*entry.velocity_m_s[:2]) for entry in truth] for truth in truths]),
        sum(any(entry.landed or not entry.armed for entry in truth) for truth in truths),
        estimated_m,
    )


def _harm(flown: _Flown, undisturbed: _Flown) -> Harm:
    fence = flown.fleet.layout.fence
    separation = least_separation(flown.tracks)
    assert separation is not None
    horizontal_m = flown.position_m[..., :2]
    return Harm(
        pushed_m=float(
            np.linalg.norm(horizontal_m - undisturbed.position_m[..., :2], axis=2).max()
        ),
        separation_m=separation.distance_m,
        speed_m_s=float(flown.speed_m_s.max()),
        fence_m=min(fence.distance_m(x, y) for x, y in horizontal_m.reshape(-1, 2).tolist()),
        left_mission=sum(
            status is None or status.state is not FlightState.MISSION
            for status in _statuses(flown.fleet)
        ),
        down=flown.down,
        estimated_fence_m=min(fence.distance_m(x, y) for x, y in flown.estimated_m),
    )
