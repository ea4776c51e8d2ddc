"""The launcher of real PX4s, with a stand-in that takes the same arguments on the same ports."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from sim.px4.world import WorldOrigin
from sim.px4_build import Px4Build
from tests.cli.test_cli import error_line, lpac
from tests.conftest import ROOT

STAND_IN = f"""#!{sys.executable}
import argparse, os, signal, socket, sys, threading, time
sys.path.insert(0, {str(ROOT)!r})
from pathlib import Path
from pymavlink.dialects.v20 import common as mavlink
from sim.px4.link import Px4Link
from sim.px4.server import Instance, Px4Server
from sim.px4.vehicle import Px4Vehicle
from sim.px4.world import WorldOrigin

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
vehicle.gps_bias_m = vehicle.gps_bias_m * 0.0
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
    (folder / "etc" / "init.d-posix").mkdir(parents=True)
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


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--px4", "absent"], "there is no such folder"),
        (["--px4", "docs"], "has no program bin/px4"),
        ([], "--vehicle px4 needs --px4"),
    ],
)
def test_a_wrong_build_folder_is_named(arguments: list[str], text: str) -> None:
    assert text in error_line(lpac("sim", "--vehicle", "px4", "-n", 2, *arguments))


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
