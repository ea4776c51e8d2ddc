"""Real PX4s from a SITL build (`make px4_sitl`) with PX4's own vehicle model (SIH), from v1.14 on.

Instance i listens on UDP port 14580 + i, sends to 14540 + i, receives a ground station on
18570 + i, and sends the vehicle's true state (HIL_STATE_QUATERNION) to 19410 + i. From
instance 10 on they would share one port. The true flight is read from PX4's log at the end.
"""

import fcntl
import hashlib
import json
import math
import os
import platform
import re
import selectors
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from edge.core import F64
from lpac.analysis.field_truth import CLOCK_TABLE
from lpac.analysis.truth import TrueTrack
from lpac.sim.fleet.vehicles import AutopilotAddress, VehicleError
from lpac.sim.px4.world import WorldOrigin
from lpac.sim.sitl import ordinary
from lpac.sim.sitl.log import read_setpoints, read_truth

MAX_INSTANCES = 10
_PROGRAM = Path("bin", "px4")
LISTEN_PORT = 14580
CLIENT_PORT = 14540
GROUND_PORT = 18570
TRUTH_PORT = 19410
AIRBORNE_ABOVE_M = 0.15
_STOP_WITHIN_S = 3.0
_STATE_WITHIN_S = 30.0
_MODEL, _AIRFRAME = "sihsim_quadx", "10040"
# Log everything from start to end. Two calibrations that change their rate on arming are off: on a
# multithreaded computer PX4's list of timers can then lose its tail, and with it all simulated
# sensors, for good (v1.17, in one arming of four). The battery lasts 20 minutes, as the simulated
# vehicle's: PX4's default is half empty after half a minute, on which robots return.
_PARAMETERS = {
    "SIM_BAT_DRAIN": "1200",
    "SDLOG_MODE": "2",
    "SDLOG_PROFILE": "1",
    "IMU_GYRO_CAL_EN": "0",
    "SENS_MAG_AUTOCAL": "0",
}
# v1.14 sources it from PATH; newer versions read PX4_PARAM_* from the environment.
_PARAMETERS_SCRIPT = "px4-rc.params"
# State that PX4 keeps between starts; deleted, so that a flight begins with default parameters.
_KEPT_FILES = ("parameters.bson", "parameters_backup.bson", "dataman", "eeprom/parameters")
_CLOCK_PERIOD_S = 0.1
_MAVLINK_2, _HEADER_BYTES, _FRAME_BYTES = 0xFD, 10, 12
# ELF's e_machine.
_MACHINES = {3: "i386", 40: "arm", 62: "x86_64", 183: "aarch64", 243: "riscv64"}


class _Place(NamedTuple):
    """True position at a `time.monotonic()`: north, east, down, m."""

    time_s: float
    position_m: tuple[float, float, float]


@dataclass(slots=True)
class _Instance:
    """One PX4: its process, and the received states of its vehicle.

    `clock` has pairs of `time.monotonic()` and PX4's time, s.
    """

    number: int
    folder: Path
    places: list[_Place] = field(default_factory=list)
    clock: list[tuple[float, float]] = field(default_factory=list)
    process: subprocess.Popen[bytes] | None = None
    started_unix_s: float = math.inf
    started_s: float = math.inf
    parser: Any = None
    clock_table: Any = None

    def to_monotonic_s(self, times_s: F64) -> F64:
        """PX4's times as `time.monotonic()`."""
        monotonic_s, px4_s = np.array(self.clock).T
        at_s: F64 = np.interp(times_s, px4_s, monotonic_s)
        at_s += np.minimum(0.0, times_s - px4_s[0]) + np.maximum(0.0, times_s - px4_s[-1])
        return at_s

    def logs(self) -> list[Path]:
        """PX4's logs of this start."""
        found = (self.folder / "log").rglob("*.ulg")
        return sorted(path for path in found if path.stat().st_mtime >= self.started_unix_s)

    def ending(self) -> str:
        """Signal or exit code of the ended PX4, and its last line of output."""
        assert self.process is not None and self.process.returncode is not None
        code = self.process.returncode
        how = f"by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        return f"{how}: {self.last_output()}"

    def last_output(self) -> str:
        """The last error in px4.log, or its last line without one."""
        log = self.folder / "px4.log"
        text = re.sub(r"\x1b\[[0-9;]*m", "", log.read_text(errors="replace"))
        lines = [line.strip() for line in text.splitlines() if line.strip()]
        # Unknown parameters are harmless, and a failing script always reports so last.
        errors = [
            line
            for line in lines
            if line.startswith("ERROR") and "Parameter" not in line and "Startup script" not in line
        ]
        last = [*lines[-1:], *errors[-1:]]
        return f"{last[-1]} (see {log})" if last else "it printed nothing"


class Px4Build:
    """N instances of a PX4 build, one per start; a context in which they run."""

    def __init__(
        self,
        build: Path,
        starts_m: Sequence[tuple[float, float]],
        world: WorldOrigin,
        folder: Path,
    ) -> None:
        """`starts_m` are north and east in the world; each instance runs in a folder in `folder`.

        Raises ValueError if `build` is no build of PX4's simulator, or there are too many starts,
        VehicleError if an older PX4 still runs, or a port is taken.
        """
        if not 1 <= len(starts_m) <= MAX_INSTANCES:
            raise ValueError(
                f"robots = {len(starts_m)}: must be from 1 to {MAX_INSTANCES} with --vehicle px4, "
                "since PX4 sends to one port from instance 10 on"
            )
        build = require_build(build)
        if " " in str(build) or " " in str(folder):
            raise ValueError(f"--px4 {build}, --out {folder}: PX4 does not take spaces in paths")
        for number in range(len(starts_m)):
            _require_alone(number)
            for port in (LISTEN_PORT, CLIENT_PORT, GROUND_PORT, TRUTH_PORT):
                _udp(port + number).close()
        self.build = build
        self.autopilots = tuple(
            AutopilotAddress(f"udpin://127.0.0.1:{CLIENT_PORT + i}", i + 1)
            for i in range(len(starts_m))
        )
        self._starts_m = tuple(starts_m)
        self._world = world
        self._instances = tuple(_Instance(i, folder / str(i)) for i in range(len(starts_m)))
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._listen, name="px4-truth", daemon=True)
        self._selector = selectors.DefaultSelector()
        self._stack = ExitStack()
        self._degrees_1e7 = _start_is_in_degrees_1e7(build)

    def __enter__(self) -> Self:
        """Start all instances. Raises VehicleError if a port is taken."""
        with ExitStack() as stack:
            stack.enter_context(self._selector)
            for instance in self._instances:
                truth = stack.enter_context(_udp(TRUTH_PORT + instance.number))
                truth.setblocking(False)
                instance.folder.mkdir(parents=True, exist_ok=True)
                instance.clock_table = stack.enter_context(
                    (instance.folder / CLOCK_TABLE).open("w", buffering=1)
                )
                instance.parser = mavlink.MAVLink(None)
                instance.parser.robust_parsing = True
                self._selector.register(truth, selectors.EVENT_READ, instance)
            stack.callback(self._stop_all)
            self._thread.start()
            for instance in self._instances:
                self._start(instance)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def require_running(self) -> None:
        """Raise VehicleError if a PX4 has ended, or does not send its vehicle's state."""
        for instance in self._instances:
            process = instance.process
            if process is not None and process.poll() is not None:
                raise VehicleError(f"the PX4 of r{instance.number} has ended, {instance.ending()}")
            with self._lock:
                received = bool(instance.places)
            if not received and time.monotonic() - instance.started_s > _STATE_WITHIN_S:
                raise VehicleError(
                    f"the PX4 of r{instance.number} has not sent its vehicle's state within "
                    f"{_STATE_WITHIN_S:g} s: {instance.last_output()}"
                )

    def tracks(self) -> tuple[TrueTrack, ...]:
        """Tracks from PX4's own logs, once PX4 has ended; from its messages without a log."""
        return tuple(self._track(instance) for instance in self._instances)

    def forget(self) -> None:
        """Drop the history of each vehicle."""
        with self._lock:
            for instance in self._instances:
                del instance.places[:-1]
                del instance.clock[1:-1]

    def lost_s(self) -> float:
        """Lateness of the slowest PX4's clock, s."""
        with self._lock:
            clocks = [(i.clock[0], i.clock[-1]) for i in self._instances if i.clock]
        lost_s = [
            (last_s - first_s) - (px4_last_s - px4_first_s)
            for (first_s, px4_first_s), (last_s, px4_last_s) in clocks
        ]
        return max(0.0, *lost_s, 0.0)

    def stood_still_s(self, since_s: float) -> float:
        """Longest standstill of a PX4's clock after `since_s` (`time.monotonic()`), s."""
        longest_s = 0.0
        with self._lock:
            for instance in self._instances:
                clock_s = np.array([pair for pair in instance.clock if pair[0] >= since_s])
                passed_s = np.diff(clock_s.reshape(-1, 2), axis=0)
                longest_s = max(longest_s, (passed_s[:, 0] - passed_s[:, 1]).max(initial=0.0))
        return longest_s

    def pids(self) -> list[int]:
        """Process ids of the running PX4s."""
        processes = [instance.process for instance in self._instances]
        return [p.pid for p in processes if p is not None and p.poll() is None]

    def _track(self, instance: _Instance) -> TrueTrack:
        """Track of one vehicle; without a complete log it has no modes and setpoints."""
        truth = read_truth(instance.logs(), self._world) if instance.clock else None
        if truth is not None:
            airborne = truth.position_m[:, 2] < -AIRBORNE_ABOVE_M
            time_s = instance.to_monotonic_s(truth.time_s)
            track = TrueTrack(time_s, truth.position_m, airborne)
            if not len(truth.status_s):
                return track
            setpoints = read_setpoints(instance.logs())
            status = np.maximum(np.searchsorted(truth.status_s, truth.time_s, "right") - 1, 0)
            # Index 0 is before any setpoint.
            last = np.searchsorted(setpoints.time_s, truth.time_s, "right")
            return replace(
                track,
                velocity_m_s=truth.velocity_m_s,
                mode=truth.navigation_state[status],
                armed=truth.armed[status],
                setpoint_at_s=np.append(-np.inf, instance.to_monotonic_s(setpoints.time_s))[last],
                is_velocity=np.append(False, setpoints.is_velocity)[last],
                velocity_error_m_s=truth.velocity_error_m_s,
                commands=np.zeros(len(time_s), np.int64),
            )
        with self._lock:
            places = tuple(instance.places)
        position_m = np.array([place.position_m for place in places]).reshape(-1, 3)
        airborne = position_m[:, 2] < -AIRBORNE_ABOVE_M
        return TrueTrack(np.array([place.time_s for place in places]), position_m, airborne)

    def _start(self, instance: _Instance) -> None:
        folder = instance.folder
        for name in _KEPT_FILES:
            (folder / name).unlink(missing_ok=True)
        (folder / _PARAMETERS_SCRIPT).write_text(
            "".join(f"param set {name} {value}\n" for name, value in _PARAMETERS.items())
        )
        instance.started_unix_s, instance.started_s = time.time(), time.monotonic()
        with (folder / "px4.log").open("wb") as output:
            instance.process = subprocess.Popen(
                [sys.executable, "-I", ordinary.__file__, str(os.getpid()),
                 str(self.build / _PROGRAM), "-i", str(instance.number), "-d",
                 str(self.build / "etc")],
                cwd=folder, env=self._environment(instance),
                stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT,
                process_group=0,
            )  # fmt: skip

    def _environment(self, instance: _Instance) -> dict[str, str]:
        north_m, east_m = self._starts_m[instance.number]
        latitude, longitude, altitude_m = self._world.to_global(np.array([north_m, east_m, 0.0]))
        home = [f"{latitude:.7f}", f"{longitude:.7f}"]
        if self._degrees_1e7:
            home = [str(round(latitude * 1e7)), str(round(longitude * 1e7))]
        # PX4_* variables of the shell would change the flight.
        inherited = {k: v for k, v in os.environ.items() if not k.startswith("PX4_")}
        return {
            **inherited,
            "PATH": f"{instance.folder}:{inherited.get('PATH', os.defpath)}",
            "PX4_SIM_MODEL": _MODEL,
            "PX4_SYS_AUTOSTART": _AIRFRAME,
            "PX4_HOME_LAT": home[0],
            "PX4_HOME_LON": home[1],
            "PX4_HOME_ALT": f"{altitude_m:.2f}",
            **{f"PX4_PARAM_{name}": value for name, value in _PARAMETERS.items()},
        }

    def _stop_all(self) -> None:
        processes = [i.process for i in self._instances if i.process is not None]
        for process in processes:
            process.terminate()
        until_s = time.monotonic() + _STOP_WITHIN_S
        for process in processes:
            with suppress(subprocess.TimeoutExpired):
                process.wait(max(0.0, until_s - time.monotonic()))
            # Its start-up script, too, if it still runs.
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        for instance in self._instances[: len(processes)]:
            # PX4 leaves these files behind, which would block another user.
            for path in _own_files(instance.number):
                with suppress(OSError):
                    path.unlink()
        self._stop.set()
        self._thread.join()

    def _listen(self) -> None:
        while not self._stop.is_set():
            for key, _ in self._selector.select(0.2):
                assert isinstance(key.fileobj, socket.socket)
                self._take(key.data, key.fileobj.recv(2048))

    def _take(self, instance: _Instance, datagram: bytes) -> None:
        now_s = time.monotonic()
        for message_id, frame in frames(datagram):
            if message_id == mavlink.MAVLINK_MSG_ID_HIL_ACTUATOR_CONTROLS:
                # It comes 200 times a second; only its first field, PX4's time, is needed.
                (time_us,) = struct.unpack("<Q", payload(frame, 8))
                with self._lock:
                    if not instance.clock or now_s - instance.clock[-1][0] > _CLOCK_PERIOD_S:
                        instance.clock.append((now_s, time_us * 1e-6))
                        print(f"{time.time():.3f},{time_us * 1e-6:.3f}", file=instance.clock_table)
            elif message_id == mavlink.MAVLINK_MSG_ID_HIL_STATE_QUATERNION:
                for message in instance.parser.parse_buffer(frame) or ():
                    self._add_place(instance, now_s, message)

    def _add_place(self, instance: _Instance, now_s: float, message: Any) -> None:
        north_m, east_m = self._world.to_world(message.lat * 1e-7, message.lon * 1e-7)
        place = _Place(now_s, (north_m, east_m, self._world.altitude_m - message.alt * 1e-3))
        with self._lock:
            instance.places.append(place)


def frames(datagram: bytes) -> Iterator[tuple[int, bytes]]:
    """The MAVLink 2 messages of a datagram, with their ids."""
    start = 0
    while start + _FRAME_BYTES <= len(datagram) and datagram[start] == _MAVLINK_2:
        end = start + _FRAME_BYTES + datagram[start + 1]
        yield int.from_bytes(datagram[start + 7 : start + 10], "little"), datagram[start:end]
        start = end


def payload(frame: bytes, size: int) -> bytes:
    """The first bytes of a message's payload, padded by the zeros that MAVLink truncates."""
    return frame[_HEADER_BYTES : _HEADER_BYTES + min(frame[1], size)].ljust(size, b"\0")


def require_build(build: Path) -> Path:
    """The resolved path of a PX4 SITL build. Raises ValueError if it is not one."""
    build = build.expanduser().resolve()
    fault = _build_fault(build)
    if fault:
        raise ValueError(f"--px4 {build}: {fault}")
    return build


def build_digest(build: Path) -> str:
    """SHA-256 of a build's program, since another may fly differently. Raises OSError."""
    with (build / _PROGRAM).open("rb") as program:
        return hashlib.file_digest(program, "sha256").hexdigest()


def _build_fault(build: Path) -> str:
    """Why this machine cannot fly a folder as a PX4 SITL build; "" if it can."""
    program = build / _PROGRAM
    give = (
        "give the folder that PX4's `make px4_sitl` fills, such as "
        "PX4-Autopilot/build/px4_sitl_default"
    )
    if not build.exists():
        return "there is no such folder"
    if not build.is_dir():
        return "is no folder: " + give
    if not program.is_file():
        built = sorted(path.parent.parent for path in build.glob("build/*/bin/px4"))
        if built:
            return f"is PX4's source, not its build: give {built[0]}"
        if (build / "ROMFS").is_dir():
            return "is PX4's source, not built: run `make px4_sitl` in it, and " + give
        return "has no program bin/px4: " + give
    machine = _machine(program)
    if machine not in ("", platform.machine()):
        return f"bin/px4 is for {machine}, and this machine is {platform.machine()}: build it here"
    if not os.access(program, os.X_OK):
        return "bin/px4 is not executable: chmod +x it, or build again"
    if not (build / "etc" / "init.d-posix" / "rcS").is_file():
        return "has no etc/init.d-posix/rcS, so the build did not end: run `make px4_sitl` again"
    if not (build / "etc" / "init.d-posix" / "airframes" / f"{_AIRFRAME}_{_MODEL}").is_file():
        return (
            f"has no airframe {_AIRFRAME}_{_MODEL}, PX4's own vehicle model: build PX4 v1.14 or "
            "later with `make px4_sitl`"
        )
    return ""


def _machine(program: Path) -> str:
    """The processor of an ELF program; "" for another kind of file."""
    with program.open("rb") as file:
        head = file.read(20)
    if head[:4] != b"\x7fELF" or len(head) < 20:
        return ""
    (machine,) = struct.unpack_from("<H" if head[5] == 1 else ">H", head, 18)
    return _MACHINES.get(machine, f"another processor ({machine})")


def _require_alone(instance: int) -> None:
    """Raise VehicleError if a PX4 of that instance runs, or has left files in the way."""
    lock, _ = files = _own_files(instance)
    for path in files:
        if path.exists() and path.stat().st_uid != os.geteuid() and os.geteuid() != 0:
            raise VehicleError(f"{path} belongs to another user: remove it: sudo rm {path}")
    if not lock.exists():
        return
    with lock.open("r+b") as file:
        query = struct.pack("hhqqi4x", fcntl.F_WRLCK, os.SEEK_SET, 0, 0, 0)
        kind, _, _, _, pid = struct.unpack("hhqqi4x", fcntl.fcntl(file, fcntl.F_GETLK, query))
    if kind != fcntl.F_UNLCK:
        end = f"end it: kill {pid}" if pid > 0 else "end it"
        raise VehicleError(f"another PX4 runs as instance {instance}, perhaps an old one: {end}")


def _own_files(instance: int) -> tuple[Path, Path]:
    """PX4's lock file, and its command socket."""
    return Path(f"/tmp/px4_lock-{instance}"), Path(f"/tmp/px4-sock-{instance}")


def _udp(port: int) -> socket.socket:
    udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        udp.bind(("127.0.0.1", port))
    except OSError as error:
        udp.close()
        raise VehicleError(
            f"UDP port {port} is taken ({error.strerror}): end the PX4 simulation, robot or ground "
            f"station that has it (ss -ulnp 'sport = {port}' tells which)"
        ) from None
    return udp


def _start_is_in_degrees_1e7(build: Path) -> bool:
    """Whether PX4_HOME_LAT is in 1e-7 degrees, as SIH_LOC_LAT0 of older PX4s, an integer."""
    try:
        parameters = json.loads((build / "parameters.json").read_text())["parameters"]
        types = {parameter["name"]: parameter["type"] for parameter in parameters}
    except (OSError, ValueError, KeyError, TypeError):
        return False
    return str(types.get("SIH_LOC_LAT0", "")).lower() == "int32"
