"""The launcher of real PX4s, with a stand-in that takes the same arguments on the same ports.

A real one is flown by `lpac drill --vehicle px4 --px4 DIR`.
"""

import fcntl
import json
import os
import platform
import re
import select
import shutil
import signal
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from lpac.sim.fleet.vehicles import VehicleError
from lpac.sim.px4.world import WorldOrigin
from lpac.sim.sitl import ordinary
from lpac.sim.sitl.build import Px4Build, _require_alone
from lpac.sim.sitl.log import read_setpoints, read_truth
from tests.command import error_line, lpac
from tests.conftest import ROOT
from tests.process.sim.test_fleet import launched, pid_of, read_until
from tests.ulog import HEADER, message

pytestmark = pytest.mark.real_time

STAND_IN = f"""#!{sys.executable}
import argparse, os, signal, socket, sys, threading, time
sys.path.insert(0, {str(ROOT)!r})
from pathlib import Path
from pymavlink.dialects.v20 import common as mavlink
from lpac.sim.px4.link import Px4Link
from lpac.sim.px4.server import Instance, Px4Server
from lpac.sim.px4.vehicle import Px4Vehicle
from lpac.sim.px4.world import WorldOrigin

parser = argparse.ArgumentParser()
parser.add_argument("-i", type=int, required=True)
parser.add_argument("-d", action="store_true")
parser.add_argument("data", type=Path)
arguments = parser.parse_args()
i = arguments.i
assert (arguments.data / "init.d-posix" / "rcS").exists()
assert os.environ["PX4_SIM_MODEL"] == "sihsim_quadx"
assert Path.cwd().name == str(i)
world = WorldOrigin()
start_m = world.to_world(float(os.environ["PX4_HOME_LAT"]), float(os.environ["PX4_HOME_LON"]))
vehicle = Px4Vehicle(seed=i, start_m=start_m, origin=world)
vehicle.gps_bias_m = (0.0, 0.0, 0.0)
stop = threading.Event()
signal.signal(signal.SIGTERM, lambda *_: stop.set())
to_display = mavlink.MAVLink(None, srcSystem=i + 1)
display = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
print("stand-in runs", flush=True)
with Px4Server([Instance(Px4Link(vehicle, system_id=i + 1), 14580 + i, 14540 + i)]) as server:
    while not stop.wait(0.04):
        with server.stepped:
            latitude, longitude, altitude_m = world.to_global(vehicle.position_m)
        message = mavlink.MAVLink_hil_state_quaternion_message(
            0, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0, round(latitude * 1e7), round(longitude * 1e7),
            round(altitude_m * 1e3), 0, 0, 0, 0, 0, 0, 0, 0,
        )
        display.sendto(message.pack(to_display), ("127.0.0.1", 19410 + i))
Path("ended").touch()
"""


@pytest.fixture
def build(tmp_path: Path) -> Path:
    """A build folder whose bin/px4 is the stand-in."""
    folder = tmp_path / "px4_sitl_default"
    (folder / "bin").mkdir(parents=True)
    (folder / "etc" / "init.d-posix" / "airframes").mkdir(parents=True)
    (folder / "etc" / "init.d-posix" / "airframes" / "10040_sihsim_quadx").touch()
    (folder / "etc" / "init.d-posix" / "rcS").touch()
    (folder / "bin" / "px4").write_text(STAND_IN)
    (folder / "bin" / "px4").chmod(0o755)
    return folder


def test_two_robots_fly_px4s_of_a_build(build: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = lpac(
        "sim", "--vehicle", "px4", "--px4", build, "-n", 2, "--duration", 3, "--json", "--out", out
    )
    assert result.returncode == 0, result.stderr
    flight = json.loads(result.stdout)
    assert flight["vehicle"] == "px4" and flight["all_landed"] and flight["problem"] is None
    # What the vehicles' own model tells agrees with what they estimate.
    assert flight["true_cost"]["final"] == pytest.approx(flight["cost"]["final"], rel=0.1)
    assert flight["separation"]["distance_m"] > 1.5
    for instance in (0, 1):
        assert "stand-in runs" in (out / "px4" / str(instance) / "px4.log").read_text()
        assert (out / "px4" / str(instance) / "ended").exists()


def elf(machine: int) -> bytes:
    """The beginning of a program for a processor."""
    return b"\x7fELF\x02\x01\x01" + bytes(9) + struct.pack("<HH", 3, machine) + bytes(64)


OTHER_MACHINE = 62 if platform.machine() != "x86_64" else 183


def as_a_file(build: Path) -> None:
    shutil.rmtree(build)
    build.touch()


@pytest.mark.parametrize(
    ("spoil", "text"),
    [
        (shutil.rmtree, "there is no such folder"),
        (as_a_file, "is no folder: give the folder"),
        (lambda b: (b / "bin" / "px4").unlink(), "has no program bin/px4: give the folder"),
        (
            lambda b: ((b / "bin" / "px4").unlink(), (b / "ROMFS").mkdir()),
            "is PX4's source, not built: run `make px4_sitl` in it",
        ),
        (
            lambda b: ((b / "build").mkdir(), (b / "bin").rename(b / "x"), (b / "x").chmod(0o755),
                       (b / "build" / "sitl").mkdir(), (b / "x").rename(b / "build/sitl/bin")),
            "is PX4's source, not its build: give ",
        ),
        (lambda b: (b / "bin" / "px4").chmod(0o644), "bin/px4 is not executable"),
        (lambda b: (b / "bin" / "px4").write_bytes(elf(OTHER_MACHINE)), "and this machine is"),
        (lambda b: shutil.rmtree(b / "etc"), "has no etc/init.d-posix/rcS"),
        (
            lambda b: shutil.rmtree(b / "etc" / "init.d-posix" / "airframes"),
            "has no airframe 10040_sihsim_quadx",
        ),
    ],
)  # fmt: skip
def test_a_wrong_build_folder_is_named(
    build: Path, tmp_path: Path, spoil: Callable[[Path], object], text: str
) -> None:
    spoil(build)
    with pytest.raises(ValueError, match=re.escape(text)) as raised:
        Px4Build(build, [(0.0, 0.0)], WorldOrigin(), tmp_path / "px4")
    assert str(raised.value).startswith(f"--px4 {build}: ")


def test_what_is_wrong_with_the_build_is_one_line() -> None:
    assert "--vehicle px4 needs --px4" in error_line(lpac("sim", "--vehicle", "px4", "-n", 2))
    line = error_line(lpac("sim", "--vehicle", "px4", "--px4", "docs", "-n", 2))
    assert "has no program bin/px4" in line


def test_a_path_with_a_space_is_refused(build: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="PX4 does not take spaces in paths"):
        Px4Build(build, [(0.0, 0.0)], WorldOrigin(), tmp_path / "a flight")


def test_a_px4_that_still_runs_is_named() -> None:
    """By its lock, which PX4 holds for as long as it runs."""
    number = 90 + os.getpid() % 1000
    path = Path(f"/tmp/px4_lock-{number}")
    path.touch()
    try:
        _require_alone(number)
        with path.open("r+b") as file:
            fcntl.lockf(file, fcntl.LOCK_EX)
            # Of one's own lock nobody is told.
            told = subprocess.run(
                [sys.executable, "-c",
                 f"from lpac.sim.sitl.build import _require_alone; _require_alone({number})"],
                cwd=ROOT, capture_output=True, text=True, check=False,
            )  # fmt: skip
        assert f"another PX4 runs as instance {number}, perhaps an old one" in told.stderr
        assert f"end it: kill {os.getpid()}" in told.stderr
    finally:
        path.unlink()


def test_a_port_that_is_taken_is_named(build: Path, tmp_path: Path) -> None:
    with (
        Px4Build(build, [(0.0, 0.0)], WorldOrigin(), tmp_path / "first"),
        pytest.raises(VehicleError, match=r"UDP port \d+ is taken .*: end the PX4 simulation"),
        Px4Build(build, [(0.0, 0.0)], WorldOrigin(), tmp_path / "second"),
    ):
        pass


def test_a_px4_that_ends_is_told_with_its_last_words(build: Path, tmp_path: Path) -> None:
    (build / "bin" / "px4").write_text(
        "#!/bin/sh\necho 'ERROR [param] Parameter A not found.'\n"
        "echo '\033[31mERROR [init] Unknown model\033[0m'\n"
        "echo 'ERROR [px4] Startup script returned with return value: 256'\nexit 3\n"
    )
    with Px4Build(build, [(0.0, 0.0)], WorldOrigin(), tmp_path / "px4") as vehicles:
        os.waitid(os.P_PID, vehicles.pids()[0], os.WEXITED | os.WNOWAIT)
        with pytest.raises(VehicleError) as raised:
            vehicles.require_running()
    log = tmp_path / "px4" / "0" / "px4.log"
    assert str(raised.value) == (
        f"the PX4 of r0 has ended, exit code 3: ERROR [init] Unknown model (see {log})"
    )


def test_a_px4_that_is_killed_ends_the_flight_with_that_line(build: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with launched("-n", 2, "--px4", build, "--out", out, vehicle="px4") as process:
        read_until(process.stderr, r" s  preflight$")
        os.kill(pid_of(f"{build}/bin/px4\0-i\0001\0"), signal.SIGKILL)
        output, rest = process.communicate(timeout=120.0)
    assert process.returncode == 1
    first, problem, *_ = output.splitlines()
    assert first.endswith("nobody took off")
    assert problem.startswith("PROBLEM: the PX4 of r1 has ended, by SIGKILL: ")
    assert "power" not in rest


def test_a_px4_ends_with_whoever_started_it(build: Path, tmp_path: Path) -> None:
    start = (
        "import sys, time; from pathlib import Path\n"
        "from lpac.sim.px4.world import WorldOrigin; from lpac.sim.sitl.build import Px4Build\n"
        "build, out = map(Path, sys.argv[1:])\n"
        "with Px4Build(build, [(0.0, 0.0)], WorldOrigin(), out) as vehicles:\n"
        "    print(vehicles.pids()[0], flush=True); time.sleep(60.0)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", start, build, tmp_path / "px4"],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
    ) as launcher:
        assert launcher.stdout is not None
        px4 = os.pidfd_open(int(launcher.stdout.readline()))
        launcher.kill()
    ended, _, _ = select.select([px4], [], [], 60.0)
    assert ended == [px4]


def test_a_px4_has_no_real_time_priority() -> None:
    told = subprocess.run(
        [sys.executable, "-I", ordinary.__file__, str(os.getpid()), "/bin/cat", "/proc/self/status",
         "/proc/self/limits"],
        capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    (capabilities,) = re.findall(r"CapEff:\s+(\w+)", told)
    assert not int(capabilities, 16) & (1 << 23)
    assert re.search(r"Max realtime priority\s+0\s+0\s", told)


def test_a_log_tells_where_the_vehicle_really_was(tmp_path: Path) -> None:
    world = WorldOrigin()
    latitude, longitude, _ = world.to_global(np.array([3.0, -4.0, 0.0]))
    log = tmp_path / "flight.ulg"
    log.write_bytes(
        HEADER
        + message("B", bytes(40))
        + message("F", b"vehicle_local_position_groundtruth:uint64_t timestamp;double ref_lat;"
                  b"double ref_lon;float x;float y;float z;float vx;float vy;float vz;")
        + message("F", b"offboard_control_mode:uint64_t timestamp;uint8_t position;"
                  b"uint8_t velocity;")
        + message("F", b"vehicle_status:uint64_t timestamp;uint8_t nav_state;uint8_t arming_state;")
        + message("F", b"vehicle_local_position:uint64_t timestamp;float vx;float vy;")
        + message("A", struct.pack("<BH", 0, 0) + b"vehicle_local_position_groundtruth")
        + message("A", struct.pack("<BH", 0, 1) + b"vehicle_status")
        + message("A", struct.pack("<BH", 0, 2) + b"offboard_control_mode")
        + message("A", struct.pack("<BH", 0, 3) + b"vehicle_local_position")
        + message("D", struct.pack("<HQBB", 2, 1_200_000, 0, 1))
        + message("D", struct.pack("<HQBB", 2, 1_100_000, 1, 0))
        + message("D", struct.pack("<HQBB", 1, 500_000, 4, 1))
        + message("D", struct.pack("<HQff", 3, 0, 0.5, 0.0))
        + message("D", struct.pack("<HQff", 3, 2_000_000, 0.9, 0.3))
        + b"".join(
            message("D", struct.pack("<HQdd6f", 0, 1_000_000 * i, latitude, longitude,
                                     1.0 * i, 0.0, -2.0 * i, 0.5, 0.0, -1.0))
            for i in range(3)
        )
        + message("D", struct.pack("<HQBB", 1, 1_500_000, 14, 2))
        # Killed while it wrote.
        + message("D", bytes(60))[:20]
    )  # fmt: skip
    truth = read_truth([log], world)
    assert truth is not None
    np.testing.assert_allclose(truth.time_s, [0.0, 1.0, 2.0])
    np.testing.assert_allclose(truth.position_m, [[3, -4, 0], [4, -4, -2], [5, -4, -4]], atol=0.01)
    np.testing.assert_allclose(truth.velocity_m_s, [[0.5, 0.0, -1.0]] * 3)
    np.testing.assert_allclose(truth.velocity_error_m_s, [0.0, 0.25, 0.5], atol=1e-6)
    assert truth.status_s.tolist() == [0.5, 1.5]
    assert truth.navigation_state.tolist() == [4, 14] and truth.armed.tolist() == [False, True]
    setpoints = read_setpoints([log])
    np.testing.assert_allclose(setpoints.time_s, [1.1, 1.2])
    assert setpoints.is_velocity.tolist() == [False, True]
    (tmp_path / "torn.ulg").write_bytes(b"ULog")
    assert read_truth([tmp_path / "torn.ulg"], world) is None


def test_more_instances_than_ports_are_refused(build: Path) -> None:
    line = error_line(lpac("sim", "--vehicle", "px4", "--px4", build, "-n", 11))
    assert "robots = 11: must be from 1 to 10 with --vehicle px4" in line


@pytest.mark.parametrize(
    ("kind", "latitude"), [("Int32", "400000000"), ("Float", "40.0000000"), (None, "40.0000000")]
)
def test_the_start_is_told_in_the_unit_of_that_px4(
    build: Path, tmp_path: Path, kind: str | None, latitude: str
) -> None:
    if kind is not None:
        parameters = {"parameters": [{"name": "SIH_LOC_LAT0", "type": kind}]}
        (build / "parameters.json").write_text(json.dumps(parameters))
    program = build / "bin" / "px4"
    environment = tmp_path / "environment"
    os.mkfifo(environment)
    program.write_text(f"#!/bin/sh\nenv > {environment}\nexec sleep 60\n")
    world = WorldOrigin(latitude_deg=40.0, longitude_deg=-75.0, altitude_m=12.0)
    with Px4Build(build, [(0.0, 0.0)], world, tmp_path / "px4"):
        # All of it, once the program has written it.
        told = subprocess.run(
            ["cat", environment], capture_output=True, text=True, check=True, timeout=60
        )
    lines = told.stdout.split("\n")
    assert f"PX4_HOME_LAT={latitude}" in lines and "PX4_HOME_ALT=12.00" in lines
    assert os.environ.get("PX4_HOME_LAT") is None
