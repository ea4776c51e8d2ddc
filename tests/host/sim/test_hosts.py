"""Robot computers on this machine: what tests of the fleet take for granted of them."""

import os
import select
import signal
import socket
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common as mavlink

from lpac.sim.hosts.base import SUITE, NoHostsError, base_tree
from lpac.sim.hosts.host import new_key
from lpac.sim.hosts.rack import children
from tests.conftest import ROOT, SHIPPED
from tests.host.hosts import FrailHosts

CAP_SYS_TIME = 25
# ssh's options where nobody is to answer.
SOON = ("-o", "ConnectTimeout=1")

# Prints what the autopilot says, a datagram a line, until there was a heartbeat (message 0).
_LISTEN = """
import binascii, socket
udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
udp.bind(("127.0.0.1", 14551))
udp.settimeout(60)
while True:
    datagram = udp.recv(2048)
    print(binascii.hexlify(datagram).decode())
    if datagram[:1] == b"\\xfd" and datagram[7:10] == bytes(3):
        break
"""


def make(folder: Path, count: int, spares: int = 0) -> FrailHosts:
    return FrailHosts(count, folder, image=ROOT / "out/image/amd64", bundle=SHIPPED, spares=spares)


@pytest.fixture(scope="module")
def hosts(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FrailHosts]:
    with ExitStack() as stack:
        try:
            running = stack.enter_context(make(tmp_path_factory.mktemp("hosts"), 3, spares=1))
        except NoHostsError as reason:
            pytest.skip(str(reason))
        yield running


def ssh(hosts: FrailHosts, name: str, command: str, *options: str) -> tuple[int, str]:
    """Exit code, and all that was printed. Of an option given twice the first counts."""
    done = subprocess.run(
        ["ssh", "-F", hosts.ssh_config, *options, "-o", "BatchMode=yes", "-o", "ConnectTimeout=60",
         name, command],
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        check=False,
    )  # fmt: skip
    return done.returncode, done.stdout


def heartbeat(hosts: FrailHosts, index: int) -> tuple[int, bool]:
    """System id and whether it is armed, as a program on the host hears it."""
    parser = mavlink.MAVLink(None)
    said = hosts[index].run(f"python3 - <<'END'\n{_LISTEN}END")
    heard = [
        message
        for line in said.split()
        for message in parser.parse_buffer(bytes.fromhex(line))
        if message.get_type() == "HEARTBEAT"
    ]
    armed = bool(heard[-1].base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
    return heard[-1].get_srcSystem(), armed


def test_ssh_login_with_checked_host_key(hosts: FrailHosts) -> None:
    """By name and by address, as root; each host is another one under the same host name."""
    for host in hosts:
        assert ssh(hosts, host.name, "id -un; hostname") == (0, "root\nm0054\n")
    assert len({ssh(hosts, f"root@{h.address}", "cat /etc/machine-id") for h in hosts}) == 3
    assert len({host.host_key for host in hosts}) == 3


def test_wrong_keys_are_refused(hosts: FrailHosts, tmp_path: Path) -> None:
    new_key(tmp_path / "other")
    code, said = ssh(
        hosts, hosts[0].address, "true", "-o", f"IdentityFile={tmp_path / 'other'}", "-F", "none",
        "-o", f"UserKnownHostsFile={hosts.known_hosts}", "-l", "root",
    )  # fmt: skip
    assert code == 255
    assert "Permission denied" in said
    (tmp_path / "known").write_text(f"{hosts[0].address} {hosts[1].host_key}\n")
    code, said = ssh(hosts, "r1", "true", "-o", f"UserKnownHostsFile={tmp_path / 'known'}")
    assert code == 255
    assert "Host key verification failed" in said


def test_is_like_the_robots_computer(hosts: FrailHosts) -> None:
    if not base_tree(lambda _: None).name.startswith(SUITE):
        pytest.skip("Ubuntu's archive was not there: the hosts run Debian")
    assert hosts[0].run("python3 --version") == "Python 3.6.9\n"
    assert "systemd 237" in hosts[0].run("systemctl --version")
    assert "OpenSSH_7.6" in ssh(hosts, "r1", "ssh -V")[1]
    assert "version 3.1.2" in hosts[0].run("rsync --version")
    assert hosts[0].run("systemctl is-system-running") == "running\n"


def test_run_leaves_the_command_to_the_shell(hosts: FrailHosts) -> None:
    command = "x=1; echo $x ${x} \"$HOME\" $(pwd) '%n $$' | cat; echo >&2 left out"
    assert hosts[0].run(command) == "1 1 /root /root %n $$\n"
    with pytest.raises(RuntimeError, match=r"r1: 'ls /none; exit 3' returned 3: .*No such file"):
        hosts[0].run("ls /none; exit 3")


def test_hosts_cannot_set_the_clock_of_this_machine(hosts: FrailHosts) -> None:
    """They share it: nothing that is run on them has the capability."""
    command = "sed -n 's/^CapBnd:[[:space:]]*//p' /proc/self/status"
    for capabilities in (hosts[0].run(command), ssh(hosts, "r1", command)[1]):
        assert int(capabilities, 16) >> CAP_SYS_TIME & 1 == 0


def test_vehicle_speaks_at_the_usual_place(hosts: FrailHosts) -> None:
    for index in (0, 1):
        assert heartbeat(hosts, index) == (index + 1, False)
    with hosts[0].stepped:
        hosts[0].vehicle.parameters["COM_DISARM_PRFLT"] = 0.0  # It stays armed.
        hosts[0].vehicle.arm(force=True)
    assert heartbeat(hosts, 0) == (1, True)
    assert heartbeat(hosts, 1) == (2, False)


def test_hosts_hear_each_other_until_the_network_is_cut(hosts: FrailHosts) -> None:
    ping = f"ping -c 1 -W 30 {hosts[1].address}"
    assert "1 received" in hosts[0].run(ping)
    hosts[1].cut()
    with pytest.raises(RuntimeError, match="0 received"):
        hosts[0].run(f"ping -c 1 -W 1 {hosts[1].address}")
    assert ssh(hosts, "r2", "true", *SOON)[0] == 255
    assert hosts[1].run("echo still there") == "still there\n"
    hosts[1].heal()
    assert "1 received" in hosts[0].run(ping)
    assert ssh(hosts, "r2", "true")[0] == 0


def test_power_loss_keeps_the_disk_and_the_parameters(hosts: FrailHosts) -> None:
    host = hosts[0]
    before = host.run("echo kept >/root/note; sleep 1000 >/dev/null 2>&1 & cat /etc/machine-id")
    boot = host.run("cat /proc/sys/kernel/random/boot_id")
    with host.stepped:
        host.vehicle.parameters["MAV_SYS_ID"] = 77
    host.power_off()
    assert (host.root / "root/note").read_text() == "kept\n"
    assert ssh(hosts, "r1", "true", *SOON)[0] == 255
    with pytest.raises(RuntimeError, match="r1 is off"):
        host.run("true")
    host.power_on()
    assert ssh(hosts, "r1", "cat note /etc/machine-id") == (0, f"kept\n{before}")
    assert host.run("cat /proc/sys/kernel/random/boot_id") != boot
    assert "sleep 1000" not in host.run("ps ax -o args | grep -v grep")
    assert heartbeat(hosts, 0) == (77, False)


def test_reset_gives_a_new_disk_to_the_same_host(hosts: FrailHosts) -> None:
    host = hosts[0]
    before = host.run("touch /root/mine; cat /etc/machine-id")
    host.cut()
    host.reset()
    assert ssh(hosts, "r1", "ls; cat /etc/machine-id") == (0, before)
    assert heartbeat(hosts, 0) == (1, False)


def test_full_disk(hosts: FrailHosts) -> None:
    write = "dd if=/dev/zero of=/opt/block bs=1M count=1"
    hosts[0].fill_disk()
    with pytest.raises(RuntimeError, match="No space left on device"):
        hosts[0].run(write)
    hosts[1].run(write)
    hosts[0].free_disk()
    hosts[0].run(write)


def test_fleet_toml_describes_the_hosts(hosts: FrailHosts) -> None:
    fleet = tomllib.loads(hosts.fleet_toml.read_text())
    assert {name: table["host"] for name, table in fleet["robots"].items()} == {
        host.name: host.address for host in hosts
    }
    assert [slot["robot"] for slot in fleet["slots"]] == ["r1", "r2"]
    assert all((hosts.folder / p).exists() for p in (fleet["ssh"]["config"], fleet["world"]))


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_hosts_go_when_their_program_does(
    hosts: FrailHosts, tmp_path: Path, number: signal.Signals
) -> None:
    """However it ends; those of another program stay."""
    with (
        subprocess.Popen(
            [sys.executable, "-m", "lpac.cli.main", "hosts", "-n", "1", "--out", tmp_path / "out"],
            cwd=ROOT, stdout=subprocess.PIPE, text=True, process_group=0,
        ) as program,
        ExitStack() as stack,
    ):  # fmt: skip
        stack.callback(program.kill)
        assert program.stdout
        address = next(line for line in program.stdout if " is up at " in line).split()[-1]
        assert address != hosts[0].address
        assert _answers(address)
        held = [os.pidfd_open(pid) for pid in children(program.pid)]
        program.send_signal(number)
        program.stdout.read()
        assert program.wait() == (0 if number is not signal.SIGKILL else -number)
    for descriptor in held:
        assert select.select([descriptor], [], [], 60)[0]
        os.close(descriptor)
    assert not _answers(address, within_s=1.0)
    assert _answers(hosts[0].address)


def _answers(address: str, within_s: float = 60.0) -> bool:
    try:
        with socket.create_connection((address, 22), timeout=within_s) as connection:
            return connection.recv(4) == b"SSH-"
    except OSError:
        return False


def test_needs_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="spares = 2: must be from 0 to 1"):
        make(tmp_path, 2, spares=2)
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(NoHostsError, match="sudo apt install systemd-container mmdebstrap"):
        make(tmp_path, 2)
