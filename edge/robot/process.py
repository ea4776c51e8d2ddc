"""One robot's program: a node, its drivers, and the threads that call its steps.

Threads: the three loops `perception`, `policy` and `control`; `status`; `log`, which waits for the
disk; `preflight`, which waits for the vehicle; zenoh's and MAVSDK's own, whose callbacks only
store; and the main thread. The main thread waits for signals, reports to systemd that the control
loop runs, and does nothing that could hang.
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
from edge.drivers.identity_folder import GROUP_KEYS, Identity, load_identity, receiving_identity
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

# Period of preflight checks, status, reports to systemd, and writing the flight log.
_PERIOD_S = 0.25
# `check` cannot pass these: it publishes nothing, so it gets no time, and it does not perceive.
_ONLY_RUNNING = (CheckCode.TIME_NOT_KNOWN, CheckCode.NO_FRESH_ANSWER)
# Period of the loops' statistics, which cover a minute.
_LOOPS_PERIOD_S = 1.0
# A control loop without a tick for longer counts as hanging; the watchdog acts sooner.
_CONTROL_FRESH_S = 1.0
# Timeouts at the program's end: for the autopilot's answer, and for a loop to end.
_ANSWER_S = 1.2
_JOIN_S = 0.3
# Python's default lets a tick wait 5 ms for each other thread.
_SWITCH_INTERVAL_S = 0.001
# glibc gives each allocating thread an arena of its own, and arenas never shrink.
_M_ARENA_MAX = -8
# Larger blocks return to the system when freed; glibc's own threshold grows.
_M_MMAP_THRESHOLD, _LARGE_BYTES = -3, 2**19


def _load(config: RobotConfig, parts: ExitStack) -> tuple[VerifiedPolicy, SensorOver, str]:
    """Load policy, sensor and world. Raises ValueError or OSError."""
    policy = load_verified_policy(Path(config.policy.bundle))
    payload = config.policy.payload_of(policy.policy.manifest.payload_types)
    least_bytes, _ = message_bytes(policy.policy, payload)
    if config.link.group and frames(least_bytes) > MOST_FRAGMENTS:
        raise ConfigError(
            f"link: group = {config.link.group!r}: a message of {config.policy.bundle} in "
            f"{payload} has {least_bytes} bytes, and a group takes {MOST_BYTES}: "
            "choose another payload or transport"
        )
    sensor = config.sensor
    sensor_over = parts.enter_context(
        open_sensor(sensor.type, sensor.options, policy.policy.manifest)
    )
    world = Path(config.policy.world).read_text("utf-8-sig")
    sensor_over(world, config.policy.world)  # Raises now for an unusable world.
    return policy, sensor_over, world


def run(config: RobotConfig, stop: Stop) -> None:
    """Fly one robot until `stop` is set. Call it from the main thread.

    At the end a vehicle in flight holds or lands, then everything is closed.

    Raises ValueError or OSError, in one line, if the program cannot start.
    """
    libc = ctypes.CDLL(None)
    libc.mallopt(_M_ARENA_MAX, 1)
    libc.mallopt(_M_MMAP_THRESHOLD, _LARGE_BYTES)
    allow_most_descriptors()
    with ExitStack() as parts:
        # Before anything that moves.
        policy, sensor_over, world = _load(config, parts)
        if stop.is_set():
            return
        sys.setswitchinterval(_SWITCH_INTERVAL_S)
        clock = SystemClock()
        bundle_id, boot_nonce = policy.policy.bundle_id.hex(), secrets.randbits(48)
        service_manager = ServiceManager()
        parts.callback(service_manager.close)
        parts.enter_context(_robot_lock(config))
        # Early, so that the log holds all that follows.
        recorder = open_log(config, bundle_id, boot_nonce)
        parts.callback(recorder.close)
        log_to(recorder)
        vehicle, setup, new_watchdog = parts.enter_context(_open_vehicle(config))
        flight = config.flight
        watchdog = parts.enter_context(new_watchdog(flight.command_timeout_s, flight.hover_land_s))
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
        link = parts.enter_context(_open_link(config, node, config.robot_id, identity, signed))
        node.attach(link)
        update_identity = None
        if identity is not None and signed is not None:
            update_identity = partial(identity.update, signed)
        program = _Program(config, node, vehicle, watchdog, recorder, link, update_identity)
        gc.collect()
        gc.freeze()  # Spares collections in flight the objects loaded by now.
        libc.malloc_trim(0)  # Returns the memory of the verification to the system.
        program.start()
        parts.callback(program.leave)
        parts.callback(service_manager.notify, STOPPING)
        if config.link.insecure:
            log.warning("insecure: anybody on the network can fly this robot")
        log.info("robot runs", robot=config.robot_id, bundle=bundle_id[:12])
        while not stop.wait(_PERIOD_S):  # Also handles signals that another thread received.
            service_manager.notify(*program.notifications())


def _open_vehicle(config: RobotConfig) -> AbstractContextManager[OpenVehicle]:
    autopilot = config.autopilot
    setting = VehicleSetting(autopilot.url, autopilot.system_id, autopilot.options)
    return open_vehicle(autopilot.type, setting)


def _identity(config: RobotConfig, load: Callable[..., Identity]) -> Identity | None:
    """This robot's identity; None in a fleet without keys. Raises ConfigError or OSError."""
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
    """Open the radio as that robot, or to subscribe only if None."""
    link = config.link
    setting = LinkSetting(
        config.fleet, robot_id, link.listen, link.connect, link.scouting, link.options,
        node.subscriptions, None if identity is None else identity.tls, _group(config, identity),
        members,
    )  # fmt: skip
    return open_link(link.type, setting)


def _group(config: RobotConfig, identity: Identity | None) -> Group | None:
    """The multicast group, if any. Raises ConfigError for a member without a group key."""
    if not config.link.group:
        return None
    address, port = require_group("group", config.link.group)
    open_key = open_fleet_key(config.fleet)

    def keys() -> GroupKeys:
        if identity is None:
            return GroupKeys((open_key,), open_key)
        if identity.group_keys is None:
            raise ConfigError(
                f"{config.identity.folder}: {GROUP_KEYS} is missing, and multicast needs it: run "
                "`lpac fleet up`"
            )
        return identity.group_keys

    keys()
    return Group(address, port, config.link.interface, keys, is_secret=identity is not None)


class _Program:
    """The threads of a running robot. Call its methods from the main thread.

    `update_identity` rereads the fleet's list of members, and writes the number of this start.
    """

    def __init__(
        self,
        config: RobotConfig,
        node: RobotNode,
        vehicle: Vehicle,
        watchdog: Watchdog,
        recorder: FlightLog,
        link: Link,
        update_identity: Callable[..., None] | None,
    ) -> None:
        self._config = config
        self._node = node
        self._vehicle = vehicle
        self._watchdog = watchdog
        self._link = link
        self._recorder = recorder
        self._update_identity = update_identity
        rates = config.rates
        self._loops = (
            Loop("control", 1.0 / rates.control_hz, node.control_step),
            Loop("perception", 1.0 / rates.perception_hz, node.perception_step),
            Loop("policy", 1.0 / rates.policy_hz, node.policy_step),
        )
        # A silent vehicle may block `preflight` for many seconds.
        self._chores = (
            Loop("preflight", _PERIOD_S, node.preflight_step),
            Loop("status", _PERIOD_S, self._status_step),
            Loop("log", _PERIOD_S, self._write_step),
        )
        self._status_text: str | None = None
        self._loop_statuses: dict[str, LoopStatus] = {}
        self._loops_due_s = -math.inf

    def start(self) -> None:
        """Start the loops."""
        for loop in (*self._loops, *self._chores):
            thread = loop.start()
            with suppress(OSError):  # Thread names for `top -H` and the bench.
                Path(f"/proc/self/task/{thread}/comm").write_text(loop.name)

    def notifications(self) -> list[str]:
        """Notifications to systemd of the present state. Does not block."""
        notifications = [] if self._status_text is None else [self._status_text]
        ages_s = [loop.age_s() for loop in self._loops]
        if None not in ages_s:
            notifications.append(READY)
        control_s = ages_s[0]
        if control_s is not None and control_s < _CONTROL_FRESH_S:
            notifications.append(ALIVE)
        return notifications

    def leave(self) -> None:
        """Make a vehicle in flight hold or land, and stop the loops."""
        control, *others = self._loops
        self._stop(control)
        action = self._node.leave(Action(self._config.on_stop))
        if action is not None:
            log.warning("program ends in flight", vehicle=action)
            self._command(action)
        preflight, *chores = self._chores
        preflight.stop(_JOIN_S)  # It may wait for the vehicle, until that is closed.
        for loop in (*others, *chores):
            self._stop(loop)

    def _stop(self, loop: Loop) -> None:
        if not loop.stop(_JOIN_S):
            log.error("loop hangs", loop=loop.name)

    def _command(self, action: Action) -> None:
        asked_s = time.monotonic()
        # Keeps the watchdog from interrupting it. If the command is lost, PX4 lands the vehicle.
        self._watchdog.feed(flying=False)
        self._vehicle.command(action)
        while time.monotonic() - asked_s < _ANSWER_S:
            result = self._vehicle.state().result
            if result and result.action is action and result.at_s >= asked_s:
                return
            time.sleep(0.02)
        log.error("the autopilot did not answer", action=action)

    def _write_step(self) -> None:
        if self._update_identity is not None:
            try:
                self._update_identity(in_flight=not self._node.on_ground)
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
    """Yield alarms about the computer: flooded or full radio ports, and few descriptors left."""
    if short:
        yield Reason(ReasonCode.DESCRIPTORS_SHORT, f"{short}: new connections will fail soon")
    for door in doors:
        if door.flooded:
            text = f"strangers flood its radio port: {door.refused} refused; members can connect"
            yield Reason(ReasonCode.STRANGERS_FLOOD, text)
        if door.queue_full:
            text = "its radio port's queue is full: new connections fail"
            yield Reason(ReasonCode.RADIO_QUEUE_FULL, text)


def _robot_lock(config: RobotConfig) -> ProcessLock:
    """Lock against another program of this robot on this machine."""
    return ProcessLock(f"robot {config.robot_id} of fleet {config.fleet}")


class CheckReport(NamedTuple):
    """Findings of `check`: PX4's reactions, changed parameters and failed checks.

    `version` is PX4's, and how well it is tested.
    """

    version: str
    explanations: tuple[str, ...]
    changes: tuple[str, ...]
    failed: tuple[FailedCheck, ...]


class _PassivePorts:
    """Ports for `check`: a vehicle that is read only, no watchdog, and no log."""

    recording = True

    def __init__(self, vehicle: Vehicle) -> None:
        self.state = vehicle.state

    def send(self, setpoint: Setpoint) -> Setpoint | None:
        """Do nothing."""

    def command(self, action: Action) -> None:
        """Do nothing."""

    def feed(self, *, flying: bool) -> None:
        """Do nothing."""

    def alive(self) -> bool:
        """Whether the watchdog works: `check` needs none."""
        return True

    def record(self, topic: str, unix_time_s: float, message: Mapping[str, object]) -> None:
        """Do nothing."""


def check(config: RobotConfig, wait_s: float) -> CheckReport:
    """Run all preflight checks without flying, until they pass or for `wait_s`.

    Raises ValueError or OSError, in one line, if the checks cannot run.
    """
    with ExitStack() as parts:
        policy, sensor_over, world = _load(config, parts)
        parts.enter_context(_robot_lock(config))
        show("error")
        clock = SystemClock()
        identity = _identity(config, receiving_identity)
        vehicle, setup, _ = parts.enter_context(_open_vehicle(config))
        passive = _PassivePorts(vehicle)
        node = RobotNode(
            config,
            Ports(
                clock=clock,
                vehicle=passive,
                vehicle_setup=setup,
                watchdog=passive,
                recorder=passive,
                sensor_over=sensor_over,
            ),
            policy,
            world,
            Unguarded(0) if identity is None else identity.guard(clock.monotonic_s),
            boot_nonce=0,
        )
        # Subscribe only: the robot's program is not running.
        node.attach(parts.enter_context(_open_link(config, node, None, identity, None)))
        # In a thread of its own at flight rate, since the checks wait for the vehicle.
        control = Loop("control", 1.0 / config.rates.control_hz, node.control_step)
        control.start()
        parts.callback(control.stop, _JOIN_S)
        until_s = time.monotonic() + wait_s
        while True:
            node.preflight_step()
            failed = node.failed_checks
            if failed is not None:
                failed = tuple(c for c in failed if c.code not in _ONLY_RUNNING)
                problem = node.try_sensor()
                if problem:
                    text = f"sensor {config.sensor.type}: {problem}"
                    failed += (FailedCheck(CheckCode.NO_FRESH_ANSWER, text),)
            if failed == () or (failed is not None and time.monotonic() > until_s):
                readiness = node.readiness
                version = in_words(vehicle.state().version)
                return CheckReport(version, readiness.explanations, readiness.changes, failed)
            time.sleep(_PERIOD_S)
