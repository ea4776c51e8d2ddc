"""One robot's program: everything is built and wired here, in numbered steps.

Threads: the three loops (`perception`, `policy`, `control`), zenoh's and MAVSDK's own, whose
callbacks only store, and the main thread, which keeps house: status, preflight checks, flight log.
"""

import dataclasses
import fcntl
import gc
import hashlib
import json
import logging
import math
import os
import secrets
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import structlog

from edge.adapters.deadman import Deadman
from edge.adapters.flight_log import FlightLog, FlightMetadata
from edge.adapters.idf_sensor import IdfSensor
from edge.adapters.logs import configure_logging
from edge.adapters.mavsdk_autopilot import MavsdkAutopilot
from edge.adapters.zenoh_link import ZenohLink
from edge.core.flight import Robot
from edge.core.mission import FlightState, RobotStatus, to_json
from edge.core.vehicle import Action
from edge.core.world import parse_world, rasterize
from edge.runtime.bundle import Bundle, load_bundle
from edge.runtime.config import RobotConfig
from edge.runtime.control import FlightControl
from edge.runtime.inbox import Inbox
from edge.runtime.loops import Loop
from edge.runtime.navigation import Navigation
from edge.runtime.pac import Pac
from edge.runtime.policy import Policy
from edge.runtime.readiness import Readiness
from edge.runtime.verify import verify

_HOUSEKEEPING_S = 0.25
_LEAVE_S = 1.2
_JOIN_S = 0.3
# The interpreter lets another thread run this often: a tick must not wait 5 ms for each other one.
_SWITCH_INTERVAL_S = 0.001

_log = structlog.get_logger(__name__)


class RobotError(ValueError):
    """The robot's program cannot start; the text says why and what to do."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Loaded:
    """What a robot needs before any hardware: all of it is checked already."""

    bundle: Bundle
    bundle_problem: str | None
    policy: Policy
    sensor: IdfSensor
    world_id: str


def load(config: RobotConfig) -> Loaded:
    """Load and verify policy and world. Raises ValueError or OSError that says what is wrong."""
    bundle = load_bundle(Path(config.policy.bundle))
    perception = bundle.manifest.perception
    if perception is None:
        raise RobotError(f"{config.policy.bundle}: the bundle has no perception: it cannot fly")
    failed = [check.name for check in verify(bundle) if not check.passed]
    problem = None
    if failed:
        problem = f"{', '.join(failed)} of the bundle do not compute torch's golden outputs here"
    text = Path(config.policy.world).read_text("utf-8-sig")
    importance = rasterize(parse_world(text, config.policy.world), perception.world_size)
    return Loaded(
        bundle=bundle,
        bundle_problem=problem,
        policy=Policy(bundle),
        sensor=IdfSensor(importance, perception.sensor_size),
        world_id=hashlib.sha256(text.encode()).hexdigest()[:12],
    )


def run(config: RobotConfig, stop: threading.Event) -> None:
    """Fly one robot until `stop` is set. Called from the main thread.

    Raises ValueError or OSError, in one line, for what keeps the program from starting.
    """
    # 1. Policy and world, before anything that moves.
    loaded = load(config)
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    boot_nonce = secrets.randbits(48)
    with ExitStack() as parts:
        # 2. One program per robot, and per vehicle, on this machine.
        parts.enter_context(_alone(f"robot {config.robot_id} of fleet {config.fleet}"))
        parts.enter_context(_alone(f"autopilot {config.autopilot.url}"))
        # 3. The flight log, so that it holds all that follows.
        recorder = FlightLog(
            Path(config.log.folder),
            FlightMetadata(
                robot_id=config.robot_id,
                boot_nonce=boot_nonce,
                bundle_id=loaded.bundle.id,
                bundle_path=config.policy.bundle,
                configuration=json.dumps(dataclasses.asdict(config)),
                version=version("lpac-edge"),
            ),
            max_total_bytes=int(config.log.max_total_mb * 1e6),
        )
        parts.callback(recorder.close)
        configure_logging(recorder)
        # 4. The vehicle, and who holds it when this program hangs.
        autopilot = parts.enter_context(
            MavsdkAutopilot(config.autopilot.url, system_id=config.autopilot.system_id)
        )
        deadman = parts.enter_context(
            Deadman(
                config.autopilot.port,
                config.autopilot.system_id,
                config.flight.command_timeout_s,
            )
        )
        # 5. The robot's own parts, and the radio that feeds them.
        program = _Program(config, loaded, autopilot, deadman, recorder, boot_nonce)
        link = parts.enter_context(program.open_link())
        # 6. The loops.
        gc.collect()
        gc.freeze()  # What is loaded stays: a collection in flight need not look through it.
        program.start(link)
        _log.info("robot runs", robot=config.robot_id, bundle=loaded.bundle.id[:12])
        # 7. Keeping house until somebody stops the program.
        while not stop.wait(_HOUSEKEEPING_S):
            program.keep_house()
        # 8. A defined end: the vehicle holds or lands, then everything is closed.
        program.leave()


class _Program:
    """The parts of a running robot. The main thread calls its methods, the loops its steps."""

    def __init__(
        self,
        config: RobotConfig,
        loaded: Loaded,
        autopilot: MavsdkAutopilot,
        deadman: Deadman,
        recorder: FlightLog,
        boot_nonce: int,
    ) -> None:
        self._config = config
        self._loaded = loaded
        self._autopilot = autopilot
        self._deadman = deadman
        self._recorder = recorder
        self._boot_nonce = boot_nonce
        self._started_s = time.monotonic()
        self._navigation = Navigation(autopilot, time.monotonic)
        self._inbox = Inbox(config.robot_id, config.flight.ground_timeout_s)
        self._pac = Pac(
            robot_id=config.robot_id,
            boot_epoch=time.time_ns() // 1_000_000,
            policy=loaded.policy,
            sensor=loaded.sensor,
            odometry=self._navigation,
            parameters=config.pac,
        )
        self._control = FlightControl(
            robot=Robot(config.robot_id, boot_nonce, config.flight, config.fence, config.limits),
            autopilot=autopilot,
            navigation=self._navigation,
            pac=self._pac,
            inbox=self._inbox,
            recorder=recorder,
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
        self._sequence = 0
        self._link: ZenohLink | None = None

    def open_link(self) -> ZenohLink:
        """The radio, with what it hears going into mailbox and inbox."""
        return _open_link(self._config, self._inbox, self._config.robot_id, self._on_message)

    def start(self, link: ZenohLink) -> None:
        """Start the loops; from now on the robot may send."""
        self._link = link
        for loop in self._loops:
            loop.start()

    def keep_house(self) -> None:
        """Checks, status and flight log; a part that fails does not keep the others from theirs."""
        for task in (self._check, self._tell, self._recorder.flush):
            try:
                task()
            except Exception:
                _log.exception("keeping house failed", task=task.__name__)

    def leave(self) -> None:
        """Stop the loops and leave a vehicle that we flew in a defined state, in less than 2 s."""
        for loop in self._loops:
            if not loop.stop(_JOIN_S):
                _log.error("loop hangs", loop=loop.name)
        action = self._control.leave(Action(self._config.on_stop))
        if action is not None:
            _log.warning("program ends in flight", vehicle=action)
            self._autopilot.command(action)
            self._await(action)

    def _await(self, action: Action) -> None:
        asked_s = time.monotonic()
        while time.monotonic() - asked_s < _LEAVE_S:
            result = self._autopilot.state().result
            if result and result.action is action and result.at_s >= asked_s:
                return
            time.sleep(0.02)
        _log.error("the autopilot did not answer", action=action)

    # Steps of the loops

    def _control_step(self) -> None:
        flying = self._control.tick(time.monotonic())
        self._deadman.feed(flying=flying)

    def _perception_step(self) -> None:
        tick = self._pac.perceive(time.monotonic())
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
        if tick is None or self._link is None:
            return
        self._link.publish("message", tick.message)
        record = {field.name: getattr(tick, field.name) for field in dataclasses.fields(tick)}
        self._recorder.record("policy", time.time(), record)

    # The link's threads

    def _on_message(self, _: str, data: bytes) -> None:
        rejection = self._pac.receive(data, time.monotonic(), time.time())
        self._recorder.record("received", time.time(), {"bytes": len(data), "rejection": rejection})

    # The main thread

    def _check(self) -> None:
        now_s = time.monotonic()
        control = self._control
        peers = self._inbox.peers(now_s)
        control.peer_states = {peer.status.robot_id: peer.status.state for peer in peers}
        self._readiness.prepare(now_s, control.origin)
        control.checks = self._readiness.checks(
            now_s,
            time.time(),
            origin=control.origin,
            odometry=self._navigation.odometry(),
            peers=peers,
            duplicate=self._link is not None and self._link.duplicate(),
            watchdog_alive=self._deadman.alive(),
            ground_age_s=self._inbox.ground_age_s(now_s),
            ground_clock_offset_s=self._inbox.ground_clock_offset_s,
        )

    def _tell(self) -> None:
        if self._link is None:
            return
        now_s, unix_now_s = time.monotonic(), time.time()
        status = self._status(now_s, unix_now_s)
        self._link.publish("status", to_json(status))
        for topic, value in (("status", status), ("vehicle", self._autopilot.state())):
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
        config, control, vehicle = self._config, self._control, self._autopilot.state()
        flight, checks = control.flight, control.checks
        odometry = self._navigation.odometry()
        self._sequence += 1
        ready = flight.state is FlightState.PREFLIGHT and checks is not None and not checks.failed
        neighbours = self._pac.mailbox.neighbours(now_s)
        return RobotStatus(
            robot_id=config.robot_id,
            boot_nonce=self._boot_nonce,
            sequence=self._sequence,
            uptime_s=now_s - self._started_s,
            unix_time_s=unix_now_s,
            state=flight.state,
            reason=flight.reason,
            ready=ready,
            failed_checks=checks.failed if checks else ("checks are still running",),
            alarms=(*control.alarms, *self._alarms()),
            obeyed_sequence=control.obeyed_sequence,
            operator=control.operator,
            orders=flight.answers,
            bundle_id=self._loaded.bundle.id,
            world_id=self._loaded.world_id,
            trial=flight.trial,
            origin=control.origin,
            system_id=vehicle.system_id,
            slot_height_m=config.flight.slot_height_m,
            landing_point_m=config.flight.landing_point_m,
            position_m=odometry and odometry.position_m,
            velocity_m_s=odometry and odometry.velocity_m_s,
            heading_rad=vehicle.heading_rad,
            mode=vehicle.mode,
            armed=vehicle.armed,
            battery=vehicle.battery,
            satellites=None if vehicle.gps is None else vehicle.gps.satellites,
            message_counts=self._pac.mailbox.counts(),
            neighbour_ages_s={str(n.robot_id): round(n.age_s, 3) for n in neighbours},
            loops={loop.name: loop.status() for loop in self._loops},
        )

    def _alarms(self) -> tuple[str, ...]:
        alarms = []
        if self._link is not None and self._link.duplicate():
            alarms.append(f"another program says that it is robot {self._config.robot_id}")
        if not self._deadman.alive():
            alarms.append("the watchdog has ended: only PX4 notices if this program hangs")
        if not self._recorder.recording:
            alarms.append("the flight log is not written")
        return tuple(alarms)


@contextmanager
def _alone(what: str) -> Iterator[None]:
    """Hold `what` for this process: another program on this machine must not fly it too."""
    name = "".join(c if c.isalnum() else "-" for c in what)
    path = Path(tempfile.gettempdir()) / f"lpac-{name}.lock"
    with path.open("a+") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            lock.seek(0)
            raise RobotError(
                f"{what} is in use by process {lock.read().strip() or 'unknown'} on this machine: "
                "stop that one first"
            ) from None
        lock.truncate(0)
        lock.write(str(os.getpid()))
        lock.flush()
        yield


class CheckReport(NamedTuple):
    """What `check` found: what PX4 would do, what was set, and what keeps the robot from flying."""

    explanations: tuple[str, ...]
    changes: tuple[str, ...]
    failed: tuple[str, ...]


def check(config: RobotConfig, wait_s: float) -> CheckReport:
    """Run all preflight checks without flying, for up to `wait_s` until all of them pass.

    Raises ValueError or OSError, in one line, for what keeps the checks from running.
    """
    loaded = load(config)
    with ExitStack() as parts:
        parts.enter_context(_alone(f"robot {config.robot_id} of fleet {config.fleet}"))
        parts.enter_context(_alone(f"autopilot {config.autopilot.url}"))
        structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.ERROR))
        autopilot = parts.enter_context(
            MavsdkAutopilot(config.autopilot.url, system_id=config.autopilot.system_id)
        )
        navigation = Navigation(autopilot, time.monotonic)
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
            readiness.prepare(now_s, origin)
            checks = readiness.checks(
                now_s,
                time.time(),
                origin=origin,
                odometry=navigation.odometry(),
                peers=inbox.peers(now_s),
                duplicate=config.robot_id in link.present(),
                watchdog_alive=True,  # There is none before the robot's program runs.
                ground_age_s=ground_age_s,
                ground_clock_offset_s=inbox.ground_clock_offset_s,
            )
            if not checks.failed or now_s > until_s:
                return CheckReport(readiness.explanations, readiness.changes, checks.failed)
            time.sleep(_HOUSEKEEPING_S)


def _readiness(config: RobotConfig, loaded: Loaded, autopilot: MavsdkAutopilot) -> Readiness:
    return Readiness(
        config,
        autopilot,
        autopilot,
        bundle_id=loaded.bundle.id,
        world_id=loaded.world_id,
        bundle_problem=loaded.bundle_problem,
    )


def _open_link(
    config: RobotConfig,
    inbox: Inbox,
    robot_id: int | None,
    on_message: Callable[[str, bytes], None] | None = None,
) -> ZenohLink:
    """The radio, with what it hears going into the inbox."""
    subscriptions: dict[str, Callable[[str, bytes], None]] = {
        "robot/*/status": lambda key, data: inbox.put_status(
            key, data, time.monotonic(), time.time()
        ),
        "ground/state": lambda _, data: inbox.put_ground(data, time.monotonic(), time.time()),
        "ground/order": lambda _, data: inbox.put_order(data),
    }
    if on_message is not None:
        subscriptions["robot/*/message"] = on_message
    link = config.link
    return ZenohLink(
        fleet=config.fleet,
        robot_id=robot_id,
        mode=link.mode,
        listen=link.listen,
        connect=link.connect,
        scouting=link.scouting,
        subscriptions=subscriptions,
    )
