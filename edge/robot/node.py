"""One robot: its parts, and their steps.

It has no clock, thread or socket of its own. On a drone, threads call the steps
(`edge.robot.process`); in the simulator, one simulated clock does.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from functools import partial

from edge.core.changes import fields_of
from edge.core.logger import log
from edge.core.ports import Clock, Recorder, SensorOver, Vehicle, VehicleSetup, Watchdog
from edge.core.vehicle import Action
from edge.flight.state import flown_s, in_air
from edge.identity.guard import Guard, Sender
from edge.messages.beacon import BEACON_BYTES, decode_beacon, encode_beacon, tag
from edge.messages.bounds import MOST_TEXTS
from edge.messages.codec import MessageError, encode
from edge.messages.codes import CheckCode, FailedCheck, Reason, ReasonCode
from edge.messages.mission import (
    AIRBORNE,
    ON_GROUND,
    FlightState,
    LoopStatus,
    RadioCounts,
    RobotStatus,
    explored_to_bytes,
    world_id,
)
from edge.messages.topics import (
    EXPLORED,
    HOLD,
    MESSAGE,
    ORDER,
    STATE,
    STATUS,
    WORLD,
    Link,
    ReceiveCallback,
    Topic,
    robot_id_in,
)
from edge.policy.family import VerifiedPolicy
from edge.robot.config import RobotConfig
from edge.robot.control import FlightControl, GroundWorld
from edge.robot.inbox import Inbox
from edge.robot.navigation import Navigation
from edge.robot.neighbours import BEACON_LASTS_S
from edge.robot.pac import Pac
from edge.robot.readiness import Readiness

_EXPLORED_PERIOD_S = 1.0
# The checks of an armed vehicle are only displayed.
_ARMED_CHECKS_PERIOD_S = 0.95
# Without an urgent change; slightly below the rate's period, since ticks are never early.
_STATUS_PERIOD_S = 1.0 / STATUS.rate_hz - 0.05
# The counts are long, and used for differences over many seconds.
_RADIO_COUNTS_PERIOD_S = 1.9
# A beacon is sent alone after the shorter of these, in policy periods and s, without a message:
# neighbours forget a robot after 3 s.
_SILENT_TICKS, _SILENT_S = 1.5, 1.0
# States in which it commands the vehicle, and may restore its settings.
_STEERS = (FlightState.ARMING, *AIRBORNE)
_CHECKS_RUNNING = (FailedCheck(CheckCode.CHECKS_RUNNING, "checks are still running", True),)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Ports:
    """One robot's interfaces to the outside."""

    clock: Clock
    vehicle: Vehicle
    vehicle_setup: VehicleSetup
    watchdog: Watchdog
    recorder: Recorder
    sensor_over: SensorOver


class RobotNode:
    """One robot. Call each `*_step` from one thread; the subscriptions' callbacks are thread-safe.

    It publishes and receives through its guard, and publishes nothing before `attach`. `boot_nonce`
    identifies this start of its program. `host_alarms` are the computer's, and `identity_problem`
    is why the identity cannot be written, both set by the process. `status` is the last one, None
    before the first.
    """

    def __init__(
        self,
        config: RobotConfig,
        ports: Ports,
        policy: VerifiedPolicy,
        world: str,
        guard: Guard,
        *,
        boot_nonce: int,
    ) -> None:
        """Take the text of a world file as `world`. Raises ValueError if it cannot be used."""
        clock = ports.clock
        self._config = config
        self._ports = ports
        self._bundle_id = policy.policy.bundle_id.hex()
        self._boot_nonce = boot_nonce
        self._started_s = clock.monotonic_s()
        self._fed_s = -math.inf
        self._guard = guard
        self._link: Link | None = None
        self._navigation = Navigation(ports.vehicle, clock.monotonic_s, config.position)
        self._inbox = Inbox(config.robot_id, config.flight.ground_timeout_s, guard.release)
        self._pac = Pac(
            robot_id=config.robot_id,
            policy=policy.policy,
            sensor=ports.sensor_over(world, config.policy.world),
            odometry=self._navigation,
            parameters=config.pac(policy.policy.manifest.payload_types),
        )
        self._control = FlightControl(
            robot=config.robot(boot_nonce),
            world_id=world_id(world),
            vehicle=ports.vehicle,
            navigation=self._navigation,
            pac=self._pac,
            inbox=self._inbox,
            recorder=ports.recorder,
            energy=config.energy,
            unix_clock_s=clock.unix_s,
            started_s=self._started_s,
        )
        self.readiness = Readiness(
            config,
            ports.vehicle,
            ports.vehicle_setup,
            bundle_id=self._bundle_id,
            bundle_problem=policy.problem,
        )
        self.identity_problem = ""
        self._statuses = 0
        self.status: RobotStatus | None = None
        self.host_alarms: tuple[Reason, ...] = ()
        # Urgent values of the last published status.
        self._published: tuple[object, ...] = ()
        self._published_at_s = -math.inf
        self._radio_counts_at_s = -math.inf
        self._message_at_s = -math.inf
        # Count of the policy's messages, and their bytes; count of beacons sent alone.
        self._sent = (0, 0)
        self._sent_alone = 0
        self._warned: set[str] = set()
        self._explored_due_s = -math.inf

    @property
    def subscriptions(self) -> Mapping[Topic, ReceiveCallback]:
        """Subscriptions for the link: topic -> callback with the key and the data."""
        return self._guard.subscriptions(
            {
                MESSAGE: self._receive_message,
                STATE: partial(self._receive_now, self._inbox.receive_ground),
                HOLD: partial(self._receive_now, self._inbox.receive_hold),
                ORDER: partial(self._receive_now, self._inbox.receive_order),
                WORLD: self._receive_world,
            }
        )

    def attach(self, link: Link) -> None:
        """Publish on this link from now on."""
        self._link = self._guard.wrap(link)

    def _receive_now(
        self, receive: Callable[[bytes, Sender, float], None], _: str, data: bytes, sender: Sender
    ) -> None:
        receive(data, sender, self._ports.clock.monotonic_s())

    def _receive_world(self, _: str, data: bytes, __: Sender) -> None:
        self._inbox.world = data

    def _receive_message(self, key: str, data: bytes, sender: Sender) -> None:
        now_s, unix_now_s = self._ports.clock.monotonic_s(), self._ports.clock.unix_s()
        robot_id = robot_id_in(key)
        if robot_id is None:
            return
        rejection = age_s = None
        try:
            release = "" if sender.release == self._guard.release else sender.release.hex()
            beacon = decode_beacon(data, robot_id, release)
        except MessageError:
            self._inbox.receive_unreadable(robot_id, now_s)
        else:
            age_s = self._pac.age_s(beacon, now_s)
            rejection = self._pac.receive(beacon, sender.number, data[BEACON_BYTES:], now_s)
        self._ports.recorder.record(
            "received",
            unix_now_s,
            {
                "sender": robot_id,
                "sequence": sender.number.sequence,
                "age_s": age_s,
                "rejection": rejection,
            },
        )

    def control_step(self) -> None:
        """Decide from the newest inputs, and send at most one setpoint."""
        clock = self._ports.clock
        self._control.revoked = self._guard.revoked_robots()
        flying = self._control.tick(clock.monotonic_s())
        self._ports.watchdog.feed(flying=flying)
        now_s = clock.monotonic_s()
        self._control.note_silence(self._fed_s, now_s)
        self._fed_s = now_s

    def perception_step(self) -> None:
        """Perceive, record, and publish the explored map once a second."""
        now_s = self._ports.clock.monotonic_s()
        tick = self._pac.perceive(now_s)
        self._warn_once(self._pac.problem)
        if now_s >= self._explored_due_s:
            self._explored_due_s = now_s + _EXPLORED_PERIOD_S
            self._publish(EXPLORED, explored_to_bytes(self._pac.explored()))
        if tick is not None:
            self._ports.recorder.record(
                "perception", self._ports.clock.unix_s(), {**tick.inputs, "features": tick.features}
            )

    def policy_step(self) -> None:
        """Run the policy on the neighbours' messages, and publish its own message."""
        tick = self._pac.infer(self._ports.clock.monotonic_s(), on_ground=self.on_ground)
        self._warn_once(self._pac.problem)
        if tick is None:
            return
        self._publish_message(tick.message)
        self._ports.recorder.record("policy", self._ports.clock.unix_s(), fields_of(tick))

    def _warn_once(self, problem: str) -> None:
        if problem and problem not in self._warned:
            self._warned.add(problem)
            log.warning("sensor or policy result not used", why=problem)

    def _publish_message(self, of_policy: bytes = b"") -> None:
        """Publish a beacon, and the policy's message after it, if there is one."""
        control, vehicle = self._control, self._ports.vehicle.state()
        now_s = self._ports.clock.monotonic_s()
        assignment, gps = control.assignment, vehicle.gps
        parameters = assignment.robot.parameters
        x_m, y_m = parameters.landing_point_m
        self._message_at_s = now_s
        beacon = dataclasses.replace(
            self._pac.beacon(now_s),
            world_tag=tag(assignment.world_id),
            state=control.flight.state,
            armed=vehicle.armed,
            system_id=vehicle.system_id,
            gps_accuracy_m=None if gps is None else gps.accuracy_m,
            flown_s=flown_s(control.flight, vehicle, now_s),
            slot_height_m=parameters.slot_height_m,
            landing_point_m=(x_m, y_m),
        )
        data = encode_beacon(beacon) + of_policy
        if of_policy:
            count, total_bytes = self._sent
            self._sent = count + 1, total_bytes + len(data)
        else:
            self._sent_alone += 1
        self._publish(MESSAGE, data)

    def try_sensor(self) -> str:
        """Describe the fault of a sensor reading over its landing point; "" if there is none.

        For `lpac robot check`, without running loops.
        """
        flight = self._control.assignment.robot.parameters
        x_m, y_m = flight.landing_point_m
        return self._pac.try_sensor((x_m, y_m, flight.slot_height_m))

    def preflight_step(self) -> None:
        """Prepare and check the vehicle, a few times a second; may wait for the vehicle.

        An armed vehicle is checked less often.
        """
        control = self._control
        self._load_world()
        assignment = control.assignment
        if not self._checks_are_due(self._ports.clock.monotonic_s()):
            return
        self.readiness.prepare(
            self._ports.clock.monotonic_s(), assignment, steers=control.flight.state in _STEERS
        )
        control.px4_change = self.readiness.px4_change
        now_s = self._ports.clock.monotonic_s()
        # The robot's own wall clock may be behind: there is no internet in the field.
        ground_unix_s = self._inbox.ground_unix_s(now_s)
        if ground_unix_s is not None:
            self._guard.receive_time(max(ground_unix_s, self._ports.clock.unix_s()))
        for robot_id in self._guard.pop_unreadable_robots():
            self._inbox.receive_unreadable(robot_id, now_s)
        time = self._pac.clock.at(now_s)
        control.checks = self.readiness.checks(
            now_s,
            assignment=assignment,
            position=self._navigation.position,
            odometry=self._navigation.odometry(),
            peers=self._pac.table.beacons(now_s, BEACON_LASTS_S),
            unreadable_robots=self._inbox.unreadable_robots(now_s),
            ground_release=self._inbox.other_release,
            missing_robots=self._inbox.missing_robots(now_s, self._pac.table),
            fell_silent=control.fell_silent,
            duplicate=self._is_duplicate(),
            watchdog_alive=self._ports.watchdog.alive(),
            is_member=self._guard.is_member(),
            members_differ=self._guard.members_differ(),
            ground_age_s=control.ground_age_s(now_s),
            time_uncertainty_s=None if time is None else time.uncertainty_s,
            answer_age_s=self._pac.action_age_s(now_s),
            answer_problem=self._pac.problem,
        )

    def _checks_are_due(self, now_s: float) -> bool:
        checks = self._control.checks
        if not self._ports.vehicle.state().armed or checks is None:
            return True
        changed = checks.assignment is not self._control.assignment
        return changed or now_s - checks.at_s >= _ARMED_CHECKS_PERIOD_S

    def _load_world(self) -> None:
        """Make a sensor over the ground's world, once the world has arrived."""
        wanted, data = self._control.wanted_world_id, self._inbox.world
        if wanted is None or data is None:
            return
        text = data.decode("utf-8", "replace")
        if world_id(text) != wanted:
            return
        try:
            sensor = self._ports.sensor_over(text, f"world {wanted}")
        except (ValueError, ArithmeticError) as error:
            self._control.world = GroundWorld(wanted, None, str(error))
        else:
            self._control.world = GroundWorld(wanted, sensor, "")

    def status_step(self, loops: Mapping[str, LoopStatus]) -> RobotStatus:
        """Publish and record the status, a few times a second.

        `loops` has the status of each loop that calls the steps, by name.
        """
        now_s, unix_now_s = self._ports.clock.monotonic_s(), self._ports.clock.unix_s()
        self.status = status = self._status(now_s, unix_now_s, loops)
        urgent = _urgent_values(status)
        if urgent != self._published or now_s - self._published_at_s >= _STATUS_PERIOD_S:
            self._published, self._published_at_s = urgent, now_s
            if status.radio_counts is not None:
                self._radio_counts_at_s = now_s
            self._publish(STATUS, encode(status))
        silent_s = min(_SILENT_TICKS / self._config.rates.policy_hz, _SILENT_S)
        if now_s - self._message_at_s > silent_s:
            # The policy is silent or hangs: neighbours must not lose this robot's position.
            self._publish_message()
        vehicle = self._ports.vehicle.state()
        self._ports.recorder.record("status", unix_now_s, fields_of(status))
        self._ports.recorder.record("vehicle", unix_now_s, fields_of(vehicle))
        if status.position_m is not None:
            yaw_rad = status.heading_rad
            if yaw_rad is not None and status.origin is not None:
                # From compass heading to the angle from x, which is right of the mission heading.
                yaw_rad = math.pi / 2.0 - (yaw_rad - math.radians(status.origin.heading_deg))
            pose = {"position_m": status.position_m, "yaw_rad": yaw_rad}
            self._ports.recorder.record("/pose", unix_now_s, pose)
        return status

    def _status(
        self, now_s: float, unix_now_s: float, loops: Mapping[str, LoopStatus]
    ) -> RobotStatus:
        control, vehicle = self._control, self._ports.vehicle.state()
        gps = vehicle.gps
        origin, robot, world = control.assignment
        flight, failed_checks = control.flight, control.failed_checks(now_s)
        odometry = self._navigation.odometry()
        self._statuses += 1
        ready = flight.state is FlightState.PREFLIGHT and failed_checks == ()
        neighbours = self._pac.table.neighbours(now_s)
        policy_velocity_m_s = self._pac.control(now_s)
        ground_age_s = control.ground_age_s(now_s)
        energy = control.energy
        return RobotStatus(
            robot_id=robot.robot_id,
            boot_nonce=self._boot_nonce,
            sequence=self._statuses,
            uptime_s=now_s - self._started_s,
            unix_time_s=unix_now_s,
            state=flight.state,
            reason=flight.reason,
            ready=ready,
            failed_checks=_CHECKS_RUNNING if failed_checks is None else failed_checks[:MOST_TEXTS],
            alarms=(*control.alarms, *self._alarms()),
            obeyed_sequence=control.obeyed_sequence,
            operator=control.operator,
            orders=flight.answers,
            bundle_id=self._bundle_id,
            world_id=world,
            trial=flight.trial,
            origin=origin,
            system_id=vehicle.system_id,
            slot_height_m=robot.parameters.slot_height_m,
            landing_point_m=robot.parameters.landing_point_m,
            position_m=odometry and odometry.position_m,
            velocity_m_s=odometry and odometry.velocity_m_s,
            heading_rad=vehicle.heading_rad,
            mode=vehicle.mode,
            armed=vehicle.armed,
            battery=vehicle.battery,
            satellites=None if gps is None else gps.satellites,
            message_counts=self._message_counts(),
            neighbour_ages_s={
                str(beacon.robot_id): round(max(now_s - sent_at_s, 0.0), 3)
                for beacon, _, sent_at_s in neighbours
            },
            loops=dict(loops),
            fence=robot.fence,
            not_taken=control.not_taken,
            in_air=in_air(flight, vehicle, now_s),
            global_deg=self._navigation.global_deg(vehicle),
            hdop=gps.hdop if gps is not None and math.isfinite(gps.hdop) else None,
            policy_velocity_m_s=(
                None if policy_velocity_m_s is None else tuple(policy_velocity_m_s.tolist())
            ),
            feature_age_s=self._pac.feature_age_s(now_s),
            neighbour_messages={str(r): n for r, n in self._pac.table.accepted().items()},
            ground_age_s=ground_age_s if math.isfinite(ground_age_s) else None,
            remote_control=(
                bool(vehicle.remote_control) if self._config.failsafe.rc == "pilot" else None
            ),
            battery_lasts_s=None if energy is None else energy.lasts_s,
            home_s=None if energy is None else energy.home_s,
            endurance_s=control.endurance_s,
            flown_s=flown_s(flight, vehicle, now_s),
            position_quality=self._navigation.position.quality,
            position_cause=self._navigation.position.cause,
            gps_accuracy_m=None if gps is None else gps.accuracy_m,
            radio_counts=(
                self._radio_counts()
                if now_s - self._radio_counts_at_s >= _RADIO_COUNTS_PERIOD_S
                else None
            ),
        )

    def _alarms(self) -> tuple[Reason, ...]:
        alarms = [*self.host_alarms]
        if self._is_duplicate():
            text = f"another program uses the id of robot {self._config.robot_id}: stop it"
            alarms.append(Reason(ReasonCode.DUPLICATE_ID, text))
        duplicates = sorted(self._guard.duplicate_robots() - {self._config.robot_id})
        if duplicates:
            ids = ", ".join(map(str, duplicates))
            text = f"two programs have the key of robot {ids}: end one, or revoke it and restart "
            alarms.append(Reason(ReasonCode.SAID_TWICE, f"{text}the robot"))
        if not self._ports.watchdog.alive():
            text = "the watchdog has ended: only PX4 notices if this program hangs"
            alarms.append(Reason(ReasonCode.WATCHDOG_ENDED, text))
        if not self._ports.recorder.recording:
            text = "the flight log is not written: free space on its disk, or replace the disk"
            alarms.append(Reason(ReasonCode.LOG_NOT_WRITTEN, text))
        if self.identity_problem:
            text = f"the number of this start cannot be written: {self.identity_problem}"
            alarms.append(Reason(ReasonCode.IDENTITY_NOT_WRITTEN, text))
        if not self._guard.is_member():
            text = "its key is not in the fleet's list of members: all members ignore it"
            alarms.append(Reason(ReasonCode.NOT_A_MEMBER, text))
        if differ := self._guard.members_differ():
            alarms.append(Reason(ReasonCode.MEMBERS_DIFFER, differ))
        if self._inbox.ground_refusal:
            text = f"the ground's state cannot be read: {self._inbox.ground_refusal}"
            alarms.append(Reason(ReasonCode.GROUND_NOT_UNDERSTOOD, text))
        return tuple(alarms)

    @property
    def on_ground(self) -> bool:
        """Whether its flight state is one on the ground."""
        return self._control.flight.state in ON_GROUND

    @property
    def failed_checks(self) -> tuple[FailedCheck, ...] | None:
        """Failed checks; None while the checks are running."""
        return self._control.failed_checks(self._ports.clock.monotonic_s())

    def leave(self, on_stop: Action) -> Action | None:
        """Final request to a vehicle that it flies, when its program ends; None if it does not.

        Call it after the last control step.
        """
        return self._control.leave(on_stop)

    def _publish(self, topic: Topic, data: bytes) -> None:
        if self._link is not None:
            self._link.publish(topic, data)

    def _message_counts(self) -> dict[str, int]:
        """Counts of received messages, accepted or refused, from the policy out to the radio."""
        not_admitted = 0 if self._link is None else self._link.refused()
        besides = {"not_admitted": not_admitted, "not_understood": self._inbox.not_understood_count}
        counts = self._pac.table.counts() | self._guard.refused()
        return counts | {what: count for what, count in besides.items() if count}

    def _radio_counts(self) -> RadioCounts:
        (of_policy, sent_bytes), alone = self._sent, self._sent_alone
        arrivals = self._pac.table.arrivals().items()
        return RadioCounts(
            of_policy + alone,
            sent_bytes + alone * BEACON_BYTES,
            {str(robot): each.counts for robot, each in arrivals},
        )

    def _is_duplicate(self) -> bool:
        robot_id = self._config.robot_id
        is_claimed = self._link is not None and self._link.is_claimed(robot_id)
        is_received = self._pac.table.is_own_id_received(self._ports.clock.monotonic_s())
        return is_claimed or is_received or robot_id in self._guard.duplicate_robots()


def _urgent_values(status: RobotStatus) -> tuple[object, ...]:
    """Values of which a change is published at once; codes in place of texts."""
    return (
        status.state, status.reason.code, status.ready, status.orders, status.obeyed_sequence,
        status.operator, status.trial, status.world_id, status.origin, status.fence, status.armed,
        status.in_air, status.mode, status.position_quality,
        *(check.code for check in (*status.failed_checks, *status.not_taken)),
        *(alarm.code for alarm in status.alarms),
    )  # fmt: skip
