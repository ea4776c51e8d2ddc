"""`lpac fleet enroll` on a real robot computer: from a password to a vehicle that is set up."""

import json
import subprocess
import textwrap
from pathlib import Path

import pytest

from lpac.fleet.enroll import _robot
from lpac.fleet.release import load_image
from lpac.fleet.settings import load_fleet
from tests.conftest import ROOT
from tests.host.fleet.field import armed, give_image, lpac_fleet
from tests.host.hosts import FrailHost, FrailHosts
from tests.needs import needs

EXAMPLE = ROOT / "docs" / "fleet.toml"
PASSWORD = "voxl-password"
STEPS = (
    "key", "enroll.toml", "robot id", "vision-hub", "predecessors", "release", "PX4",
)  # fmt: skip
SO_ALREADY, LEFT = "was so already", "left to do"

# A container engine as far as enrolling uses it: two containers that run; what it is told is kept.
DOCKER = """\
#!/usr/bin/python3
import json, os, sys
path = "/var/lib/docker.json"
if not os.path.exists(path):
    one = {"Config": {"Image": "lab/ros2"}, "State": {"Running": True}}
    host = {"NetworkMode": "host", "RestartPolicy": {"Name": "always"}}
    json.dump({n: dict(one, Name="/" + n, HostConfig=host) for n in ("old_stack", "camera")},
              open(path, "w"))
state = json.load(open(path))
command, *rest = sys.argv[1:]
if command == "ps":
    print("\\n".join(state))
elif command == "inspect":
    print(json.dumps([state[name] for name in rest]))
elif command == "update":
    assert rest[0] == "--restart=no"
    state[rest[1]]["HostConfig"]["RestartPolicy"]["Name"] = "no"
elif command == "stop":
    state[rest[0]]["State"]["Running"] = False
else:
    sys.exit("unknown")
json.dump(state, open(path, "w"))
"""
UNIT = "[Service]\nExecStart=/bin/sleep infinity\n[Install]\nWantedBy=multi-user.target\n"


@pytest.fixture
def new(hosts: FrailHosts) -> FrailHost:
    """r4 as it came: only a password lets in, and the fleet of `fleet_file` does not know it."""
    host = hosts[3]
    host.reset()
    return host


@pytest.fixture
def fleet_file(hosts: FrailHosts, tmp_path: Path) -> Path:
    """The fleet without r4, with predecessors; ssh asks about unknown hosts, as is its default."""
    text = hosts.fleet_toml.read_text()
    before, _, after = text.partition("\n[robots.r4]\n")
    text = before + after[after.index("\n[[slots]]") :]
    text = text.replace('config = "ssh_config"', f'config = "{tmp_path}/ssh_config"')
    text = text.replace('world = "world.env"', f'world = "{hosts.folder}/world.env"')
    (tmp_path / "ssh_config").write_text(
        f'Host *\n  IdentityFile "{hosts.folder / "id_ed25519"}"\n  IdentitiesOnly yes\n'
        f'  UserKnownHostsFile "{tmp_path}/known_hosts"\n  GlobalKnownHostsFile /dev/null\n'
        "  StrictHostKeyChecking ask\n"
    )
    path = tmp_path / "enroll.toml"
    path.write_text(f'predecessors = ["old_stack", "old-stack", "never_was"]\n{text}')
    return path


@pytest.fixture
def person(tmp_path: Path) -> dict[str, str]:
    """Somebody who compares the host key, and types the password."""
    script = tmp_path / "askpass"
    script.write_text(
        textwrap.dedent(f"""\
        #!/bin/sh
        echo "$1" >> {tmp_path}/asked
        case "$1" in *fingerprint*) echo yes ;; *) echo {PASSWORD} ;; esac
        """)
    )
    script.chmod(0o755)
    return {"SSH_ASKPASS": str(script), "SSH_ASKPASS_REQUIRE": "force"}


def install(host: FrailHost, path: str, text: str, mode: int = 0o644) -> None:
    file = host.root / path
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)
    file.chmod(mode)


def outcomes(text: str) -> dict[str, str]:
    lines = (line for line in text.splitlines() if not line.startswith(" "))
    return {
        step: line[len(step) :].strip()
        for line in lines
        for step in STEPS
        if line.startswith(f"{step} ")
    }


def as_a_lab_left_it(new: FrailHost, image: Path) -> None:
    """A password, and three programs that may command the vehicle."""
    give_image(new, load_image(image))
    (new.root / "root/.ssh/authorized_keys").write_text("ssh-ed25519 AAAA another's")
    new.run(f"echo 'root:{PASSWORD}' | chpasswd; echo PermitRootLogin yes >> /etc/ssh/sshd_config")
    new.run("systemctl restart ssh")
    install(new, "usr/local/bin/docker", DOCKER, 0o755)
    for unit in ("old-stack", "voxl-microdds-agent", "voxl-mpa-to-ros2"):
        install(new, f"etc/systemd/system/{unit}.service", UNIT)
    new.run(
        "systemctl enable --now old-stack voxl-microdds-agent; systemctl start voxl-mpa-to-ros2"
    )


def assert_alone(new: FrailHost, said: str) -> None:
    """The predecessors do not run any more; what else runs was told."""
    containers = json.loads((new.root / "var/lib/docker.json").read_text())
    old, camera = containers["old_stack"], containers["camera"]
    assert (old["State"]["Running"], old["HostConfig"]["RestartPolicy"]["Name"]) == (False, "no")
    assert camera["State"]["Running"]
    assert "container camera (lab/ros2) runs in this host's network" in said
    assert "unit voxl-mpa-to-ros2 runs" in said
    for unit in ("old-stack", "voxl-microdds-agent"):
        state = f"systemctl is-active {unit}; systemctl is-enabled {unit}; true"
        assert new.run(state).split() == ["inactive", "disabled"]


def test_from_a_password_to_a_robot_of_the_fleet(
    hosts: FrailHosts,
    new: FrailHost,
    fleet_file: Path,
    tmp_path: Path,
    person: dict[str, str],
) -> None:
    as_a_lab_left_it(new, load_fleet(fleet_file).image)
    comment = "/* made by voxl-configure: 'offboard_mode': // \"x\" */\n"
    hub = new.root / "etc/modalai/voxl-vision-hub.conf"
    original = comment + hub.read_text()
    hub.write_text(original)
    with new.stepped:
        new.vehicle.parameters |= {"EKF2_HGT_REF": 3, "COM_OBL_RC_ACT": 0}
    before = fleet_file.read_text()
    image = str(load_fleet(fleet_file).image)
    fleet_file.write_text(before.replace(image, f"{image}-none"))

    done = lpac_fleet(fleet_file, "enroll", "r4", new.address, environment=person)
    assert done.returncode == 1
    assert done.stderr.endswith("lpac: r4 is not ready: left to do: release, PX4\n")
    assert "has no image" in done.stdout
    assert outcomes(done.stdout) == {**dict.fromkeys(STEPS, "done"), "release": LEFT, "PX4": LEFT}
    stopped = done.stdout
    fleet_file.write_text(fleet_file.read_text().replace(f"{image}-none", image))
    done = lpac_fleet(fleet_file, "enroll", "r4", new.address)
    assert done.returncode == 0, done.stdout + done.stderr
    repeated = {**dict.fromkeys(STEPS, SO_ALREADY), "release": "done", "PX4": "done"}
    assert outcomes(done.stdout) == repeated

    asked = (tmp_path / "asked").read_text()
    assert asked.count("continue connecting") == asked.count("password") == 1
    keys = (new.root / "root/.ssh/authorized_keys").read_text().splitlines()
    assert keys == [
        "ssh-ed25519 AAAA another's", (hosts.folder / "id_ed25519.pub").read_text().strip(),
    ]  # fmt: skip
    config = load_fleet(fleet_file)
    assert (config.robots["r4"].host, config.slot_of("r4")) == (new.address, None)
    added = f'[robots.r4]\nhost = "{new.address}"\nrobot_id = 4\n\n'
    assert fleet_file.read_text().replace(added, "") == before
    assert json.loads((new.root / "etc/lpac/robot.json").read_text()) == {
        "fleet": hosts.fleet, "robot": "r4", "robot_id": 4,
    }  # fmt: skip
    assert json.loads(hub.read_text()) == {
        "en_localhost_mavlink_udp": True, "localhost_udp_port_number": 14551,
        "offboard_mode": "off",
    }  # fmt: skip
    assert (hub.parent / "voxl-vision-hub.conf.before-lpac").read_text() == original
    assert_alone(new, stopped)
    assert new.vehicle.parameters["EKF2_HGT_REF"] == 1
    assert new.vehicle.parameters["COM_OBL_RC_ACT"] == 4
    assert "PX4 was restarted and answers as system 4" in done.stdout
    assert not (new.root / "opt/lpac/current/robot.toml").exists()

    written = fleet_file.read_text(), hub.stat().st_mtime_ns
    done = lpac_fleet(fleet_file, "enroll", "r4", new.address)
    assert done.returncode == 0, done.stdout + done.stderr
    assert outcomes(done.stdout) == dict.fromkeys(STEPS, SO_ALREADY)
    assert (fleet_file.read_text(), hub.stat().st_mtime_ns) == written

    # Another kind of computer, on a desk without its vehicle.
    hub.unlink()
    new.stop_vehicle()
    done = lpac_fleet(fleet_file, "enroll", "r4", new.address)
    assert done.returncode == 1
    assert "not a VOXL2" in done.stdout
    assert "no autopilot connected within 10 s" in done.stdout
    alone = {**dict.fromkeys(STEPS, SO_ALREADY), "vision-hub": "skipped", "PX4": LEFT}
    assert outcomes(done.stdout) == alone


def test_a_robot_is_not_renamed_nor_touched_in_flight_nor_let_in_unseen(
    hosts: FrailHosts,
    new: FrailHost,
    fleet_file: Path,
    tmp_path: Path,
    person: dict[str, str],
) -> None:
    # Nobody is there who could say that the host key is right.
    done = lpac_fleet(fleet_file, "enroll", "r4", new.address)
    assert (done.returncode, done.stdout) == (1, "")
    assert f"{new.address} did not let you in: see above" in done.stderr
    assert not (tmp_path / "known_hosts").exists()
    subprocess.run(
        f"echo {new.address} {new.host_key} > {tmp_path}/known_hosts", shell=True, check=True
    )
    install(new, "etc/lpac/robot.json", '{"fleet": "other", "robot": "r9", "robot_id": 9}')
    before = fleet_file.read_text()
    done = lpac_fleet(fleet_file, "enroll", "r4", new.address)
    assert done.returncode == 1
    assert "it is enrolled as r9 of fleet other (id 9): to make it r4, add --yes" in done.stderr
    assert fleet_file.read_text() == before
    with armed(new):
        done = lpac_fleet(fleet_file, "enroll", "r4", new.address, "--yes")
    assert done.returncode == 1
    assert outcomes(done.stdout)["robot id"] == "done"
    assert "it was r9 of fleet other (id 9)" in done.stdout
    assert "the vehicle is armed: a new key is refused" in done.stderr
    hub = (new.root / "etc/modalai/voxl-vision-hub.conf").read_text()
    assert "figure_eight" in hub
    done = lpac_fleet(fleet_file, "enroll", "r4", "10.0.0.1")
    assert f"robots.r4: has host = '{new.address}': change it there" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (("r1", "--user", "voxl"), "r1: has user = 'root': change it there, or leave 'voxl' out"),
        (("r1", "--port", "2222"), "robots.r1: has no port: change it there, or leave 2222 out"),
        pytest.param(
            ("r12", "fd00::12"),
            "fd00::12: has no IPv4 address here: give the one that the other",
            marks=needs("ssh"),
        ),
    ],
)
def test_what_cannot_be_done_is_said_before_anything_is(
    arguments: tuple[str, ...], why: str, tmp_path: Path
) -> None:
    path = tmp_path / "fleet.toml"
    path.write_text(EXAMPLE.read_text())
    done = lpac_fleet(path, "enroll", *arguments)
    assert done.returncode == 1
    assert why in done.stderr
    assert path.read_text() == EXAMPLE.read_text()


def test_a_host_that_only_ssh_knows_has_its_address_told() -> None:
    config = load_fleet(EXAMPLE)
    robot = _robot(config, "r12", "fd00::12", None, None, "192.168.8.22", None)
    assert (robot.host, robot.address, robot.user) == ("fd00::12", "192.168.8.22", "root")
