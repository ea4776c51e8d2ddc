"""One robot's program: everything is built and wired here, in numbered steps.

Threads: the three loops (`perception`, `policy`, `control`); `status`; `log`, which waits for the
disk; `preflight`, which waits for the vehicle while that stands on the ground; zenoh's and MAVSDK's
own, whose callbacks only store; and the main thread, which waits for signals, tells systemd that
the control loop lives, and does nothing that could hang.
"""

import ctypes
import dataclasses
import gc
import json
import logging
import math
import secrets
import sys
import threading
import time
from contextlib import ExitStack
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import structlog

from edge.core.px4_version import in_words
from edge.core.vehicle import Action
from edge.core.world import MOST_FEATURES, parse_world, rasterize
from edge.drivers.flight_log import FlightLog, FlightMetadata
from edge.drivers.logs import configure_logging
from edge.drivers.process_lock import ProcessLock
from edge.drivers.px4.autopilot import MavsdkAutopilot
from edge.drivers.px4.watchdog import Watchdog
from edge.drivers.systemd import ALIVE, READY, STOPPING, ServiceManager, status_text
from edge.drivers.world_sensor import WorldSensor
from edge.drivers.zenoh_link import ZenohLink
from edge.flight.state import flown_s
from edge.messages.beacon import BEACON_BYTES, Beacon, decode_beacon, encode_beacon, tag
from edge.messages.bounds import MOST_TEXTS
from edge.messages.codec import MessageError, encode
from edge.messages.codes import CheckCode, FailedCheck, Reason, ReasonCode
from edge.messages.mission import FlightState, RobotStatus, explored_to_bytes, world_id
from edge.messages.topics import EXPLORED, MESSAGE, ORDER, STATE, STATUS, WORLD
from edge.policy.bundle import Manifest, load_bundle
from edge.policy.lpac.graphs import Policy
from edge.policy.verify import verify
from edge.robot.config import RobotConfig
from edge.robot.control import FlightControl, GroundWorld
from edge.robot.inbox import Inbox
from edge.robot.loops import Loop
from edge.robot.navigation import Navigation
from edge.robot.pac import Pac
from edge.robot.readiness import Assignment, Readiness

# Of preflight checks, status, systemd's news, and writing the flight log.
_PERIOD_S = 0.25
_EXPLORED_PERIOD_S = 1.0
# A status without news; what is new goes at once. A little less, since ticks are never early.
_STATUS_PERIOD_S = 1.0 / STATUS.rate_hz - 0.05
# After as many of the policy's periods without a message, a beacon goes alone.
_SILENT_TICKS = 1.5
# A control loop without a tick for longer hangs: the vehicle was told to hold before that.
_CONTROL_FRESH_S = 1.0
# On leaving: for the autopilot's answer, and for a loop that hangs.
_ANSWER_S = 1.2
_JOIN_S = 0.3
# The interpreter lets another thread run this often: a tick must not wait 5 ms for each other one.
_SWITCH_INTERVAL_S = 0.001
_CHECKS_RUNNING = (FailedCheck(CheckCode.CHECKS_RUNNING, "checks are still running", True),)

_log = structlog.get_logger(__name__)


class RobotError(ValueError):
    """The robot's program cannot start; the text says why and what to do."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Loaded:
    """What a robot needs before any hardware: all of it is checked already.

    `bundle_problem` is why the bundle was not verified on this CPU, None if it was.
    """

    policy: Policy
    bundle_id: str
    bundle_problem: str | None
    sensor: WorldSensor
    world_id: str


def load(config: RobotConfig) -> Loaded:
    """Load and verify policy and world. Raises ValueError or OSError that says what is wrong."""
    bundle = load_bundle(Path(config.policy.bundle))
    if bundle.manifest.perception is None:
        raise RobotError(f"{config.policy.bundle}: the bundle has no perception: it cannot fly")
    failed = [check.name for check in verify(bundle) if not check.passed]
    problem = None
    if failed:
        problem = f"{', '.join(failed)} of the bundle do not compute torch's golden outputs here"
    text = Path(config.policy.world).read_text("utf-8-sig")
    return Loaded(
        policy=Policy(bundle),
        bundle_id=bundle.id,
        bundle_problem=problem,
        sensor=_sensor(text, config.policy.world, bundle.manifest),
        world_id=world_id(text),
    )


def _sensor(text: str, source: str, manifest: Manifest) -> WorldSensor:
    """A sensor over a world file's text. Raises ValueError, one line with `source`."""
    perception, training = manifest.perception, manifest.training
    assert perception is not None  # Without it no robot is loaded.
    features = parse_world(text, source)
    if len(features) > MOST_FEATURES:
        raise ValueError(f"{source}: has {len(features)} features, at most {MOST_FEATURES} may be")
    truncation, norm = training.idf_truncation, training.idf_norm
    importance = rasterize(features, perception.world_size, truncation, norm)
    return WorldSensor(importance, perception.sensor_size)


def run(config: RobotConfig, stop: threading.Event) -> None:
    """Fly one robot until `stop` is set. Called from the main thread.

    Raises ValueError or OSError, in one line, for what keeps the program from starting.
    """
    # 1. Policy and world, before anything that moves.
    loaded = load(config)
    if stop.is_set():
        return
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    boot_nonce, boot_epoch = secrets.randbits(48), time.time_ns() // 1_000_000
    with ExitStack() as parts:
        service_manager = ServiceManager()
        parts.callback(service_manager.close)
        # 2. One program per robot, and per vehicle, on this machine.
        _take_alone(config, parts)
        # 3. The flight log, so that it holds all that follows.
        recorder = _open_log(config, loaded, boot_nonce)
        parts.callback(recorder.close)
        configure_logging(recorder)
        # 4. The vehicle, and who holds it when this program hangs.
        autopilot = parts.enter_context(
            MavsdkAutopilot(config.autopilot.url, system_id=config.autopilot.system_id)
        )
        watchdog = parts.enter_context(
            Watchdog(
                config.autopilot.port,
                config.autopilot.system_id,
                config.flight.command_timeout_s,
                config.flight.hover_land_s,
            )
        )
        # 5. What the robot knows: its place, its radio mail, its map and messages.
        navigation = Navigation(autopilot, time.monotonic, config.position)
        inbox = Inbox(config.robot_id, config.flight.ground_timeout_s)
        pac = Pac(
            robot_id=config.robot_id,
            boot_epoch=boot_epoch,
            policy=loaded.policy,
            sensor=loaded.sensor,
            odometry=navigation,
            parameters=config.pac,
        )
        # 6. The radio that feeds it.
        link = parts.enter_context(_open_link(config, inbox, config.robot_id, pac, recorder))
        # 7. The loops, and what ends them: the vehicle holds or lands, then everything is closed.
        program = _Program(
            config, loaded, autopilot, watchdog, recorder, navigation, inbox, pac, link,
            boot_nonce, boot_epoch,
        )  # fmt: skip
        gc.collect()
        gc.freeze()  # What is loaded stays: a collection in flight need not look through it.
        ctypes.CDLL(None).malloc_trim(0)  # What verification took goes back to the system.
        program.start()
        parts.callback(program.leave)
        parts.callback(service_manager.tell, STOPPING)
        _log.info("robot runs", robot=config.robot_id, bundle=loaded.bundle_id[:12])
        # 8. Until somebody stops the program.
        while not stop.wait(_PERIOD_S):  # A signal that another thread took is seen only here.
            service_manager.tell(*program.news())


def _open_log(config: RobotConfig, loaded: Loaded, boot_nonce: int) -> FlightLog:
    metadata = FlightMetadata(
        robot_id=config.robot_id,
        boot_nonce=boot_nonce,
        bundle_id=loaded.bundle_id,
        bundle_path=config.policy.bundle,
        configuration=json.dumps(dataclasses.asdict(config)),
        version=version("lpac-edge"),
    )
    max_total_bytes = int(config.log.max_total_mb * 1e6)
    return FlightLog(Path(config.log.folder), metadata, max_total_bytes=max_total_bytes)


def _receive(
    inbox: Inbox, pac: Pac | None, recorder: FlightLog | None, key: str, data: bytes
) -> None:
    """A robot's message, from the link's threads: to inbox and mailbox, and what came to the log.

    Raises nothing; who only looks has neither mailbox nor log.
    """
    now_s, unix_now_s = time.monotonic(), time.time()
    sender = int(key.split("/")[1])
    try:
        beacon = decode_beacon(data)
    except MessageError:
        beacon = None
    if beacon is None or beacon.robot_id != sender:
        inbox.put_stranger(f"robot {sender}", now_s)
    else:
        inbox.put_beacon(beacon, now_s, unix_now_s)
    rejection = None
    if pac is not None and len(data) > BEACON_BYTES:
        rejection = pac.receive(data[BEACON_BYTES:], now_s, unix_now_s)
    if recorder is not None:
        recorder.record(
            "received",
            unix_now_s,
            {
                "sender": sender,
                "sequence": beacon and beacon.sequence,
                "age_s": beacon and unix_now_s - beacon.sent_at_s,
                "rejection": rejection,
            },
        )


class _Program:
    """The parts of a running robot. The main thread calls its methods, the loops its steps."""

    def __init__(
        self,
        config: RobotConfig,
        loaded: Loaded,
        autopilot: MavsdkAutopilot,
        watchdog: Watchdog,
        recorder: FlightLog,
        navigation: Navigation,
        inbox: Inbox,
        pac: Pac,
        link: ZenohLink,
        boot_nonce: int,
        boot_epoch: int,
    ) -> None:
        self._config = config
        self._loaded = loaded
        self._autopilot = autopilot
        self._watchdog = watchdog
        self._recorder = recorder
        self._navigation = navigation
        self._inbox = inbox
        self._pac = pac
        self._link = link
        self._boot_nonce = boot_nonce
        self._boot_epoch = boot_epoch
        self._started_s = time.monotonic()
        self._fed_s = -math.inf
        self._control = FlightControl(
            robot=config.robot(boot_nonce),
            world_id=loaded.world_id,
            autopilot=autopilot,
            navigation=navigation,
            pac=pac,
            inbox=inbox,
            recorder=recorder,
            energy=config.energy,
            unix_clock_s=time.time,
            started_s=self._started_s,
        )
        self._readiness = _readiness(config, loaded, autopilot)
        rates = config.rates
        self._loops = (
            Loop("control", 1.0 / rates.control_hz, self._control_step),
            Loop("perception", 1.0 / rates.perception_hz, self._perception_step),
            Loop("policy", 1.0 / rates.policy_hz, self._policy_step),
        )
        # A vehicle that falls silent holds up the first for many seconds.
        self._chores = (
            Loop("preflight", _PERIOD_S, self._preflight_step),
            Loop("status", _PERIOD_S, self._status_step),
            Loop("log", _PERIOD_S, self._recorder.flush),
        )
        self._sequence = 0
        # What the ground was told last, and when.
        self._told: tuple[object, ...] = ()
        self._told_at_s = -math.inf
        self._message_lock = threading.Lock()
        self._message_sequence = 0
        self._message_at_s = -math.inf
        self._explored_due_s = -math.inf
        self._status_text: str | None = None

    def start(self) -> None:
        """Start the loops; from now on the robot may send."""
        for loop in (*self._loops, *self._chores):
            loop.start()

    def news(self) -> list[str]:
        """What systemd is to know now. Waits for nothing."""
        news = [] if self._status_text is None else [self._status_text]
        ages_s = [loop.age_s() for loop in self._loops]
        if None not in ages_s:
            news.append(READY)
        control_s = ages_s[0]
        if control_s is not None and control_s < _CONTROL_FRESH_S:
            news.append(ALIVE)
        return news

    def leave(self) -> None:
        """Leave a vehicle that we flew in a defined state, and stop the loops."""
        control, *others = self._loops
        self._stop(control)
        action = self._control.leave(Action(self._config.on_stop))
        if action is not None:
            _log.warning("program ends in flight", vehicle=action)
            self._command(action)
        for loop in (*others, *self._chores):
            self._stop(loop)

    def _stop(self, loop: Loop) -> None:
        if not loop.stop(_JOIN_S):
            _log.error("loop hangs", loop=loop.name)

    def _command(self, action: Action) -> None:
        asked_s = time.monotonic()
        # Or the watchdog would interrupt it. If it does not arrive, PX4 lands the vehicle.
        self._watchdog.feed(flying=False)
        self._autopilot.command(action)
        while time.monotonic() - asked_s < _ANSWER_S:
            result = self._autopilot.state().result
            if result and result.action is action and result.at_s >= asked_s:
                return
            time.sleep(0.02)
        _log.error("the autopilot did not answer", action=action)

    # Steps of the loops

    def _control_step(self) -> None:
        flying = self._control.tick(time.monotonic())
        self._watchdog.feed(flying=flying)
        now_s = time.monotonic()
        self._control.look_back(self._fed_s, now_s)
        self._fed_s = now_s

    def _perception_step(self) -> None:
        now_s = time.monotonic()
        tick = self._pac.perceive(now_s)
        if now_s >= self._explored_due_s:
            self._explored_due_s = now_s + _EXPLORED_PERIOD_S
            self._link.publish(EXPLORED, explored_to_bytes(self._pac.explored()))
        if tick is not None:
            self._recorder.record(
                "perception",
                time.time(),
                {
                    "images": tick.images.copy(),
                    "position_feature": tick.position_feature,
                    "features": tick.features,
                },
            )

    def _policy_step(self) -> None:
        tick = self._pac.infer(time.monotonic(), time.time())
        if tick is None:
            return
        self._publish_message(tick.message)
        record = {field.name: getattr(tick, field.name) for field in dataclasses.fields(tick)}
        self._recorder.record("policy", time.time(), record)

    def _publish_message(self, of_policy: bytes = b"") -> None:
        """To the neighbours: a beacon, and behind it what the policy says, if it does."""
        control, vehicle = self._control, self._autopilot.state()
        odometry, now_s = self._navigation.odometry(), time.monotonic()
        assignment, gps = control.assignment, vehicle.gps
        parameters = assignment.robot.parameters
        x_m, y_m = parameters.landing_point_m
        with self._message_lock:
            self._message_sequence += 1
            self._message_at_s = now_s
            sequence = self._message_sequence
        beacon = Beacon(
            robot_id=self._config.robot_id,
            boot_epoch=self._boot_epoch,
            sequence=sequence,
            sent_at_s=time.time(),
            position_m=odometry and odometry.position_m,
            velocity_m_s=odometry and odometry.velocity_m_s,
            state=control.flight.state,
            armed=vehicle.armed,
            system_id=vehicle.system_id,
            gps_accuracy_m=None if gps is None else gps.accuracy_m,
            flown_s=flown_s(control.flight, vehicle, now_s),
            slot_height_m=parameters.slot_height_m,
            landing_point_m=(x_m, y_m),
            frame_id=self._pac.frame_id,
            bundle_tag=tag(self._loaded.bundle_id),
            world_tag=tag(assignment.world_id),
        )
        self._link.publish(MESSAGE, encode_beacon(beacon) + of_policy)

    def _preflight_step(self) -> None:
        control = self._control
        self._look_for_world()
        assignment = control.assignment
        self._readiness.prepare(time.monotonic(), assignment)
        now_s = time.monotonic()
        peers = self._inbox.peers(now_s)
        control.peers = peers
        control.checks = self._readiness.checks(
            now_s,
            time.time(),
            assignment=assignment,
            position=self._navigation.position,
            odometry=self._navigation.odometry(),
            peers=peers,
            not_understood=self._inbox.not_understood,
            duplicate=self._link.duplicate(),
            watchdog_alive=self._watchdog.alive(),
            ground_age_s=self._inbox.ground_age_s(now_s),
            ground_clock_offset_s=self._inbox.ground_clock_offset_s,
        )

    def _look_for_world(self) -> None:
        """Make a sensor of the world that the ground wants, once that has come."""
        wanted, data = self._control.wanted_world_id, self._inbox.world
        if wanted is None or data is None:
            return
        text = data.decode("utf-8", "replace")
        if world_id(text) != wanted:
            return
        try:
            sensor = _sensor(text, f"world {wanted}", self._loaded.policy.manifest)
        except (ValueError, ArithmeticError) as error:
            self._control.world = GroundWorld(wanted, None, str(error))
        else:
            self._control.world = GroundWorld(wanted, sensor, "")

    def _status_step(self) -> None:
        now_s, unix_now_s = time.monotonic(), time.time()
        status = self._status(now_s, unix_now_s)
        news = _news(status)
        if news != self._told or now_s - self._told_at_s >= _STATUS_PERIOD_S:
            self._told, self._told_at_s = news, now_s
            self._link.publish(STATUS, encode(status))
        if now_s - self._message_at_s > _SILENT_TICKS / self._config.rates.policy_hz:
            # The policy is silent, or hangs: neighbours must not lose this robot's place.
            self._publish_message()
        vehicle = self._autopilot.state()
        self._status_text = status_text(
            status,
            monotonic_s=now_s,
            autopilot=vehicle.connected,
            ages_s={loop.name: loop.age_s() for loop in self._loops},
            peers=self._link.peers(),
        )
        for topic, value in (("status", status), ("vehicle", vehicle)):
            fields = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
            self._recorder.record(topic, unix_now_s, fields)
        if status.position_m is not None:
            yaw_rad = status.heading_rad
            if yaw_rad is not None and status.origin is not None:
                # From compass heading to the angle from x, which is right of the mission heading.
                yaw_rad = math.pi / 2.0 - (yaw_rad - math.radians(status.origin.heading_deg))
            pose = {"position_m": status.position_m, "yaw_rad": yaw_rad}
            self._recorder.record("/pose", unix_now_s, pose)

    def _status(self, now_s: float, unix_now_s: float) -> RobotStatus:
        control, vehicle, gps = self._control, self._autopilot.state(), self._autopilot.state().gps
        origin, robot, world = control.assignment
        flight, failed_checks = control.flight, control.failed_checks(now_s)
        odometry = self._navigation.odometry()
        self._sequence += 1
        ready = flight.state is FlightState.PREFLIGHT and failed_checks == ()
        neighbours = self._pac.mailbox.neighbours(now_s)
        policy_velocity_m_s = self._pac.control(now_s)
        ground_age_s = self._inbox.ground_age_s(now_s)
        energy = control.energy
        return RobotStatus(
            robot_id=robot.robot_id,
            boot_nonce=self._boot_nonce,
            sequence=self._sequence,
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
            bundle_id=self._loaded.bundle_id,
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
            message_counts=self._pac.mailbox.counts(),
            neighbour_ages_s={str(n.robot_id): round(n.age_s, 3) for n in neighbours},
            loops={loop.name: loop.status() for loop in self._loops},
            fence=robot.fence,
            not_taken=control.not_taken,
            in_air=vehicle.in_air,
            global_deg=self._navigation.global_deg(vehicle),
            hdop=gps.hdop if gps is not None and math.isfinite(gps.hdop) else None,
            policy_velocity_m_s=(
                None if policy_velocity_m_s is None else tuple(policy_velocity_m_s.tolist())
            ),
            feature_age_s=self._pac.feature_age_s(now_s),
            neighbour_messages={str(r): n for r, n in self._pac.mailbox.accepted().items()},
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
        )

    def _alarms(self) -> tuple[Reason, ...]:
        alarms = []
        if self._link.duplicate():
            text = f"another program says that it is robot {self._config.robot_id}"
            alarms.append(Reason(ReasonCode.DUPLICATE_ID, text))
        if not self._watchdog.alive():
            text = "the watchdog has ended: only PX4 notices if this program hangs"
            alarms.append(Reason(ReasonCode.WATCHDOG_ENDED, text))
        if not self._recorder.recording:
            alarms.append(Reason(ReasonCode.LOG_NOT_WRITTEN, "the flight log is not written"))
        if self._inbox.ground_refusal:
            text = f"the ground is not understood: {self._inbox.ground_refusal}"
            alarms.append(Reason(ReasonCode.GROUND_NOT_UNDERSTOOD, text))
        return tuple(alarms)


def _news(status: RobotStatus) -> tuple[object, ...]:
    """What the ground is to hear of at once if it changes; of texts only what they are about."""
    return (
        status.state, status.reason.code, status.ready, status.orders, status.obeyed_sequence,
        status.operator, status.trial, status.world_id, status.origin, status.fence, status.armed,
        status.in_air, status.mode, status.position_quality,
        *(check.code for check in (*status.failed_checks, *status.not_taken)),
        *(alarm.code for alarm in status.alarms),
    )  # fmt: skip


def _take_alone(config: RobotConfig, parts: ExitStack) -> None:
    """Hold robot and vehicle for this process: another on this machine must not fly them too."""
    parts.enter_context(ProcessLock(f"robot {config.robot_id} of fleet {config.fleet}"))
    parts.enter_context(ProcessLock(f"the autopilot's port {config.autopilot.port}"))


class CheckReport(NamedTuple):
    """What `check` found: what PX4 would do, what was set, and what keeps the robot from flying.

    `version` is PX4's, and how far it was tried.
    """

    version: str
    explanations: tuple[str, ...]
    changes: tuple[str, ...]
    failed: tuple[FailedCheck, ...]


def check(config: RobotConfig, wait_s: float) -> CheckReport:
    """Run all preflight checks without flying, for up to `wait_s` until all of them pass.

    Raises ValueError or OSError, in one line, for what keeps the checks from running.
    """
    loaded = load(config)
    with ExitStack() as parts:
        _take_alone(config, parts)
        structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.ERROR))
        autopilot = parts.enter_context(
            MavsdkAutopilot(config.autopilot.url, system_id=config.autopilot.system_id)
        )
        navigation = Navigation(autopilot, time.monotonic, config.position)
        # Of its own, since the checks wait for the vehicle; it looks as often as a flight does.
        look = Loop(
            "position",
            1.0 / config.rates.control_hz,
            lambda: navigation.look(autopilot.state(), time.monotonic()),
        )
        look.start()
        parts.callback(look.stop, _JOIN_S)
        inbox = Inbox(config.robot_id, config.flight.ground_timeout_s)
        readiness = _readiness(config, loaded, autopilot)
        # Not as the robot itself: its program is not running.
        link = parts.enter_context(_open_link(config, inbox, robot_id=None))
        until_s = time.monotonic() + wait_s
        while True:
            now_s = time.monotonic()
            ground, ground_age_s = inbox.ground(now_s)
            origin = None if ground is None else ground.origin
            navigation.frame = None if origin is None else origin.frame()
            robot = config.robot(boot_nonce=0)
            unfit: tuple[FailedCheck, ...] = ()
            if ground is not None:
                try:
                    robot = robot.assigned(ground)
                except ValueError as error:
                    unfit = (FailedCheck(CheckCode.FENCE_OR_PLACE_UNFIT, str(error)),)
            assignment = Assignment(origin, robot, loaded.world_id)
            readiness.prepare(now_s, assignment)
            checks = readiness.checks(
                now_s,
                time.time(),
                assignment=assignment,
                position=navigation.position,
                odometry=navigation.odometry(),
                peers=inbox.peers(now_s),
                not_understood=inbox.not_understood,
                duplicate=config.robot_id in link.present(),
                watchdog_alive=True,  # There is none before the robot's program runs.
                ground_age_s=ground_age_s,
                ground_clock_offset_s=inbox.ground_clock_offset_s,
            )
            failed = (*checks.failed, *unfit)
            if not failed or now_s > until_s:
                version = in_words(autopilot.state().version)
                return CheckReport(version, readiness.explanations, readiness.changes, failed)
            time.sleep(_PERIOD_S)


def _readiness(config: RobotConfig, loaded: Loaded, autopilot: MavsdkAutopilot) -> Readiness:
    return Readiness(
        config,
        autopilot,
        autopilot,
        bundle_id=loaded.bundle_id,
        bundle_problem=loaded.bundle_problem,
    )


def _open_link(
    config: RobotConfig,
    inbox: Inbox,
    robot_id: int | None,
    pac: Pac | None = None,
    recorder: FlightLog | None = None,
) -> ZenohLink:
    """The radio, with what it hears going into the inbox."""
    link = config.link
    return ZenohLink(
        fleet=config.fleet,
        robot_id=robot_id,
        mode=link.mode,
        listen=link.listen,
        connect=link.connect,
        scouting=link.scouting,
        subscriptions={
            MESSAGE: partial(_receive, inbox, pac, recorder),
            STATE: lambda _, data: inbox.put_ground(data, time.monotonic(), time.time()),
            ORDER: lambda _, data: inbox.put_order(data),
            WORLD: lambda _, data: inbox.put_world(data),
        },
    )
