"""Robot computers on this machine: each boots its own systemd and sshd, and has a simulated PX4.

To software a host is like a VOXL2: Ubuntu 18.04, its own disk, an address in a network shared with
the other hosts and this machine, MAVLink at 127.0.0.1:14551. Differences: it uses this machine's
kernel and clock, which cannot be set, and memory limits are not enforced.
"""

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Self

import numpy as np

from lpac.analysis.worlds import format_world, random_features
from lpac.fleet.writer import write_fleet
from lpac.sim.description import FIELD_SCALE, fence_around, robot_table
from lpac.sim.hosts.base import base_tree, require_tools
from lpac.sim.hosts.host import MAVLINK_PORT, SimulatedHost, new_key
from lpac.sim.hosts.rack import Rack

MAX_HOSTS = 20
FIELD_M = 32.0
_MAX_SPEED_M_S = 1.25

Report = Callable[[str], None]


class SimulatedHosts:
    """A context in which hosts r1, r2, ... run, the last `spares` of them without a slot.

    `folder` then holds `fleet_toml`, a complete description of them for `lpac fleet`, with
    ssh_config, keys and world.env next to it. `fleet` is a name that no other running hosts use.
    """

    host_type = SimulatedHost

    def __init__(
        self,
        count: int,
        folder: Path,
        *,
        image: Path,
        bundle: Path,
        spares: int = 0,
        report: Report = lambda _: None,
    ) -> None:
        """Start nothing yet. `image` and `bundle` are written to fleet.toml, but not read.

        Raises NoHostsError (a ValueError) if this machine cannot run robot hosts, ValueError for
        an invalid number.
        """
        if not 1 <= count <= MAX_HOSTS:
            raise ValueError(f"hosts = {count}: must be from 1 to {MAX_HOSTS}")
        if not 0 <= spares < count:
            raise ValueError(f"spares = {spares}: must be from 0 to {count - 1}")
        require_tools()
        self.folder = folder.resolve()
        self.fleet_toml = self.folder / "fleet.toml"
        self.ssh_config = self.folder / "ssh_config"
        self.known_hosts = self.folder / "known_hosts"
        self.fleet = ""
        self._count, self._spares = count, spares
        self._image, self._bundle = image.resolve(), bundle.resolve()
        self._report = report
        self._hosts: list[SimulatedHost] = []
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        """Boot all. Raises NoHostsError as above, OSError if a host does not boot."""
        self.folder.mkdir(parents=True, exist_ok=True)
        # Keys of earlier hosts.
        shutil.rmtree(self.folder / "keys", ignore_errors=True)
        base = base_tree(self._report)
        with ExitStack() as stack:
            stack.callback(self._await_ends)
            rack = stack.enter_context(Rack(base))
            self.fleet = f"hosts-{rack.number}-{os.getpid()}"
            key = new_key(self.folder / "id_ed25519")
            self._hosts = [
                self.host_type(rack, self.folder, robot_id, key)
                for robot_id in range(1, self._count + 1)
            ]
            for host in self._hosts:
                stack.callback(host.stop_vehicle)
                host.format()
                host.switch_on()
            self._write_files()
            for host in self._hosts:
                host.await_boot()
                self._report(f"{host.name} is up at {host.address}")
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def __iter__(self) -> Iterator[SimulatedHost]:
        return iter(self._hosts)

    def __getitem__(self, index: int) -> SimulatedHost:
        return self._hosts[index]

    def _await_ends(self) -> None:
        for host in self._hosts:
            host.await_end()

    def _write_files(self) -> None:
        world_size = round(FIELD_M * FIELD_SCALE.env_scale)
        features = random_features(np.random.default_rng(0), 10, world_size)
        (self.folder / "world.env").write_text(format_world(features))
        self.known_hosts.write_text(
            "".join(f"{host.address} {host.host_key}\n" for host in self._hosts)
        )
        self.ssh_config.write_text(
            "".join(f"Host {host.name}\n  HostName {host.address}\n" for host in self._hosts)
            + "Host *\n"
            f'  IdentityFile "{self.folder / "id_ed25519"}"\n'
            "  IdentitiesOnly yes\n"
            f'  UserKnownHostsFile "{self.known_hosts}"\n'
            "  GlobalKnownHostsFile /dev/null\n"
            "  StrictHostKeyChecking yes\n"
        )
        write_fleet(
            self.fleet_toml,
            "Made by `lpac hosts`, of computers on this machine.",
            self._description(),
        )

    def _description(self) -> dict[str, object]:
        """fleet.toml."""
        flying = self._hosts[: self._count - self._spares]
        robot = robot_table(fence_around(FIELD_M, len(flying)), _MAX_SPEED_M_S)
        return {
            "fleet": self.fleet,
            "image": str(self._image),
            "bundle": str(self._bundle),
            "world": "world.env",
            "keys": "keys",
            "ssh": {"config": "ssh_config"},
            "robot": robot | {"autopilot": {"url": f"udpin://127.0.0.1:{MAVLINK_PORT}"}},
            "robots": {
                host.name: {"host": host.address, "robot_id": host.robot_id} for host in self._hosts
            },
            "slots": [
                {
                    "robot": host.name,
                    "pad_m": list(host.pad_m),
                    "landing_point_m": list(host.pad_m),
                }
                for host in flying
            ],
        }
