"""One robot's computer on this machine, with a simulated PX4."""

import contextlib
import math
import socket
import subprocess
import threading
import time
import uuid
from pathlib import Path

import numpy as np

from lpac.sim.fleet.layout import ORIGIN, WORLD
from lpac.sim.hosts.rack import Rack
from lpac.sim.px4.link import Px4Link
from lpac.sim.px4.server import Instance, Px4Server
from lpac.sim.px4.vector import ZERO
from lpac.sim.px4.vehicle import Px4Vehicle

# Three releases of an image fit.
DISK_MB = 640
BOOT_WITHIN_S = 60.0
MAVLINK_PORT = 14551

_PADS_APART_M = 8.0
_PADS_IN_ROW = 5
_PX4_PORT = 14550
_BOARD_UID = 0x4D30303534  # the same on all boards

# In the rack: name, address with prefix, MAC address.
_WIRE = """
ip netns add "$1"
ip -n "$1" link set lo up
ip -n "$1" link add wlan0 address "$3" type veth peer name "$1" netns air
ip -n "$1" address add "$2" dev wlan0
ip -n "$1" link set wlan0 up
ip -n air link set "$1" master bridge up
"""
_FORMAT = """
cd /run
! mountpoint -q "$1/root" || umount "$1/root"
! mountpoint -q "$1" || umount "$1"
mkdir -p "$1"
mount -t tmpfs -o "size=$2m,mode=755" "$1" "$1"
cd "$1"
mkdir upper work root
mount -t overlay -o "lowerdir=/run/base,upperdir=upper,workdir=work" "$1" root
"""


class SimulatedHost:
    """One robot's computer and vehicle; `SimulatedHosts` makes it.

    `vehicle` is its PX4, a new object each time the host is switched on. Hold `stepped` to command
    it or to set more than one of its fields.
    """

    def __init__(self, rack: Rack, folder: Path, robot_id: int, key: str) -> None:
        self.robot_id = robot_id
        self.name = f"r{robot_id}"
        self.address = str(rack.network[10 + robot_id])
        self.pad_m = (
            _PADS_APART_M * ((robot_id - 1) % _PADS_IN_ROW),
            _PADS_APART_M * (0.5 + (robot_id - 1) // _PADS_IN_ROW),
        )
        self._rack = rack
        self._console = folder / f"{self.name}.console"
        private = folder / f"{self.name}.host_key"
        self.host_key = new_key(private)
        # Path -> mode and text of the files that differ between hosts.
        self._files = {
            "etc/machine-id": (0o444, uuid.uuid4().hex + "\n"),
            "etc/ssh/ssh_host_ed25519_key": (0o600, private.read_text()),
            "etc/ssh/ssh_host_ed25519_key.pub": (0o644, self.host_key + "\n"),
            "root/.ssh/authorized_keys": (0o600, key + "\n"),
        }
        private.unlink()
        self._process: subprocess.Popen[bytes] | None = None
        self._booting: socket.socket | None = None
        self._server: Px4Server | None = None
        self._parameters: dict[str, int | float] = {"MAV_SYS_ID": robot_id}
        self.vehicle = self._new_vehicle()

    @property
    def root(self) -> Path:
        """Its disk as seen from this machine, also while it is off."""
        return self._rack.path(f"run/{self.name}/root")

    @property
    def stepped(self) -> threading.Condition:
        """Condition of the vehicle's steps. Raises RuntimeError while the host is off."""
        if self._server is None:
            raise RuntimeError(f"{self.name} is off")
        return self._server.stepped

    def format(self) -> None:
        """Give it a new disk, while it is off."""
        self._rack.sh(_FORMAT, self.name, str(DISK_MB))
        for path, (mode, text) in self._files.items():
            file = self.root / path
            file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            file.unlink(missing_ok=True)
            file.touch(mode)
            file.write_text(text)

    def switch_on(self) -> None:
        """Start the vehicle, and begin to boot."""
        self._rack.sh(
            _WIRE, self.name, f"{self.address}/{self._rack.network.prefixlen}",
            f"02:00:00:00:{self._rack.number:02x}:{self.robot_id:02x}",
        )  # fmt: skip
        self.vehicle = self._new_vehicle()
        link = Px4Link(
            self.vehicle,
            system_id=int(self._parameters["MAV_SYS_ID"]),
            hardware_uid=_BOARD_UID,
        )
        server = Px4Server([Instance(link, _PX4_PORT, MAVLINK_PORT)])
        with self._rack.in_network(self.name):
            self._server = server.__enter__()
        self._booting = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        machine = f"lpac-{self._rack.number}-{self.name}"
        self._booting.bind(f"\0{machine}")
        self._process = self._rack.start(
            self.name, self._console,
            "env", f"NOTIFY_SOCKET=@{machine}",
            "systemd-nspawn", "--quiet", "--boot", "--notify-ready=yes", "--register=no",
            "--keep-unit", "--link-journal=no", "--resolv-conf=off", "--timezone=off",
            "--console=pipe", f"--machine={machine}", "--hostname=m0054",
            f"--network-namespace-path=/run/netns/{self.name}",
            f"--directory=/run/{self.name}/root",
        )  # fmt: skip

    def await_boot(self) -> None:
        """Wait until the system is up. Raises OSError if it does not boot."""
        assert self._booting and self._process
        until_s = time.monotonic() + BOOT_WITHIN_S
        with self._booting:
            self._booting.settimeout(0.5)
            while time.monotonic() < until_s and self._process.poll() is None:
                with contextlib.suppress(TimeoutError):
                    if "READY=1" in self._booting.recv(4096).decode().split("\n"):
                        return
        raise OSError(f"{self.name} does not boot: see {self._console}")

    def stop_vehicle(self) -> None:
        """End the PX4."""
        if self._server is not None:
            self._server.__exit__(None, None, None)
            self._server = None

    def await_end(self) -> None:
        """Wait for the end of the killed system."""
        if self._process is not None:
            self._process.wait()
            self._process = None
        if self._booting is not None:
            self._booting.close()

    def _new_vehicle(self) -> Px4Vehicle:
        to_mission = ORIGIN.frame().relative_to(WORLD.latitude_deg, WORLD.longitude_deg)
        place_m = np.array([*self.pad_m, 0.0])
        north_m, east_m, _ = to_mission.mission_to_local(place_m).tolist()
        vehicle = Px4Vehicle(
            seed=self.robot_id, start_m=(north_m, east_m), heading_rad=math.radians(
                ORIGIN.heading_deg), origin=WORLD,
        )  # fmt: skip
        vehicle.gps_bias_m = ZERO
        vehicle.parameters.update(self._parameters)
        return vehicle


def new_key(private: Path) -> str:
    """Make an SSH key pair; returns the public key, as in authorized_keys."""
    public = private.with_name(f"{private.name}.pub")
    private.unlink(missing_ok=True)
    public.unlink(missing_ok=True)
    subprocess.run(
        ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", "lpac", "-f", str(private)],
        stdin=subprocess.DEVNULL,
        check=True,
    )
    return " ".join(public.read_text().split()[:2])
