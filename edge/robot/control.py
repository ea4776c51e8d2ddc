"""One control tick of a robot: inputs -> flight state -> setpoint and commands."""

import math
from collections.abc import Callable
from dataclasses import asdict
from typing import NamedTuple

from msgspec.structs import replace

from edge.core.fleet_time import FleetTime
from edge.core.logger import log
from edge.core.ports import Camera, Odometry, Recorder, Sensor, Vehicle
from edge.core.vehicle import Action, Mode, Setpoint, VehicleState
from edge.flight.energy import Consumption, Energy, EnergyParameters, home_s
from edge.flight.guidance import Guidance, MissionSetpoint, guide
from edge.flight.landing import Point, place_to_land, possible_landings, standing_robots
from edge.flight.lift import OFF_HEIGHT_M
from edge.flight.record import Given, made
from edge.flight.safety import Closest, nearest
from edge.flight.silence import SilenceLimits, highest_possible_m, last_state
from edge.flight.state import (
    FlightInputs,
    FlightMemory,
    Px4Change,
    Robot,
    exceeds_silence,
    failsafe_acts,
    height_m,
)
from edge.flight.step import step
from edge.messages.beacon import Beacon, Neighbour, ReceivedBeacon
from edge.messages.codes import CheckCode, FailedCheck, Reason
from edge.messages.mission import AIRBORNE, ON_GROUND, STEERED, FlightState, GroundState, Origin
from edge.robot.inbox import Inbox
from edge.robot.navigation import Navigation
from edge.robot.neighbours import BEACON_LASTS_S
from edge.robot.pac import Pac
from edge.robot.readiness import Assignment, Checks

# Beacons come at the policy's rate, or slightly less often without a policy.
_NEIGHBOUR_TIMEOUT_S = 1.5
# Longer, so that beacons lost by a bad radio move no landing point.
_SILENT_FOR_GOOD_S = 3.0
_MAX_CHECKS_AGE_S = 5.0
# Longer than any drone stays in the air.
_REVOKED_STAYS_S = 1800.0
_BUSY = (FlightState.ARMING, FlightState.TAKEOFF)
# States in which others expect a robot at its own height.
_AT_OWN_HEIGHT = (FlightState.HOLD, FlightState.MISSION, FlightState.RETURN)


class GroundWorld(NamedTuple):
    """A world from the ground: a sensor over it, or the problem with it."""

    world_id: str
    sensor: Sensor | Camera | None
    problem: str


class FlightControl:
    """Flies one robot. Call `tick` from the control thread; read the fields from any.

    Other threads set these fields whole: `checks`, `revoked` (revoked robots), `px4_change`, and
    `world` for the `wanted_world_id`. `obeyed_sequence` and `operator` are the last ground state's.
    `assignment` is in use, `not_taken` lists the parts of the ground's state that are not in use.
    `fell_silent` is as in `FlightInputs`, `energy` the battery's estimate.
    """

    def __init__(
        self,
        *,
        robot: Robot,
        world_id: str,
        vehicle: Vehicle,
        navigation: Navigation,
        pac: Pac,
        inbox: Inbox,
        recorder: Recorder,
        energy: EnergyParameters,
        unix_clock_s: Callable[[], float],
        started_s: float,
    ) -> None:
        self._configured = robot
        self._vehicle = vehicle
        self._navigation = navigation
        self._pac = pac
        self._inbox = inbox
        self._recorder = recorder
        self._unix_clock_s = unix_clock_s
        self._started_s = started_s
        self._guidance = Guidance()
        self._last_tick_s: float | None = None
        self._has_flown = False
        self._time_received_at_s = -math.inf
        self._ground_time: FleetTime | None = None
        self._energy_parameters = energy
        self._consumption = Consumption(energy)
        self.energy: Energy | None = None
        self.flight = FlightMemory()
        self.alarms: tuple[Reason, ...] = ()
        self.checks: Checks | None = None
        self.px4_change: Px4Change | None = None
        self.revoked: frozenset[int] = frozenset()
        self.fell_silent: tuple[Neighbour, ...] = ()
        # By robot id, in this frame: the last place of each, and its time.
        self._last_places: dict[int, tuple[Neighbour, float]] = {}
        # The last beacon with a position of each armed robot.
        self._last_flying: dict[int, ReceivedBeacon] = {}
        # The last beacon of each: a robot on the ground may have been switched off.
        self._last_beacons: dict[int, Beacon] = {}
        self._lands_beside_m: Point | None = None
        self.assignment = Assignment(None, robot, world_id)
        self.not_taken: tuple[FailedCheck, ...] = ()
        self.wanted_world_id: str | None = None
        self.world: GroundWorld | None = None
        self.obeyed_sequence = -1
        self._ground_recorded: tuple[str, int, str] | None = None
        self.operator = ""

    def tick(self, now_s: float) -> bool:
        """Run one tick on the newest inputs; sends at most one setpoint.

        Returns whether the vehicle flies by it: the watchdog must not stop PX4's own failsafe.
        """
        vehicle = self._vehicle.state()
        ground, ground_age_s = self._inbox.ground(now_s)
        if ground is not None:
            version = ground.operator, ground.sequence, ground.safety_action_by
            if version != self._ground_recorded:
                self._ground_recorded = version
                self._recorder.record("ground", self._unix_clock_s(), asdict(ground))
            self.obeyed_sequence, self.operator = ground.sequence, ground.operator
            self._update_time(ground, now_s - ground_age_s)
            ground_age_s = self.ground_age_s(now_s)
            self._adopt(ground, vehicle)
        self._navigation.update(vehicle, now_s)
        odometry = self._navigation.estimate(vehicle)
        peers = self._pac.table.beacons(now_s, BEACON_LASTS_S)
        neighbours = self._neighbours(peers, now_s)
        silence = self.assignment.robot.silence
        silent = self._silent(peers, neighbours, silence, now_s)
        self.fell_silent = tuple(each for each in silent if highest_possible_m(each, silence) > 0.0)
        inputs = FlightInputs(
            now_s=now_s,
            vehicle=vehicle,
            position=self._navigation.position,
            odometry=odometry,
            policy_velocity_m_s=self._pac.control(now_s),
            policy_problem=self._pac.problem,
            neighbours=(*neighbours, *self._revoked_places(neighbours, now_s)),
            # Without revoked robots: a thief's last position may brake, but not prevent a mission.
            closest=self._closest(odometry, neighbours),
            busy_neighbours=tuple(
                peer.beacon.robot_id for peer in peers if peer.beacon.state in _BUSY
            ),
            ground=ground,
            ground_age_s=ground_age_s,
            safety_request=self._inbox.safety_request(now_s),
            other_release=self._inbox.other_release,
            failed_checks=self.failed_checks(now_s),
            not_taken=self.not_taken,
            order=self._inbox.order(now_s),
            uptime_s=now_s - self._started_s,
            energy=self._energy(now_s, vehicle, odometry),
            lands_beside_m=self._update_landing_place(peers, silent),
            fell_silent=self.fell_silent,
            px4_change=self.px4_change,
        )
        self.energy = inputs.energy
        before, robot = self.flight, self.assignment.robot
        decision = step(robot, before, inputs)
        self.flight, self.alarms = decision.flight, decision.alarms
        self._has_flown |= decision.flight.state in (FlightState.ARMING, *AIRBORNE)
        self._navigation.datum_m = decision.flight.datum_m
        if decision.new_trial:
            self._pac.forget(decision.flight.trial)
        for action in decision.actions:
            self._vehicle.command(action)
        dt_s = 0.0 if self._last_tick_s is None else now_s - self._last_tick_s
        self._last_tick_s = now_s
        given = Given(robot, before, inputs, self._guidance, dt_s)
        setpoint, self._guidance = guide(robot, decision.flight, inputs, self._guidance, dt_s)
        local = None if setpoint is None else self._navigation.to_local(setpoint, vehicle)
        sent = None if local is None else self._vehicle.send(local)
        if decision.flight.state is not before.state:
            flight = decision.flight
            log.info(
                "flight state", state=flight.state, was=before.state, reason=flight.reason.text
            )
        self._record(inputs, setpoint, sent, decision.actions)
        self._recorder.record(
            "flight",
            self._unix_clock_s(),
            {"given": given, "made": made(decision, setpoint, self._guidance)},
        )
        return sent is not None and not failsafe_acts(vehicle)

    def _update_time(self, ground: GroundState, at_s: float) -> None:
        if at_s == self._time_received_at_s or ground.time_s is None:
            return
        self._time_received_at_s = at_s
        before = self._ground_time
        # An overtaken state has an earlier time.
        if before is None or before.base != ground.time_base or before.time_s < ground.time_s:
            self._ground_time = FleetTime(ground.time_base, ground.time_s, 0.0)
        echo = ground.echoes.get(str(self.assignment.robot.robot_id))
        if echo is not None and echo.boot_nonce == self.assignment.robot.boot_nonce:
            self._pac.clock.update(
                ground.time_base,
                ground.time_s,
                echoed_at_s=self._started_s + echo.uptime_s,
                held_s=echo.held_s,
                now_s=at_s,
            )

    def ground_age_s(self, now_s: float) -> float:
        """Age of the ground's newest state, s; infinite before the first. Thread-safe.

        It includes the least possible transit time.
        """
        since_arrival_s, sent = self._inbox.ground_age_s(now_s), self._ground_time
        age = None if sent is None else self._pac.clock.age_s(sent, now_s)
        return since_arrival_s if age is None else max(since_arrival_s, age.least_s)

    def note_silence(self, silent_since_s: float, now_s: float) -> None:
        """Record the time without a setpoint, as the watchdog counts it.

        A long tick may have started on time, although the watchdog has acted during it.
        """
        if exceeds_silence(self.assignment.robot, now_s - silent_since_s):
            self.flight = replace(self.flight, tick_at_s=silent_since_s)

    @property
    def endurance_s(self) -> float:
        """A full battery's flight time, s: measured in flight, or configured."""
        return self._consumption.endurance_s

    def failed_checks(self, now_s: float) -> tuple[FailedCheck, ...] | None:
        """Failed checks; None without recent ones. Thread-safe."""
        checks = self.checks
        if checks is None or now_s - checks.at_s > _MAX_CHECKS_AGE_S:
            return None
        # Identity, not equality: another assignment in between may be on its way to the vehicle.
        if checks.assignment is not self.assignment:
            return None
        return (*checks.failed, *self.not_taken)

    def leave(self, on_stop: Action) -> Action | None:
        """Final request to the vehicle at the program's end; None if the program does not fly it.

        Call it after the last tick. It takes no control from a pilot or PX4's failsafe.
        """
        if self.flight.state is FlightState.ARMING:
            return Action.DISARM
        vehicle = self._vehicle.state()
        obeys = vehicle.mode in (Mode.OFFBOARD, Mode.HOLD) and not failsafe_acts(vehicle)
        return on_stop if self.flight.state in STEERED and obeys else None

    def _adopt(self, ground: GroundState, vehicle: VehicleState) -> None:
        """Adopt the ground's origin, fence, place and world, on the ground only.

        A program that has not flown its vehicle, such as one started in flight, adopts them at any
        time, since it does not steer. It never adopts an origin or fence out of reach.
        """
        now, armed = self.assignment, vehicle.armed
        origin = now.origin if ground.origin is None else ground.origin
        world_id = now.world_id if ground.world_id is None else ground.world_id
        self.wanted_world_id = None
        if self._has_flown and not (armed is False and self.flight.state in ON_GROUND):
            fence, place = self._configured.fence_and_place(ground)
            parts = {
                CheckCode.KEEPS_ORIGIN: ("mission origin", origin, now.origin),
                CheckCode.KEEPS_FENCE: ("fence", fence, now.robot.fence),
                CheckCode.KEEPS_PLACE: ("place", place, now.robot.place),
                CheckCode.KEEPS_WORLD: ("world", world_id, now.world_id),
            }
            where = "in flight" if armed else "not known to be on the ground"
            self.not_taken = tuple(
                FailedCheck(code, f"{where}: keeps its {what}")
                for code, (what, new, own) in parts.items()
                if new != own
            )
            return
        robot, sensor = now.robot, None
        moves = self._configured.fence_and_place(ground) != (robot.fence, robot.place)
        changes = moves or origin != now.origin
        place_m = self._place_in(origin, vehicle) if changes else None
        if changes and place_m is None and armed is not False:
            # It may be in the air, where no preflight check would find an origin out of reach.
            return
        not_taken: list[FailedCheck] = []
        if origin != now.origin:
            beyond = self._configured.reach.origin_beyond(place_m)
            if beyond is not None:
                not_taken.append(beyond)
                origin = now.origin
        if moves:
            robot, why = self._assigned(ground, self._place_in(origin, vehicle))
            not_taken += why
        if world_id != now.world_id:
            arrived = self.world if self.world and self.world.world_id == world_id else None
            if arrived is None:
                self.wanted_world_id = world_id
                text = f"world {world_id} of the ground has not arrived: wait"
                not_taken.append(FailedCheck(CheckCode.WORLD_NOT_ARRIVED, text, True))
            elif arrived.sensor is None:
                text = f"the ground's world cannot be used: {arrived.problem}"
                not_taken.append(FailedCheck(CheckCode.WORLD_UNUSABLE, text))
            else:
                sensor = arrived.sensor
        self.not_taken = tuple(not_taken)
        self._assign(
            Assignment(origin, robot, now.world_id if sensor is None else world_id), sensor
        )

    def _assigned(
        self, ground: GroundState, place_m: tuple[float, float] | None
    ) -> tuple[Robot, tuple[FailedCheck, ...]]:
        """The robot with the ground's fence and place; or unchanged, with the reason."""
        now = self.assignment.robot
        try:
            assigned = self._configured.assigned(ground)
        except ValueError as error:
            return now, (FailedCheck(CheckCode.FENCE_OR_PLACE_UNFIT, str(error)),)
        beyond = self._configured.reach.fence_beyond(assigned.fence, place_m)
        return (assigned, ()) if beyond is None else (now, (beyond,))

    def _place_in(self, origin: Origin | None, vehicle: VehicleState) -> tuple[float, float] | None:
        return None if origin is None else self._navigation.place_in(origin.frame(), vehicle)

    def _assign(self, assignment: Assignment, sensor: Sensor | Camera | None) -> None:
        """Switch to an assignment; `sensor` is over its world, None if that is unchanged."""
        before = self.assignment
        if assignment == before:
            return
        self.assignment = assignment
        origin, robot, world_id = assignment
        if origin is not None and origin != before.origin:
            frame = origin.frame()
            self._navigation.frame, self._pac.frame_id = frame, frame.frame_id
            self._last_places.clear()
            self._last_flying.clear()
            self._last_beacons.clear()
            self._pac.forget()
        if sensor is not None:
            self._pac.sensor = sensor
            self._pac.forget()
        log.info(
            "adopted from the ground",
            origin=origin and asdict(origin),
            fence=asdict(robot.fence),
            place=asdict(robot.place),
            world=world_id,
        )

    def _neighbours(self, peers: tuple[ReceivedBeacon, ...], now_s: float) -> tuple[Neighbour, ...]:
        """Robots to keep away from, with or without a running policy."""
        return tuple(
            Neighbour(
                beacon.robot_id,
                beacon.position_m,
                beacon.velocity_m_s,
                max(now_s - peer.sent_at_s, 0.0),
                beacon.state is FlightState.PILOT or _is_off_height(beacon),
            )
            for peer in peers
            if now_s - peer.received_at_s <= _NEIGHBOUR_TIMEOUT_S
            and (beacon := peer.beacon).frame_id == self._pac.frame_id
            and beacon.position_m is not None
            and beacon.velocity_m_s is not None
        )

    def _revoked_places(
        self, neighbours: tuple[Neighbour, ...], now_s: float
    ) -> tuple[Neighbour, ...]:
        """Revoked robots at their last places, where they may still hover."""
        for neighbour in neighbours:
            self._last_places[neighbour.robot_id] = neighbour, now_s - neighbour.age_s
        if not self.revoked:
            return ()
        silent = self.revoked.intersection(self._last_places) - {n.robot_id for n in neighbours}
        stay = []
        for robot_id in sorted(silent):
            last, at_s = self._last_places[robot_id]
            if now_s - at_s <= _REVOKED_STAYS_S:
                stay.append(Neighbour(robot_id, last.position_m, (0.0, 0.0, 0.0), 0.0))
        return tuple(stay)

    def _silent(
        self,
        peers: tuple[ReceivedBeacon, ...],
        neighbours: tuple[Neighbour, ...],
        silence: SilenceLimits,
        now_s: float,
    ) -> tuple[Neighbour, ...]:
        """Robots that fell silent in flight, and may come down at their last place.

        Revoked robots are left out: their last beacon may be a thief's.
        """
        for peer in peers:
            beacon = peer.beacon
            if beacon.armed is False:
                self._last_flying.pop(beacon.robot_id, None)
            elif (
                beacon.armed
                and beacon.position_m is not None
                and beacon.velocity_m_s is not None
                and beacon.frame_id == self._pac.frame_id
            ):
                self._last_flying[beacon.robot_id] = peer
        others = {self.assignment.robot.robot_id, *(n.robot_id for n in neighbours), *self.revoked}
        return tuple(
            replace(last, age_s=now_s - self._last_flying[robot_id].received_at_s)
            for robot_id in sorted(self._last_flying.keys() - others)
            if (last := last_state(self._last_flying[robot_id].beacon, silence)) is not None
        )

    def _update_landing_place(
        self, peers: tuple[ReceivedBeacon, ...], silent: tuple[Neighbour, ...]
    ) -> Point | None:
        frame_id, robot = self._pac.frame_id, self.assignment.robot
        for peer in peers:
            beacon = peer.beacon
            if beacon.frame_id == frame_id and beacon.robot_id != robot.robot_id:
                self._last_beacons[beacon.robot_id] = beacon
        others, parameters = self._last_beacons, robot.parameters
        standing = standing_robots(others.values())
        standing += [
            place
            for each in silent
            if each.age_s > _SILENT_FOR_GOOD_S
            for place in possible_landings(
                each, others[each.robot_id].landing_point_m, robot.silence
            )
        ]
        if not standing:
            self._lands_beside_m = None
            return None
        # Of two robots that choose a place, the lower one has priority.
        return_first = [
            beacon.position_m[:2]
            for beacon in others.values()
            if beacon.state is FlightState.RETURN
            and beacon.position_m is not None
            and beacon.slot_height_m < parameters.slot_height_m
        ]
        x_m, y_m = parameters.landing_point_m
        self._lands_beside_m = place_to_land(
            (x_m, y_m),
            self._lands_beside_m,
            standing,
            [*(beacon.landing_point_m for beacon in others.values()), *return_first],
            robot.fence,
            robot.errors,
        )
        return self._lands_beside_m

    def _closest(
        self, odometry: Odometry | None, neighbours: tuple[Neighbour, ...]
    ) -> Closest | None:
        if odometry is None:
            return None
        # As in the robot's own beacon.
        height = height_m(self.flight, odometry) or 0.0
        return nearest((*odometry.position_m[:2], height), neighbours)

    def _energy(
        self, now_s: float, vehicle: VehicleState, odometry: Odometry | None
    ) -> Energy | None:
        self._consumption.add(now_s, vehicle.armed, vehicle.battery, vehicle.voltage_v)
        robot, way_s = self.assignment.robot, None
        height = height_m(self.flight, odometry)
        if odometry is not None and height is not None:
            parameters, limits = robot.parameters, robot.limits
            way_s = home_s(
                self._energy_parameters,
                away_m=math.dist(odometry.position_m[:2], parameters.landing_point_m),
                height_m=height,
                slot=parameters.slot,
                slot_height_m=parameters.slot_height_m,
                max_speed_m_s=limits.max_speed_m_s,
                max_climb_m_s=limits.max_climb_m_s,
            )
        return self._consumption.energy(robot.parameters.battery_critical, way_s)

    def _record(
        self,
        inputs: FlightInputs,
        setpoint: MissionSetpoint | None,
        sent: Setpoint | None,
        actions: tuple[Action, ...],
    ) -> None:
        odometry, velocity_m_s = inputs.odometry, inputs.policy_velocity_m_s
        self._recorder.record(
            "control",
            self._unix_clock_s(),
            {
                "state": self.flight.state,
                "reason": self.flight.reason.text,
                "reason_code": self.flight.reason.code,
                "position_quality": inputs.position.quality,
                "position_cause": inputs.position.cause,
                "height_m": height_m(self.flight, odometry),
                "position_m": odometry and odometry.position_m,
                "velocity_m_s": odometry and odometry.velocity_m_s,
                "policy_velocity_m_s": None if velocity_m_s is None else velocity_m_s.tolist(),
                "setpoint_kind": None if setpoint is None else type(setpoint).__name__,
                "setpoint": None if setpoint is None else setpoint[0],
                "sent_local": None if sent is None else sent[0],
                "actions": actions,
                "closest_m": inputs.closest and inputs.closest.distance_m,
            },
        )
        if inputs.order is not None:
            order_id = inputs.order.order_id
            given = (answer for answer in self.flight.answers if answer.order_id == order_id)
            record = {**asdict(inputs.order), "answer": next(given, None)}
            self._recorder.record("order", self._unix_clock_s(), record)


def _is_off_height(beacon: Beacon) -> bool:
    if beacon.position_m is None or beacon.state not in _AT_OWN_HEIGHT:
        return False
    return abs(beacon.position_m[2] - beacon.slot_height_m) > OFF_HEIGHT_M
