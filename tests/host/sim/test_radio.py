"""An access point that stays away: in the mission nobody hears anybody any more, ground or robot.

The fleet flies in a network of its own, in which from some moment on every packet of TCP is lost;
vehicles are on UDP. Judged by where the vehicles truly were.
"""

import json
import math
import subprocess
import sys
from pathlib import Path

import pytest

from lpac.sim.fleet.ground import GroundProgram
from lpac.sim.fleet.processes import Fleet
from lpac.sim.px4.modes import Px4Mode
from lpac.sim.scenario import Scenario
from tests.conftest import ROOT, SHIPPED
from tests.needs import missing
from tests.process.sim.fleet_rig import FleetRig

pytestmark = pytest.mark.real_time

ROBOTS = 3
OWN_NETWORK = ("unshare", "--map-root-user", "--net", "sh", "-c")
LOSE_ALL = ("iptables", "-A", "INPUT", "-i", "lo", "-p", "tcp", "-j", "DROP")
# From the last word of the ground on: stop, and then land.
HOLDS_S, LANDS_S = 3.0, 13.0
# For braking, and what a robot looks at only now and then.
LATE_S = 2.5
# With gusts.
AT_REST_M_S = 0.35


def test_all_hold_and_land_where_they_are_if_no_radio_comes_back(tmp_path: Path) -> None:
    if in_own_network("iptables", "-L").returncode:
        pytest.skip("needs the right to make a network namespace")
    # Root's own folder of sockets is not for who is root in this network alone.
    own_folder = f"XDG_RUNTIME_DIR={tmp_path}"
    flown = in_own_network("env", own_folder, sys.executable, "-m", __name__, str(tmp_path))
    assert flown.returncode == 0, flown.stdout + flown.stderr
    for robot in range(ROBOTS):
        flight = json.loads((tmp_path / f"{robot}.json").read_text())
        # While a machine is behind, a vehicle's clock stands still, and a robot's does not.
        behind_s, truth = flight["behind_s"], flight["truth"]
        landing_s = next(entry["after_s"] for entry in truth if entry["mode"] == Px4Mode.LAND)
        assert LANDS_S - 0.5 - behind_s < landing_s < LANDS_S + LATE_S, robot
        holding = [e for e in truth if HOLDS_S + LATE_S < e["after_s"] < landing_s]
        assert max(math.hypot(*e["velocity_m_s"][:2]) for e in holding) < AT_REST_M_S, robot
        down = truth[-1]
        assert not down["armed"] and down["landed"], robot
        place_m = holding[-1]["position_m"]
        assert math.dist(place_m[:2], down["position_m"][:2]) < 2.0, robot


def in_own_network(*command_line: str) -> subprocess.CompletedProcess[str]:
    """What became of a program in a network of its own; skips without the tools for one."""
    if lacks := missing("unshare", "ip", "iptables"):
        pytest.skip(lacks)
    run = [*OWN_NETWORK, 'ip link set lo up && exec "$@"', "sh", *command_line]
    return subprocess.run(run, cwd=ROOT, capture_output=True, text=True, check=False)


def _fly(folder: Path) -> None:
    """Fly until all are down, and write what was so from the loss on, a file for each robot."""
    fleet = Fleet(Scenario(robots=ROBOTS), folder / "fleet", SHIPPED)
    assert fleet.simulated is not None
    for vehicle in fleet.simulated.vehicles:
        vehicle.parameters |= {
            "COM_SPOOLUP_TIME": 0.0, "MPC_TKO_RAMP_T": 0.0, "MPC_LAND_SPEED": 1.5,
            "COM_DISARM_LAND": 0.5,
        }  # fmt: skip
    with fleet, GroundProgram(fleet.fleet_toml, fleet.name) as ground:
        rig = FleetRig(fleet, ground)
        rig.assemble()
        rig.make_ready()
        rig.take_off()
        rig.start()
        for robot in range(ROBOTS):
            rig.wait_vehicle(robot, lambda vehicle: math.hypot(*vehicle.velocity_m_s[:2]) > 0.3)
        with rig.simulated.stepped:
            began_s = [vehicle.time_s for vehicle in rig.simulated.vehicles]
        lost_s = fleet.vehicles.lost_s()
        subprocess.run(LOSE_ALL, check=True)
        for robot in range(ROBOTS):
            # What is judged is what was written down, which is a little later than it was so.
            rig.wait_vehicle(robot, lambda v: v.truth[-1].landed and not v.truth[-1].armed)
        for robot in range(ROBOTS):
            with rig.simulated.stepped:
                entries = [e for e in rig.vehicle(robot).truth if e.time_s > began_s[robot]]
            flight = {
                "truth": [e._asdict() | {"after_s": e.time_s - began_s[robot]} for e in entries],
                "behind_s": fleet.vehicles.lost_s() - lost_s,
            }
            (folder / f"{robot}.json").write_text(json.dumps(flight))


if __name__ == "__main__":
    _fly(Path(sys.argv[1]))
