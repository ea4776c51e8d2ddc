"""One robot's program: a node on the real clock, its drivers, and the threads that call its steps.

Threads: the three loops (`perception`, `policy`, `control`); `status`; `log`, which waits for the
disk; `preflight`, which waits for the vehicle while that stands on the ground; zenoh's and MAVSDK's
own, whose callbacks only store; and the main thread, which waits for signals, tells systemd that
the control loop lives, and does nothing that could hang.
"""

import ctypes
import gc
import math
import secrets
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import NamedTuple

from edge.core.file_errors import in_words as file_error_in_words
from edge.core.logger import log, show
from edge.core.ports import OpenVehicle, SensorOver, Vehicle, VehicleSetting, Watchdog
from edge.core.px4_version import in_words
from edge.core.schema import ConfigError
from edge.core.vehicle import Action, Setpoint
from edge.drivers.clock import SystemClock
from edge.drivers.door import DoorStatus, allow_most_descriptors, descriptors_short
from edge.drivers.flight_log import FlightLog
from edge.drivers.identity_folder import (
    GROUP_KEYS,
    Identity,
    load_identity,
    receiving_identity,
)
from edge.drivers.logs import log_to
from edge.drivers.process_lock import ProcessLock
from edge.drivers.registry import load_verified_policy, open_link, open_sensor, open_vehicle
from edge.drivers.stop import Stop
from edge.drivers.systemd import ALIVE, READY, STOPPING, ServiceManager, status_text
from edge.identity.group import MOST_BYTES, MOST_FRAGMENTS, frames, open_fleet_key
from edge.identity.guard import Unguarded
from edge.messages.codes import CheckCode, FailedCheck, Reason, ReasonCode
from edge.messages.mission import LoopStatus
from edge.messages.topics import Group, GroupKeys, Knocking, Link, LinkSetting
from edge.policy.family import VerifiedPolicy
from edge.robot.config import RobotConfig, require_group
from edge.robot.log import open_log
from edge.robot.loops import Loop
from edge.robot.node import Ports, RobotNode
from edge.robot.pac import message_bytes

# Of preflight checks, status, systemd's news, and writing the flight log.
_PERIOD_S = 0.25
# The ground tells its time to those who speak, and only a robot's own program perceives.
_ONLY_OF_A_ROBOT = (CheckCode.TIME_NOT_KNOWN, CheckCode.NO_FRESH_ANSWER)
# Of how the loops keep time, which is told of a whole minute.
_LOOPS_PERIOD_S = 1.0
# A control loop without a tick for longer hangs: the vehicle was told to hold before that.
_CONTROL_FRESH_S = 1.0
# On leaving: for the autopilot's answer, and for a loop that hangs.
_ANSWER_S = 1.2
_JOIN_S = 0.3
# The interpreter lets another thread run this often: a tick must not wait 5 ms for each other one.
_SWITCH_INTERVAL_S = 0.001
# glibc gives each thread that allocates an arena of its own, and none of them ever shrinks.
_M_ARENA_MAX = -8
# What is larger goes back to the system when it is freed; left alone, glibc keeps ever more.
_M_MMAP_THRESHOLD, _LARGE_BYTES = -3, 2**19


def _load(config: RobotConfig, parts: ExitStack) -> tuple[VerifiedPolicy, SensorOver, str]:
    """Policy, sensor and world, before anything that moves. Raises ValueError or OSError."""
    policy = load_verified_policy(Path(config.policy.bundle))
    payload = config.policy.payload_of(policy.policy.manifest.payload_types)
    least_bytes, _ = message_bytes(policy.policy, payload)
    if config.link.group and frames(least_bytes) > MOST_FRAGMENTS:
        raise ConfigError(
            f"link: group = {config.link.group!r}: a message of {config.policy.bundle} in "
            f"{payload} has {least_bytes} bytes, and a group takes {MOST_BYTES}: "
            "take another payload, or another transport"
        )
    sensor = config.sensor
    sensor_over = parts.enter_context(
        open_sensor(sensor.type, sensor.options, policy.policy.manifest)
    )
    world = Path(config.policy.world).read_text("utf-8-sig")
    sensor_over(world, config.policy.world)  # or say what is wrong with it now
    return policy, sensor_over, world


def run(config: RobotConfig, stop: Stop) -> None:
    """Fly one robot until `stop` is set. Called from the main thread.

    Raises ValueError or OSError, in one line, for what keeps the program from starting.
    """
    libc = ctypes.CDLL(None)
    libc.mallopt(_M_ARENA_MAX, 1)
    libc.mallopt(_M_MMAP_THRESHOLD, _LARGE_BYTES)
    allow_most_descriptors()
    with ExitStack() as parts:
        # 1. Policy, sensor and world, before anything that moves.
        policy, sensor_over, world = _load(config, parts)
        if stop.is_set():
            return
        sys.setswitchinterval(_SWITCH_INTERVAL_S)
        clock = SystemClock()
        bundle_id, boot_nonce = policy.policy.bundle_id.hex(), secrets.randbits(48)
        service_manager = ServiceManager()
        parts.callback(service_manager.close)
        # 2. One program per robot on this machine.
        parts.enter_context(_robot_lock(config))
        # 3. The flight log, so that it holds all that follows.
        recorder = open_log(config, bundle_id, boot_nonce)
        parts.callback(recorder.close)
        log_to(recorder)
        # 4. The vehicle, and who holds it when this program hangs.
        vehicle, setup, new_watchdog = parts.enter_context(_open_vehicle(config))
        flight = config.flight
        watchdog = parts.enter_context(new_watchdog(flight.command_timeout_s, flight.hover_land_s))
        # 5. The robot itself.
        identity = _identity(config, partial(load_identity, unix_s=clock.unix_s()))
        signed = None if identity is None else identity.guard(clock.monotonic_s)
        node = RobotNode(
            config,
            Ports(
                clock=clock,
                vehicle=vehicle,
                vehicle_setup=setup,
                watchdog=watchdog,
                recorder=recorder,
                sensor_over=sensor_over,
            ),
            policy,
            world,
            signed or Unguarded(int(1e3 * clock.unix_s())),
            boot_nonce=boot_nonce,
        )
        # 6. The radio that feeds it, and takes what it says.
        link = parts.enter_context(_open_link(config, node, config.robot_id, identity, signed))
        node.attach(link)
        # 7. The loops, and what ends them: the vehicle holds or lands, then everything is closed.
        take_up = None
        if identity is not None and signed is not None:
            take_up = partial(identity.update, signed)
        program = _Program(config, node, vehicle, watchdog, recorder, link, take_up)
        gc.collect()
        gc.freeze()  # What is loaded stays: a collection in flight need not look through it.
        libc.malloc_trim(0)  # What verification took goes back to the system.
        program.start()
        parts.callback(program.leave)
        parts.callback(service_manager.notify, STOPPING)
        if config.link.insecure:
            log.warning("insecure: whoever is on the network can fly this robot")
        log.info("robot runs", robot=config.robot_id, bundle=bundle_id[:12])
        # 8. Until somebody stops the program.
        while not stop.wait(_PERIOD_S):  # A signal that another thread took is seen only here.
            service_manager.notify(*program.news())


def _open_vehicle(config: RobotConfig) -> AbstractContextManager[OpenVehicle]:
    autopilot = config.autopilot
    setting = VehicleSetting(autopilot.url, autopilot.system_id, autopilot.options)
    return open_vehicle(autopilot.type, setting)


def _identity(config: RobotConfig, load: Callable[..., Identity]) -> Identity | None:
    """This robot's identity in its fleet; None if there is none. Raises ConfigError or OSError."""
    if not config.identity.folder:
        return None
    folder = Path(config.identity.folder)
    return load(folder, fleet=config.fleet, robot_id=config.robot_id)


def _open_link(
    config: RobotConfig,
    node: RobotNode,
    robot_id: int | None,
    identity: Identity | None,
    members: Knocking | None,
) -> AbstractContextManager[Link]:
    """The radio, as that robot, or with None as somebody who only listens."""
    link = config.link
    setting = LinkSetting(
        config.fleet, robot_id, link.listen, link.connect, link.scouting, link.options,
        node.subscriptions, None if identity is None else identity.tls, _group(config, identity),
        members,
    )  # fmt: skip
    return open_link(link.type, setting)


def _group(config: RobotConfig, identity: Identity | None) -> Group | None:
    """Raises ConfigError for a member that was given no key of the group."""
    if not config.link.group:
        return None
    address, port = require_group("group", config.link.group)
    open_key = open_fleet_key(config.fleet)

    def keys() -> GroupKeys:
        if identity is None:
            return GroupKeys((open_key,), open_key)
        if identity.group_keys is None:
            raise ConfigError(
                f"{config.identity.folder}: {GROUP_KEYS} is missing, which multicast needs: run "
                "`lpac fleet up`"
            )
        return identity.group_keys

    keys()
    return Group(address, port, config.link.interface, keys, is_secret=identity is not None)


class _Program:
    """The threads of a running robot. The main thread calls its methods.

    `take_up` follows the fleet's list of members, and writes the number of this start.
    """

    def __init__(
        self,
        config: RobotConfig,
        node: RobotNode,
        vehicle: Vehicle,
        watchdog: Watchdog,
        recorder: FlightLog,
        link: Link,
        take_up: Callable[..., None] | None,
    ) -> None:
        self._config = config
        self._node = node
        self._vehicle = vehicle
        self._watchdog = watchdog
        self._link = link
        self._recorder = recorder
        self._take_up = take_up
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
            Loop("log", _PERIOD_S, self._write_step),
        )
        self._status_text: str | None = None
        self._loop_statuses: dict[str, LoopStatus] = {}
        self._loops_due_s = -math.inf

    def start(self) -> None:
        """Start the loops; from now on the robot may send."""
        for loop in (*self._loops, *self._chores):
            thread = loop.start()
            with suppress(OSError):  # for whoever looks with `top -H`, and for the bench
                Path(f"/proc/self/task/{thread}/comm").write_text(loop.name)

    def news(self) -> list[str]:
        """Messages to systemd of the present state. Waits for nothing."""
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
            log.warning("program ends in flight", vehicle=action)
            self._command(action)
        preflight, *chores = self._chores
        preflight.stop(_JOIN_S)  # It may wait for the vehicle, whose closing ends that.
        for loop in (*others, *chores):
            self._stop(loop)

    def _stop(self, loop: Loop) -> None:
        if not loop.stop(_JOIN_S):
            log.error("loop hangs", loop=loop.name)

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
        log.error("the autopilot did not answer", action=action)

    def _write_step(self) -> None:
        if self._take_up is not None:
            try:
                self._take_up(in_flight=not self._node.on_ground)
                self._node.identity_problem = ""
            except OSError as error:
                if not self._node.identity_problem:
                    log.error("identity not written", why=str(error))
                self._node.identity_problem = f"{error.filename}: {file_error_in_words(error)}"
        self._recorder.flush()

    def _status_step(self) -> None:
        now_s = time.monotonic()
        if now_s >= self._loops_due_s:
            self._loops_due_s = now_s + _LOOPS_PERIOD_S
            self._loop_statuses = {loop.name: loop.status() for loop in self._loops}
            doors: list[DoorStatus] = getattr(self._link, "doors", list)()
            self._node.host_alarms = tuple(host_alarms(doors, descriptors_short()))
        status = self._node.status_step(self._loop_statuses)
        self._status_text = status_text(
            status,
            monotonic_s=now_s,
            autopilot=self._vehicle.state().connected,
            ages_s={loop.name: loop.age_s() for loop in self._loops},
            peers=self._link.peers(),
            insecure=self._config.link.insecure,
        )


def host_alarms(doors: Iterable[DoorStatus], short: str) -> Iterator[Reason]:
    """Yield the operator's alarms: flooded or full radio ports, and short descriptors."""
    if short:
        yield Reason(ReasonCode.DESCRIPTORS_SHORT, f"{short}: soon nobody can connect")
    for door in doors:
        if door.flooded:
            text = f"strangers flood its radio port: {door.refused} refused; members get in"
            yield Reason(ReasonCode.STRANGERS_FLOOD, text)
        if door.queue_full:
            text = "its radio port has a full queue: nobody new gets in"
            yield Reason(ReasonCode.RADIO_QUEUE_FULL, text)


def _robot_lock(config: RobotConfig) -> ProcessLock:
    """Another program on this machine must not be this robot too."""
    return ProcessLock(f"robot {config.robot_id} of fleet {config.fleet}")


class CheckReport(NamedTuple):
    """Findings of `check`: PX4's reactions, what was set, and what keeps the robot from flying.

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
    with ExitStack() as parts:
        policy, sensor_over, world = _load(config, parts)
        parts.enter_context(_robot_lock(config))
        show("error")
        clock = SystemClock()
        identity = _identity(config, receiving_identity)
        vehicle, setup, _ = parts.enter_context(_open_vehicle(config))
        looking = _OnlyLooking(vehicle)
        node = RobotNode(
            config,
            Ports(
                clock=clock,
                vehicle=looking,
                vehicle_setup=setup,
                watchdog=looking,
                recorder=looking,
                sensor_over=sensor_over,
            ),
            policy,
            world,
            Unguarded(0) if identity is None else identity.guard(clock.monotonic_s),
            boot_nonce=0,
        )
        # Not as the robot itself: its program is not running.
        node.attach(parts.enter_context(_open_link(config, node, None, identity, None)))
        # Of its own, since the checks wait for the vehicle; it looks as often as a flight does.
        control = Loop("control", 1.0 / config.rates.control_hz, node.control_step)
        control.start()
        parts.callback(control.stop, _JOIN_S)
        until_s = time.monotonic() + wait_s
        while True:
            node.preflight_step()
            failed = node.failed_checks
            if failed is not None:
                failed = tuple(c for c in failed if c.code not in _ONLY_OF_A_ROBOT)
                problem = node.try_sensor()
                if problem:
                    text = f"sensor {config.sensor.type}: {problem}"
                    failed += (FailedCheck(CheckCode.NO_FRESH_ANSWER, text),)
            if failed == () or (failed is not None and time.monotonic() > until_s):
                readiness = node.readiness
                version = in_words(vehicle.state().version)
                return CheckReport(version, readiness.explanations, readiness.changes, failed)
            time.sleep(_PERIOD_S)
