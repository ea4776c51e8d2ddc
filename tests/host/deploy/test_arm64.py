"""The release for ARM, for real: its program runs here under user-mode emulation, and flies.

Emulation says nothing of speed: no time is asserted.
"""

import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from edge.drivers.log_reader import read as read_log
from edge.messages.mission import FlightState
from edge.policy.bundle import load_bundle, write_bundle
from edge.policy.lpac.policy import LpacPolicy
from lpac.analysis.policy_replay import replay
from lpac.ground.station.protocol import SafetyCommand, Start
from tests.conftest import ROOT, SHIPPED
from tests.host.conftest import BuildImage
from tests.host.deploy.entering import inside
from tests.robot_rig import Changes, Rig, new_vehicle, program, rig
from tests.unit.export.test_module import Everything, exported

pytestmark = pytest.mark.real_time

KEYRING = Path("/usr/share/keyrings/debian-archive-keyring.gpg")
BINFMT = Path("/proc/sys/fs/binfmt_misc")
# Of ELF's head: 64 bits, little endian, a program or a library, for AArch64.
MAGIC = "7f454c460201010000000000000000000200b700"
MASK = "ffffffffffffff00fffffffffffffffffeffffff"
# A processor of the VOXL2's generation.
ENVIRONMENT = {"QEMU_CPU": "cortex-a76"}


@pytest.fixture(scope="module")
def tree(build_image: BuildImage) -> Path:
    return build_image("arm64")


@pytest.fixture(scope="module", autouse=True)
def emulated(build_image: BuildImage) -> Iterator[None]:
    """This kernel runs programs for AArch64, in whatever root directory."""
    if os.uname().machine == "aarch64":
        yield
        return
    emulator = fetch_emulator(ROOT / "out" / "qemu")
    mounted = not (BINFMT / "register").exists()
    mount = ["mount", "-t", "binfmt_misc", "none", str(BINFMT)]
    if mounted and subprocess.run(mount, check=False).returncode:
        pytest.skip("this kernel has no binfmt_misc")
    magic, mask = ("".join(f"\\x{byte:02x}" for byte in bytes.fromhex(h)) for h in (MAGIC, MASK))
    name = f"lpac-test-{os.getpid()}"
    # F: the kernel keeps the emulator open, so that it need not be in the tree.
    (BINFMT / "register").write_text(f":{name}:M::{magic}:{mask}:{emulator}:F")
    try:
        yield
    finally:
        (BINFMT / name).write_text("-1")
        if mounted:
            subprocess.run(["umount", BINFMT], check=True)


def fetch_emulator(folder: Path) -> Path:
    """qemu 10, of Debian 13: with Debian 12's onnxruntime crashes. apt checks its signature."""
    emulator = folder / "usr/bin/qemu-aarch64"
    if emulator.exists():
        return emulator
    if shutil.which("apt-get") is None or not KEYRING.exists():
        pytest.skip("needs: sudo apt install debian-archive-keyring")
    for name in ("lists/partial", "cache/archives/partial"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    (folder / "status").touch()
    sources = folder / "sources.list"
    sources.write_text(f"deb [signed-by={KEYRING}] http://deb.debian.org/debian trixie main\n")
    options = [
        f"--option={key}={value}"
        for key, value in {
            "Dir::Etc::SourceList": sources, "Dir::Etc::SourceParts": "/dev/null",
            "Dir::State::Lists": folder / "lists", "Dir::State::Status": folder / "status",
            "Dir::Cache": folder / "cache", "APT::Sandbox::User": "root",
        }.items()
    ]  # fmt: skip
    for command in ("update", "download qemu-user"):
        apt = ["apt-get", "--quiet", *options, *command.split()]
        result = subprocess.run(apt, cwd=folder, capture_output=True, text=True, check=False)
        if result.returncode:
            pytest.skip(f"qemu 10 cannot be fetched: {result.stderr.splitlines()[-1]}")
    (package,) = folder.glob("qemu-user_*.deb")
    subprocess.run(
        f"dpkg-deb --fsys-tarfile {package.name} | tar --extract ./usr/bin/qemu-aarch64",
        shell=True, cwd=folder, check=True,
    )  # fmt: skip
    package.unlink()
    shutil.rmtree(folder / "lists")
    shutil.rmtree(folder / "cache")
    return emulator


@pytest.mark.parametrize("family", ["lpac", "network"])
def test_it_computes_what_torch_computed(tree: Path, tmp_path: Path, family: str) -> None:
    """Also what another network has: attention, memory and denoising."""
    bundle = load_bundle(SHIPPED) if family == "lpac" else exported(Everything)
    tmp_path.chmod(0o755)
    write_bundle(bundle, tmp_path / "bundle")
    result = subprocess.run(
        inside(tree, tmp_path, "/usr/bin/lpac", "bundle", "verify", "/release/bundle"),
        env=os.environ | ENVIRONMENT, capture_output=True, text=True, timeout=600.0, check=False,
    )  # fmt: skip
    assert (result.returncode, result.stderr) == (0, "")
    assert "this machine computes the golden outputs" in result.stdout


def test_a_robot_flies_a_mission_with_it(
    tree: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shipped_policy: LpacPolicy
) -> None:
    """Its policy, zenoh and MAVSDK are ARM's; vehicle and operator are this machine's."""
    for name, value in ENVIRONMENT.items():
        monkeypatch.setenv(name, value)
    tmp_path.chmod(0o755)
    shutil.copytree(SHIPPED, tmp_path / "bundle")
    logs = tmp_path / "logs"
    logs.mkdir()
    os.chown(logs, 65532, 65532)
    changes: Changes = {
        "policy": {"bundle": "bundle", "max_input_age_s": 10.0},
        # The rates that an emulated core keeps.
        "rates": {"perception_hz": 1.0, "policy_hz": 1.0},
        # It stands still for seconds, now and then, and would land each time.
        "position": {"lost_after_s": 30.0},
    }
    with rig(tmp_path, new_vehicle(), changes=changes) as made:
        lpac = inside(
            tree, tmp_path, "/usr/bin/lpac", "robot", "run", "--config", "/release/robot.toml"
        )
        with program(made, lpac) as running:
            fly(made)
            assert running.end(signal.SIGTERM) == 0, running.log.read_text()
    messages = [message for path in sorted(logs.glob("*.mcap")) for message in read_log(path)]
    # The same ticks on this machine's processor; the messages are in float16.
    features, velocity, message = replay(shipped_policy, messages)
    assert velocity.ticks > 5
    assert features.largest_difference < 1e-4
    assert velocity.largest_difference < 1e-4
    assert message.largest_difference < 1e-2


def fly(made: Rig) -> None:
    """Until the mission leads it somewhere; what its late loops end begins again."""
    made.take_off()
    start_m = made.vehicle.position_m.copy()
    until_s = time.monotonic() + 400.0
    while not (
        made.vehicle_is(lambda v: abs(v.position_m - start_m)[:2].max() > 1.0, 5.0)
        and made.status.state is FlightState.MISSION
    ):
        assert time.monotonic() < until_s, made.status
        if made.status.state is FlightState.LANDED:
            made.take_off()
        elif made.status.state is FlightState.HOLD:
            # It may have begun to land just now, and refuse.
            made.command(Start())
    assert all(loop.failures == 0 for loop in made.status.loops.values())
    made.do(SafetyCommand("land"))
    made.wait_for_state(FlightState.LANDED)
    assert not made.vehicle.armed
