"""Real PX4s, as a build of PX4's simulator (`make px4_sitl`) makes them: software in the loop with
PX4's own vehicle model (SIH); v1.14 and later.

Instance i listens on UDP port 14580 + i, sends to 14540 + i, and tells where its vehicle really is
(HIL_STATE_QUATERNION) on 19410 + i. Those beyond the tenth would all send to one port.
"""

import json
import os
import selectors
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from sim.fleet_vehicles import Autopilot, Track
from sim.px4.world import WorldOrigin

MAX_INSTANCES = 10
LISTEN_PORT = 14580
CLIENT_PORT = 14540
TRUTH_PORT = 19410
_AIRBORNE_ABOVE_M = 0.15
_STOP_WITHIN_S = 3.0


class _Place(NamedTuple):
    """Where a vehicle really was: `time.monotonic()`, and north, east, down, m."""

    time_s: float
    position_m: tuple[float, float, float]


class Px4Build:
    """N instances of a PX4 build, one per start; a context in which they run."""

    def __init__(
        self,
        build: Path,
        starts_m: Sequence[tuple[float, float]],
        world: WorldOrigin,
        folder: Path,
    ) -> None:
        """`starts_m` are north and east in the world; each instance works in a folder of `folder`.

        Raises ValueError if `build` is no build of PX4's simulator, or there are too many starts.
        """
        if not 1 <= len(starts_m) <= MAX_INSTANCES:
            raise ValueError(
                f"robots = {len(starts_m)}: must be from 1 to {MAX_INSTANCES} with --vehicle px4, "
                "since PX4 sends to one port from instance 10 on"
            )
        build = build.resolve()
        self._program, self._data = build / "bin" / "px4", build / "etc"
        if not build.is_dir():
            raise ValueError(f"--px4 {build}: there is no such folder")
        if not os.access(self._program, os.X_OK) or not self._program.is_file():
            raise ValueError(
                f"--px4 {build}: has no program bin/px4: give the folder that `make px4_sitl` of "
                "PX4 fills, such as PX4-Autopilot/build/px4_sitl_default"
            )
        if " " in str(build) or " " in str(folder):
            raise ValueError(f"--px4 {build}, --out {folder}: PX4 does not take spaces in paths")
        self.autopilots = tuple(
            Autopilot(f"udpin://127.0.0.1:{CLIENT_PORT + i}", i + 1) for i in range(len(starts_m))
        )
        self._starts_m = tuple(starts_m)
        self._world = world
        self._folder = folder
        self._places: tuple[list[_Place], ...] = tuple([] for _ in starts_m)
        self._places_lock = threading.Lock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._listen, name="px4-truth", daemon=True)
        self._selector = selectors.DefaultSelector()
        self._processes: list[subprocess.Popen[bytes]] = []
        self._stack = ExitStack()
        self._degrees_1e7 = _start_is_in_degrees_1e7(build)

    def __enter__(self) -> Self:
        """Raises OSError in words if a port is taken, most likely by another PX4."""
        with ExitStack() as stack:
            stack.enter_context(self._selector)
            for instance in range(len(self._starts_m)):
                for port in (LISTEN_PORT + instance, CLIENT_PORT + instance):
                    _udp(port).close()
                truth = stack.enter_context(_udp(TRUTH_PORT + instance))
                truth.setblocking(False)
                self._selector.register(truth, selectors.EVENT_READ, instance)
            stack.callback(self._stop_all)
            self._thread.start()
            for instance in range(len(self._starts_m)):
                self._processes.append(self._start(instance))
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._stack.__exit__(kind, error, traceback)

    def tracks(self) -> tuple[Track, ...]:
        """What PX4's vehicle model says; empty where it says nothing."""
        with self._places_lock:
            recorded = [tuple(places) for places in self._places]
        tracks = []
        for places in recorded:
            position_m = np.array([place.position_m for place in places]).reshape(-1, 3)
            airborne = position_m[:, 2] < -_AIRBORNE_ABOVE_M
            tracks.append(Track(np.array([place.time_s for place in places]), position_m, airborne))
        return tuple(tracks)

    def forget(self) -> None:
        """Keep of each only where it is."""
        with self._places_lock:
            for places in self._places:
                del places[:-1]

    def lost_s(self) -> float:
        """Not known of PX4."""
        return 0.0

    def _start(self, instance: int) -> subprocess.Popen[bytes]:
        folder = self._folder / str(instance)
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / "px4.log").open("wb") as output:
            return subprocess.Popen(
                [str(self._program), "-i", str(instance), "-d", str(self._data)],
                cwd=folder, env=os.environ | self._environment(instance),
                stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT,
                process_group=0,
            )  # fmt: skip

    def _environment(self, instance: int) -> dict[str, str]:
        north_m, east_m = self._starts_m[instance]
        latitude, longitude, altitude_m = self._world.to_global(np.array([north_m, east_m, 0.0]))
        home = [f"{latitude:.7f}", f"{longitude:.7f}"]
        if self._degrees_1e7:
            home = [str(round(latitude * 1e7)), str(round(longitude * 1e7))]
        return {
            "PX4_SIM_MODEL": "sihsim_quadx",
            "PX4_SYS_AUTOSTART": "10040",
            "PX4_HOME_LAT": home[0],
            "PX4_HOME_LON": home[1],
            "PX4_HOME_ALT": f"{altitude_m:.2f}",
        }

    def _stop_all(self) -> None:
        for process in self._processes:
            process.terminate()
        until_s = time.monotonic() + _STOP_WITHIN_S
        for process in self._processes:
            try:
                process.wait(max(0.0, until_s - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.send_signal(signal.SIGKILL)
                process.wait()
        self._stop.set()
        self._thread.join()

    # The thread that hears where the vehicles are

    def _listen(self) -> None:
        parsers: list[Any] = [mavlink.MAVLink(None) for _ in self._starts_m]
        for parser in parsers:
            parser.robust_parsing = True
        while not self._stop.is_set():
            for key, _ in self._selector.select(0.2):
                assert isinstance(key.fileobj, socket.socket)
                for message in parsers[key.data].parse_buffer(key.fileobj.recv(2048)) or ():
                    if message.get_type() == "HIL_STATE_QUATERNION":
                        self._hear(key.data, message)

    def _hear(self, instance: int, message: Any) -> None:
        north_m, east_m = self._world.to_world(message.lat * 1e-7, message.lon * 1e-7)
        place = _Place(
            time.monotonic(), (north_m, east_m, self._world.altitude_m - message.alt * 1e-3)
        )
        with self._places_lock:
            self._places[instance].append(place)


def _udp(port: int) -> socket.socket:
    udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        udp.bind(("127.0.0.1", port))
    except OSError as error:
        udp.close()
        raise OSError(
            f"UDP port {port} is taken ({error.strerror}): does another PX4 simulation run?"
        ) from None
    return udp


def _start_is_in_degrees_1e7(build: Path) -> bool:
    """Older PX4s take the start, SIH_LOC_LAT0, as an integer, and PX4_HOME_LAT as it is."""
    try:
        parameters = json.loads((build / "parameters.json").read_text())["parameters"]
        types = {parameter["name"]: parameter["type"] for parameter in parameters}
    except (OSError, ValueError, KeyError, TypeError):
        return False
    return str(types.get("SIH_LOC_LAT0", "")).lower() == "int32"
