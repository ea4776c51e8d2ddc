"""One robot's program: a node on the real clock, its drivers, and the threads that call its steps.

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
import secrets
import sys
import threading
import time
from collections.abc import Mapping
from contextlib import ExitStack
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import structlog

from edge.core.ports import Sensor, Vehicle
from edge.core.px4_version import in_words
from edge.core.vehicle import Action, Setpoint
from edge.core.world import MOST_FEATURES, parse_world, rasterize
from edge.drivers.clock import SystemClock
from edge.drivers.flight_log import FlightLog, FlightMetadata
from edge.drivers.logs import configure_logging
from edge.drivers.process_lock import ProcessLock
from edge.drivers.px4.autopilot import MavsdkAutopilot
from edge.drivers.px4.watchdog import Watchdog
from edge.drivers.systemd import ALIVE, READY, STOPPING, ServiceManager, status_text
from edge.drivers.world_sensor import WorldSensor
from edge.drivers.zenoh_link import ZenohLink
from edge.messages.codes import FailedCheck
from edge.policy.bundle import Manifest
from edge.robot.config import RobotConfig
from edge.robot.loops import Loop
from edge.robot.node import LoadedPolicy, Ports, RobotNode, load_policy

# Of preflight checks, status, systemd's news, and writing the flight log.
_PERIOD_S = 0.25
# A control loop without a tick for longer hangs: the vehicle was told to hold before that.
_CONTROL_FRESH_S = 1.0
# On leaving: for the autopilot's answer, and for a loop that hangs.
_ANSWER_S = 1.2
_JOIN_S = 0.3
# The interpreter lets another thread run this often: a tick must not wait 5 ms for each other one.
_SWITCH_INTERVAL_S = 0.001

_log = structlog.get_logger(__name__)


def _load(config: RobotConfig) -> tuple[LoadedPolicy, str]:
    """Policy and world, checked before any hardware. Raises ValueError or OSError."""
    policy = load_policy(Path(config.policy.bundle))
    world = Path(config.policy.world).read_text("utf-8-sig")
    _sensor_over(policy.policy.manifest, world, config.policy.world)
    return policy, world


def _sensor_over(manifest: Manifest, text: str, source: str) -> Sensor:
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
    policy, world = _load(config)
    if stop.is_set():
        return
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    boot_nonce = secrets.randbits(48)
    with ExitStack() as parts:
        service_manager = ServiceManager()
        parts.callback(service_manager.close)
        # 2. One program per robot, and per vehicle, on this machine.
        _take_alone(config, parts)
        # 3. The flight log, so that it holds all that follows.
        recorder = _open_log(config, policy.bundle_id, boot_nonce)
        parts.callback(recorder.close)
        configure_logging(recorder)
        # 4. The vehicle, and who holds it when this program hangs.
        vehicle = parts.enter_context(
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
        # 5. The robot itself.
        clock = SystemClock()
        node = RobotNode(
            config,
            Ports(
                clock=clock,
                vehicle=vehicle,
                vehicle_setup=vehicle,
                watchdog=watchdog,
                recorder=recorder,
                sensor_over=partial(_sensor_over, policy.policy.manifest),
            ),
            policy,
            world,
            boot_nonce=boot_nonce,
            boot_epoch=int(clock.unix_s() * 1e3),
        )
        # 6. The radio that feeds it, and takes what it says.
        link = parts.enter_context(_open_link(config, node, config.robot_id))
        # 7. The loops, and what ends them: the vehicle holds or lands, then everything is closed.
        program = _Program(config, node, vehicle, watchdog, recorder, link)
        gc.collect()
        gc.freeze()  # What is loaded stays: a collection in flight need not look through it.
        ctypes.CDLL(None).malloc_trim(0)  # What verification took goes back to the system.
        program.start()
        parts.callback(program.leave)
        parts.callback(service_manager.tell, STOPPING)
        _log.info("robot runs", robot=config.robot_id, bundle=policy.bundle_id[:12])
        # 8. Until somebody stops the program.
        while not stop.wait(_PERIOD_S):  # A signal that another thread took is seen only here.
            service_manager.tell(*program.news())


def _open_log(config: RobotConfig, bundle_id: str, boot_nonce: int) -> FlightLog:
    metadata = FlightMetadata(
        robot_id=config.robot_id,
        boot_nonce=boot_nonce,
        bundle_id=bundle_id,
        bundle_path=config.policy.bundle,
        configuration=json.dumps(dataclasses.asdict(config)),
        version=version("lpac-edge"),
    )
    max_total_bytes = int(config.log.max_total_mb * 1e6)
    return FlightLog(Path(config.log.folder), metadata, max_total_bytes=max_total_bytes)


def _open_link(config: RobotConfig, node: RobotNode, robot_id: int | None) -> ZenohLink:
    """The radio, as that robot, or with None as somebody who only listens."""
    link = ZenohLink(
        fleet=config.fleet,
        robot_id=robot_id,
        mode=config.link.mode,
        listen=config.link.listen,
        connect=config.link.connect,
        scouting=config.link.scouting,
        subscriptions=node.subscriptions,
    )
    node.link = link
    return link


class _Program:
    """The threads of a running robot. The main thread calls its methods."""

    def __init__(
        self,
        config: RobotConfig,
        node: RobotNode,
        vehicle: MavsdkAutopilot,
        watchdog: Watchdog,
        recorder: FlightLog,
        link: ZenohLink,
    ) -> None:
        self._config = config
        self._node = node
        self._vehicle = vehicle
        self._watchdog = watchdog
        self._link = link
        rates = config.rates
        self._loops = (
            Loop("control", 1.0 / rates.control_hz, node.control_step),
            Loop("perception", 1.0 / rates.perception_hz, node.perception_step),
            Loop("policy", 1.0 / rates.policy_hz, node.policy_step),
        )
        # A vehicle that falls silent holds up the first for many seconds.
        self._chores = (
            Loop("preflight", _PERIOD_S, node.preflight_step),
            Loop("status", _PERIOD_S, self._status_step),
            Loop("log", _PERIOD_S, recorder.flush),
        )
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
        action = self._node.leave(Action(self._config.on_stop))
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
        self._vehicle.command(action)
        while time.monotonic() - asked_s < _ANSWER_S:
            result = self._vehicle.state().result
            if result and result.action is action and result.at_s >= asked_s:
                return
            time.sleep(0.02)
        _log.error("the autopilot did not answer", action=action)

    def _status_step(self) -> None:
        status = self._node.status_step({loop.name: loop.status() for loop in self._loops})
        self._status_text = status_text(
            status,
            monotonic_s=time.monotonic(),
            autopilot=self._vehicle.state().connected,
            ages_s={loop.name: loop.age_s() for loop in self._loops},
            peers=self._link.peers(),
        )


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


class _OnlyLooking:
    """Stands for what a robot that is only checked does not use: it is told nothing.

    A vehicle that answers and obeys nobody, a watchdog with nothing to watch, a log of nothing.
    """

    recording = True

    def __init__(self, vehicle: Vehicle) -> None:
        self.state = vehicle.state

    def send(self, setpoint: Setpoint) -> Setpoint | None:
        """Sends nothing."""

    def command(self, action: Action) -> None:
        """Asks for nothing."""

    def feed(self, *, flying: bool) -> None:
        """Watches nothing."""

    def alive(self) -> bool:
        """There is none before the robot's program runs."""
        return True

    def record(self, topic: str, unix_time_s: float, message: Mapping[str, object]) -> None:
        """Keeps nothing."""


def check(config: RobotConfig, wait_s: float) -> CheckReport:
    """Run all preflight checks without flying, for up to `wait_s` until all of them pass.

    Raises ValueError or OSError, in one line, for what keeps the checks from running.
    """
    policy, world = _load(config)
    with ExitStack() as parts:
        _take_alone(config, parts)
        structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.ERROR))
        vehicle = parts.enter_context(
            MavsdkAutopilot(config.autopilot.url, system_id=config.autopilot.system_id)
        )
        looking = _OnlyLooking(vehicle)
        node = RobotNode(
            config,
            Ports(
                clock=SystemClock(),
                vehicle=looking,
                vehicle_setup=vehicle,
                watchdog=looking,
                recorder=looking,
                sensor_over=partial(_sensor_over, policy.policy.manifest),
            ),
            policy,
            world,
            boot_nonce=0,
            boot_epoch=0,
        )
        # Not as the robot itself: its program is not running.
        parts.enter_context(_open_link(config, node, None))
        # Of its own, since the checks wait for the vehicle; it looks as often as a flight does.
        control = Loop("control", 1.0 / config.rates.control_hz, node.control_step)
        control.start()
        parts.callback(control.stop, _JOIN_S)
        until_s = time.monotonic() + wait_s
        while True:
            node.preflight_step()
            failed = node.failed_checks
            if failed == () or (failed is not None and time.monotonic() > until_s):
                readiness = node.readiness
                version = in_words(vehicle.state().version)
                return CheckReport(version, readiness.explanations, readiness.changes, failed)
            time.sleep(_PERIOD_S)
