"""fleet.toml: what robots get from it, one clear line for every mistake, and safe edits."""

import dataclasses
import difflib
import itertools
import re
import threading
import tomllib
from pathlib import Path
from typing import Any

import pytest
import tomlkit
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.core.schema import ConfigError
from edge.robot.config import RobotConfig, load_config
from lpac.cli.options import DEFAULT_BUNDLE
from lpac.fleet.release import drop_ins
from lpac.fleet.settings import FleetConfig, RobotHost, RobotPaths, load_fleet, select
from lpac.fleet.writer import add_robot, assign, robot_toml, write_fleet, write_robot
from tests.conftest import ROOT

EXAMPLE = ROOT / "docs" / "fleet.toml"
# A value that is commented out, at the start of its line, and the head of such a table.
COMMENTED_OUT = re.compile(r"^# ((?:\w+ = |\[[\w.]+\]).*)$", re.MULTILINE)


def example(old: str = "", new: str = "") -> str:
    text = EXAMPLE.read_text()
    assert not old or text.count(old) == 1, old
    return text.replace(old, new) if old else text


def fleet_file(folder: Path, text: str) -> Path:
    path = folder / "fleet.toml"
    path.write_text(text)
    return path


def fleet_of(folder: Path, mapping: dict[str, Any]) -> FleetConfig:
    return load_fleet(fleet_file(folder, tomlkit.dumps(mapping)))


def mapping() -> dict[str, Any]:
    return tomllib.loads(example())


def rendered(config: FleetConfig, name: str, folder: Path) -> RobotConfig:
    """What the robot's program reads in its release."""
    path = folder / "robot.toml"
    path.write_text(robot_toml(config, name))
    return load_config(path)


def refusal(path: Path) -> str:
    """Why the file is not taken, without the file's name, which comes first."""
    with pytest.raises(ConfigError) as caught:
        load_fleet(path)
    return one_line(str(caught.value), path)


def one_line(message: str, path: Path) -> str:
    assert "\n" not in message
    assert message.startswith(f"{path}: ")
    return message.removeprefix(f"{path}: ")


# What stands in the file


def test_the_example_is_complete_and_shows_the_defaults(tmp_path: Path) -> None:
    (tmp_path / "docs").mkdir()
    short_path = fleet_file(tmp_path, example())
    long_path = fleet_file(tmp_path / "docs", COMMENTED_OUT.sub(r"\1", example()))
    short, long = load_fleet(short_path), load_fleet(long_path)
    paths = {"path", "image", "bundle", "world", "shared"}
    for key in {field.name for field in dataclasses.fields(FleetConfig)} - paths:
        assert getattr(short, key) == getattr(long, key), key
    for name in ("r1", "r2", "r3"):
        assert rendered(short, name, tmp_path) == rendered(long, name, tmp_path)

    tables = tomllib.loads(long_path.read_text())
    for shown, old in (
        (tables, "# directory"),
        (tables["ssh"], "# [ssh]"),
        ({*tables["robots"]["r1"], "port", "robot"}, "# zenoh_port"),
        (tables["slots"][0], "# height"),
    ):
        head = "[ssh]\n" if old == "# [ssh]" else ""
        message = refusal(fleet_file(tmp_path, example(old, f"{head}x = 1\n{old}")))
        assert set(shown) == set(message.partition("known are ")[2].split(", "))


def test_the_example_says_who_is_where() -> None:
    config = load_fleet(EXAMPLE)
    assert config.bundle.samefile(DEFAULT_BUNDLE)
    assert config.world == EXAMPLE.parent / "world.env"
    assert config.robots["r1"] == RobotHost(
        name="r1", host="192.168.8.11", user="root", port=None, address="192.168.8.11", robot_id=1,
        zenoh_port=7447, system_id=1, mavlink_url="udpin://127.0.0.1:14551", cpus=(), overrides={},
    )  # fmt: skip
    slot = config.slot_of("r2")
    assert slot is not None
    assert (slot.height, slot.landing_point_m) == (1, (11.0, 4.0))
    assert config.slot_of("r11") is None


def test_relative_paths_are_meant_from_the_files_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fleet_file(tmp_path, example("# [ssh]", '[ssh]\nconfig = "near"').replace('"world', '"/srv/w'))
    monkeypatch.chdir(tmp_path)
    config = load_fleet(Path("fleet.toml"))
    assert config.world == Path("/srv/w.env")
    assert config.image == tmp_path / "../out/image/arm64"
    assert config.ssh.config == str(tmp_path / "near")


def test_a_tilde_is_the_home_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/me")
    config = load_fleet(fleet_file(tmp_path, example('"../out/image/arm64"', '"~/image"')))
    assert config.image == Path("/home/me/image")
    message = refusal(fleet_file(tmp_path, example('"../out/image/arm64"', '"~no-one/image"')))
    assert "'~no-one/image'" in message


@pytest.mark.parametrize(
    ("text", "cpus"), [("4-6", (4, 5, 6)), ("7, 4,5", (4, 5, 7)), ("0,2-3,3", (0, 2, 3)), ("", ())]
)
def test_cpus(tmp_path: Path, text: str, cpus: tuple[int, ...]) -> None:
    path = fleet_file(tmp_path, example('# cpus = ""', f'cpus = "{text}"'))
    assert load_fleet(path).robots["r1"].cpus == cpus


# What a robot gets


def test_a_robot_gets_what_is_its_own(tmp_path: Path) -> None:
    text = example(
        '# mavlink_url = "udpin://127.0.0.1:14551"', 'mavlink_url = "udpin://10.0.0.1:9"'
    )
    text = text.replace('# address = "192.168.8.11"', 'address = "10.0.0.1"')
    text = text.replace(
        "[robots.r2]", "[robots.r1.robot.autopilot]\ninsecure = true\n\n[robots.r2]"
    )
    config = load_fleet(fleet_file(tmp_path, text.replace("# zenoh_port = 7447", "zenoh_port = 7")))
    first, third = rendered(config, "r1", tmp_path), rendered(config, "r3", tmp_path)
    assert (first.fleet, first.robot_id, first.autopilot.system_id) == ("demo", 1, 1)
    assert first.autopilot.url == "udpin://10.0.0.1:9"
    assert (config.robots["r1"].mavlink_port, config.robots["r3"].mavlink_port) == (9, 14551)
    assert third.autopilot.url == "udpin://127.0.0.1:14551"
    assert (first.link.listen, first.link.connect) == (("tls/0.0.0.0:7",), ())
    assert third.link.listen == ("tls/0.0.0.0:7447",)
    assert third.link.connect == ("tls/10.0.0.1:7", "tls/192.168.8.12:7447")
    assert (third.flight.slot, third.flight.landing_point_m) == (2, (20.0, 4.0))
    assert third.policy.bundle == str(tmp_path / "bundle")
    assert third.policy.world == str(tmp_path / "world.env")
    assert third.log.folder == "/var/lib/lpac/logs"
    assert robot_toml(config, "r3").startswith("# Generated from fleet.toml")
    assert str(tmp_path) not in robot_toml(config, "r3")


MULTICAST = "# [radio]", '[radio]\ntransport = "multicast"\n'


def test_with_multicast_robots_are_in_a_group_and_connect_to_nobody(tmp_path: Path) -> None:
    config = load_fleet(fleet_file(tmp_path, example(*MULTICAST)))
    for name, address in (("r1", "192.168.8.11"), ("r3", "192.168.8.13")):
        link = rendered(config, name, tmp_path).link
        assert (link.listen, link.connect) == (("tls/0.0.0.0:7447",), ())
        assert (link.group, link.interface) == ("239.255.76.80:7450", address)
        assert link.leaves_machine
    mesh = load_fleet(fleet_file(tmp_path, example()))
    assert mesh.endpoints == config.endpoints
    assert mesh.endpoints[0] == "tls/192.168.8.11:7447" and len(mesh.endpoints) == 4


def test_a_radio_of_ones_own_is_told_what_the_built_in_one_is(tmp_path: Path) -> None:
    text = example(*MULTICAST).replace(
        'transport = "multicast"', 'transport = "multicast"\ntype = "lora"\noptions = {channel = 7}'
    )
    link = rendered(load_fleet(fleet_file(tmp_path, text)), "r3", tmp_path).link
    assert (link.type, link.options) == ("lora", {"channel": 7})
    assert (link.group, link.interface) == ("239.255.76.80:7450", "192.168.8.13")


@pytest.mark.parametrize(
    ("lines", "told"),
    [
        ("options = {channel = 7}", "type = 'zenoh' takes none"),
        ('type = ""', "type = '': must be 'zenoh', or the name of your own radio"),
    ],
)
def test_what_says_nothing_of_a_radio_is_refused(tmp_path: Path, lines: str, told: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(told)):
        load_fleet(fleet_file(tmp_path, example("# [radio]", f"[radio]\n{lines}\n")))


def test_robots_of_this_computer_need_no_keys(tmp_path: Path) -> None:
    here = re.sub(r"192\.168\.8\.(\d+)", r"127.0.0.\1", example(*MULTICAST))
    config = load_fleet(fleet_file(tmp_path, here))
    assert config.keys is None
    assert rendered(config, "r1", tmp_path).link.listen == ("tcp/127.0.0.1:7447",)
    elsewhere = here.replace('host = "127.0.0.12"', 'host = "192.168.8.12"')
    assert load_fleet(fleet_file(tmp_path, elsewhere)).keys is not None


def test_a_spare_and_a_stranger_get_none() -> None:
    config = load_fleet(EXAMPLE)
    with pytest.raises(ConfigError, match=r"robots\.r11: is a spare"):
        robot_toml(config, "r11")
    with pytest.raises(ConfigError, match="'r9' is unknown; known are r1, r2, r3, r11"):
        robot_toml(config, "r9")


POSITIVE = st.floats(0.1, 100.0)
# A faster one would need more room within its fence, and up to PX4's.
SPEEDS = st.floats(0.1, 1.25)
TABLES = st.fixed_dictionaries(
    {},
    optional={
        "on_stop": st.sampled_from(["hold", "land"]),
        "limits": st.fixed_dictionaries(
            {}, optional={"max_speed_m_s": SPEEDS, "lag_s": st.integers(0, 3)}
        ),
        "rates": st.fixed_dictionaries(
            {}, optional={"policy_hz": POSITIVE, "perception_hz": POSITIVE}
        ),
        "policy": st.fixed_dictionaries({}, optional={"payload": st.just("float32")}),
        "flight": st.fixed_dictionaries({}, optional={"takeoff_timeout_s": POSITIVE}),
    },
)


@settings(deadline=None, max_examples=50)
@given(shared=TABLES, own=TABLES)
def test_a_robots_own_values_stand_over_the_shared_ones(
    shared: dict[str, Any], own: dict[str, Any], tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("fleet")
    base = mapping()
    plain = dataclasses.asdict(rendered(fleet_of(folder, base), "r1", folder))
    for table in (shared, own):
        for key, value in table.items():
            plain[key] = plain[key] | value if isinstance(value, dict) else value
    for key, value in shared.items():
        inner = base["robot"].get(key, {})
        base["robot"][key] = inner | value if isinstance(value, dict) else value
    base["robots"]["r1"]["robot"] = own
    assert dataclasses.asdict(rendered(fleet_of(folder, base), "r1", folder)) == plain


@settings(deadline=None, max_examples=30)
@given(data=st.data())
def test_the_same_values_give_the_same_bytes(
    data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """A release is named by its contents: the order and form of fleet.toml must not matter."""
    folder = tmp_path_factory.mktemp("fleet")
    shuffled = _shuffled(mapping(), data)
    config = fleet_of(folder, shuffled)
    for name in ("r1", "r2", "r3"):
        assert robot_toml(config, name) == robot_toml(load_fleet(EXAMPLE), name)


def _shuffled(table: dict[str, Any], data: st.DataObject) -> dict[str, Any]:
    keys = data.draw(st.permutations(sorted(table)))
    return {k: _shuffled(table[k], data) if isinstance(table[k], dict) else table[k] for k in keys}


def test_a_drop_in_says_what_differs(tmp_path: Path) -> None:
    config = load_fleet(EXAMPLE)
    assert drop_ins(config, config.robots["r1"]) == {}
    text = example('# cpus = ""', 'cpus = "4-6"')
    config = load_fleet(fleet_file(tmp_path, text))
    assert drop_ins(config, config.robots["r1"]) == {
        "lpac-robot.conf": "[Service]\nCPUAffinity=\nCPUAffinity=4 5 6\n"
    }
    text = text.replace('# directory = "/opt/lpac"', 'directory = "/data/lpac"')
    config = load_fleet(fleet_file(tmp_path, text))
    first = drop_ins(config, config.robots["r1"])
    second = drop_ins(config, config.robots["r2"])
    for name, cpus in (("lpac-robot", "CPUAffinity=\nCPUAffinity=4 5 6\n"), ("lpac-land", "")):
        # What must be repeated is what the unit says, with the other folder.
        unit = (ROOT / "systemd" / f"{name}.service").read_text()
        unit = unit.replace("/opt/lpac", "/data/lpac")
        assert unit.count("\nCondition") == 1
        binds = "\n".join(re.findall(r"^Bind.*", unit, re.MULTILINE))
        (condition,) = re.findall(r"^Condition.*", unit, re.MULTILINE)
        (root,) = re.findall(r"^RootDirectory=.*", unit, re.MULTILINE)
        head = (
            f"[Unit]\nConditionPathExists=\n{condition}\n\n"
            f"[Service]\n{root}\nBindReadOnlyPaths=\n{binds}\n"
        )
        assert first[f"{name}.conf"] == head + cpus
        assert second[f"{name}.conf"] == head


# Mistakes


@pytest.mark.parametrize(
    ("old", "new", "names"),
    [
        ('fleet = "demo"', "", ["fleet is missing"]),
        ('fleet = "demo"', 'fleet = "a b"', ["fleet = 'a b'", "letters"]),
        ("# [radio]", '[radio]\ntransport = "air"\n#', ["radio: transport = 'air'", "'mesh'"]),
        (
            "# [radio]", '[radio]\ntransport = "router"\n#',
            ["radio: transport = 'router': allowed are 'mesh', 'multicast'"],
        ),
        ("# [radio]", '[radio]\nrouter = "10.0.0.1:1"\n#', ["radio: unknown key 'router'"]),
        *(
            ("# [radio]", f'[radio]\ntransport = "multicast"\ngroup = "{group}"\n#',
             [f"radio: group = '{group.rpartition(':')[0]}", *told])
            for group, told in (
                ("10.0.0.2:7450", ["239.255.76.80:7450"]),
                ("224.0.0.1:7450", ["none of 224.0.0.0/24", "239.255.76.80:7450"]),
                ("239.255.76.080:7450", ["'239.255.76.080': looks like an address"]),
                ("239.255.76.80:\u0667", ["239.255.76.80:7450"]),
            )
        ),
        (
            "# [radio]", '[radio]\ngroup = "239.1.2.3:7450"\n#',
            ["radio: transport = 'mesh': group = '239.1.2.3:7450': must be left out"],
        ),
        ('# address = "192.168.8.11"', 'address = "0.0.0.0"', ["robots.r1: address = '0.0.0.0'"]),
        ('"../out/image/arm64"', '""', ["image = ''", "path"]),
        ("# directory = ", "folder = ", ["unknown key 'folder'", "directory", "robots"]),
        ('"/opt/lpac"', '"/a"\ndirectory = "lpac"', ["directory = 'lpac'", "absolute"]),
        ('# directory = "/opt/lpac"', 'directory = "/opt/../x"', ["directory = '/opt/../x'"]),
        ('# directory = "/opt/lpac"', 'directory = "/a b"', ["directory = '/a b'"]),
        ('# directory = "/opt/lpac"', 'directory = "/"', ["directory = '/'"]),
        ("# predecessors = []", 'predecessors = ["-f"]', ["predecessors[0] = '-f'"]),
        ("# [ssh]", "[ssh]\nconnect_timeout_s = 0", ["ssh: connect_timeout_s = 0", "1 to 300"]),
        ("# [ssh]", "[ssh]\nuser = 'x'", ["ssh: unknown key 'user'", "config"]),
        ("[robots.r11]", "[robots.'-r11']", ["robots: key = '-r11'", "not start with '-'"]),
        ("[robots.r11]", "[robots.'r 11']", ["robots: key = 'r 11'", "letters"]),
        ("[robots.r11]", f"[robots.{'a' * 33}]", ["robots: key = 'aaa", "32"]),
        ("[robots.r11]", '[robots."r\\n"]', ["robots: key = 'r\\n'"]),
        ("[robots.r11]", "[robots.r2.robot.rates]", ["robots.r2, in slots[1]: rates: unkn"]),
        ('"192.168.8.12"', '"-oProxyCommand=x"', ["robots.r2: host = '-oProxyCommand=x'"]),
        ('"192.168.8.12"', '"a b"', ["robots.r2: host = 'a b'", "letters"]),
        ('"192.168.8.12"', '""', ["robots.r2: host = ''"]),
        ('"192.168.8.12"', '"root@r2"', ["robots.r2: host = 'root@r2'"]),
        ('"192.168.8.12"', '"r2"', ["robots.r2: address is missing", "host = 'r2'", "IPv4"]),
        ('"192.168.8.12"', "12", ["robots.r2: host = 12", "text in quotes"]),
        ('# user = "root"', 'user = "-l"', ["robots.r1: user = '-l'"]),
        ("# port: for", "port = 0 #", ["robots.r1: port = 0", "1 to 65535"]),
        ("# zenoh_port = 7447", "zenoh_port = 70000", ["robots.r1: zenoh_port = 70000"]),
        ('# address = "192.168.8.11"', 'address = "r1.local"', ["robots.r1: address = 'r1.local'"]),
        # C reads them as 192.168.8.9, which is another robot.
        (
            '"192.168.8.12"', '"192.168.8.011"',
            ["robots.r2: host = '192.168.8.011': looks like an address", "leading zeros"],
        ),
        (
            '"192.168.8.12"', '"192.168.8.011"\naddress = "192.168.8.12"',
            ["robots.r2: host = '192.168.8.011': looks like an address"],
        ),
        ('# address = "192.168.8.11"', 'address = "192.168.8.011"', ["address = '192.168.8.011'"]),
        ('# address = "192.168.8.11"', 'address = "\u0661.168.8.9"', ["robots.r1: address = '"]),
        (
            '# mavlink_url = "udpin://127.0.0.1', 'mavlink_url = "udpin://127.0.0.011',
            ["robots.r1: mavlink_url = '127.0.0.011': looks like an address"],
        ),
        (
            'host = "192.168.8.12"', 'host = "::ffff:192.168.8.11"\naddress = "192.168.8.12"',
            ["robots.r2: host = '192.168.8.11', port = 22: robot r1 has it too"],
        ),
        ("robot_id = 2", "", ["robots.r2: robot_id is missing"]),
        ("robot_id = 2", "robot_id = -2", ["robots.r2: robot_id = -2", "0 to 65535"]),
        ("robot_id = 2", "robot_id = 256", ["robots.r2: system_id is missing", "256"]),
        ("robot_id = 2", "robot_id = 2\nsystem_id = 0", ["robots.r2: system_id = 0", "1 to 255"]),
        ("robot_id = 2", "robot_id = 2\nip = 1", ["robots.r2: unknown key 'ip'", "address"]),
        ("robot_id = 2", "robot_id = 1", ["robots.r2: robot_id = 1: robot r1 has it too"]),
        ("robot_id = 3", "robot_id = 3\nsystem_id = 1", ["robots.r3: system_id = 1: robot r1"]),
        (
            '"192.168.8.12"',
            '"192.168.8.11"',
            ["robots.r2: host = '192.168.8.11', port = 22: robot r1 has it too"],
        ),
        (
            "robot_id = 2",
            'robot_id = 2\naddress = "192.168.8.11"',
            ["robots.r2: address = '192.168.8.11', zenoh_port = 7447: robot r1 has it too"],
        ),
        ('# mavlink_url = "udpin:', 'mavlink_url = "udp:', ["robots.r1: mavlink_url = 'udp:"]),
        (
            'url = "udpin://127.0.0.1:14551"  # where',
            'url = "udpin://0.0.0.0:14551"  # where',
            ["robots.r1: autopilot: url = 'udpin://0.0.0.0:14551'", "insecure = true"],
        ),
        ('url = "udpin://127.0.0.1:14551"  # where', "#", ["robots.r1: autopilot: url is missing"]),
        ('# cpus = ""', 'cpus = "6-4"', ["robots.r1: cpus = '6-4'", "'4-6'"]),
        ('# cpus = ""', 'cpus = "4,"', ["robots.r1: cpus = '4,'"]),
        ('# cpus = ""', 'cpus = "0-9999"', ["robots.r1: cpus = '0-9999'", "1023"]),
        ('# on_stop = "hold"', 'fleet = "x"', ["robot: fleet must not", "top of the file"]),
        ('# on_stop = "hold"', "robot_id = 1", ["robot: robot_id must not", "[robots.NAME]"]),
        ('# on_stop = "hold"', 'policy.bundle = "x"', ["robot: policy.bundle must not", "top"]),
        ('# on_stop = "hold"', 'policy.world = "x"', ["robot: policy.world must not", "top"]),
        ('# on_stop = "hold"', "policy = 1", ["robot: policy = 1", "must be a table"]),
        ('# on_stop = "hold"', "link.scouting = true", ["robot: link must not", "zenoh_port"]),
        ('# on_stop = "hold"', "flight.slot = 1", ["robot: flight.slot must not", "`height`"]),
        ('# on_stop = "hold"', "flight.landing_point_m = 1", ["robot: flight.landing_point_m"]),
        ('# on_stop = "hold"', 'log.folder = "x"', ["robot: log.folder must not", "/var/lib/lpac"]),
        ('# on_stop = "hold"', 'on_stop = "go"', ["robots.r1, in slots[0]: on_stop = 'go'"]),
        ("[robot.autopilot]\nu", "[robot.autopilot]\nsystem_id = 1\nu", ["robot: autopilot.sys"]),
        ("[robots.r2.robot.limits]", "[robots.r2.robot.autopilot]", ["autopilot: unknown key"]),
        ("[robots.r2.robot.limits]", "[robots.r2.robot.flight]\nslot = 1", ["robots.r2.robot: fl"]),
        (
            "[robots.r2.robot.limits]",
            "[robots.r2.robot]\nautopilot.url = 'x'\n[robots.r2.robot.limits]",
            ["robots.r2.robot: autopilot.url must not", "`mavlink_url`"],
        ),
        ("max_speed_m_s = 1.0\n", "max_speed_m_s = -1", ["robots.r2, in slots[1]: limits: max_s"]),
        ("robot_id = 11", "robot_id = 11\nrobot.limits.lag_s = -1", ["robots.r11, if it took slo"]),
        ("rc = ", "rcs = ", ["robots.r1, in slots[0]: failsafe: unknown key 'rcs'"]),
        ('robot = "r2"', 'robot = "r9"', ["slots[1]: robot = 'r9'", "[robots]", "r1, r2, r3, r11"]),
        ('robot = "r2"', 'robot = "r1"', ["slots[1]: robot = 'r1': slots[0] has it too"]),
        ('robot = "r2"', "height = 0", ["slots[1]: height = 0: slots[0] (robot r1) has it too"]),
        ('robot = "r2"', 'robot = "r2"\nheight = -1', ["slots[1]: height = -1", "from 0 to 1000"]),
        ('robot = "r2"', 'robot = "r2"\nheight = 40', ["robots.r2, in slots[1]: slot = 40", "185"]),
        ("pad_m = [11.0, 2.0]", "", ["slots[1]: pad_m is missing"]),
        ("[11.0, 2.0]", "[11.0]", ["slots[1]: pad_m = [11.0]", "[x, y]"]),
        ("[11.0, 4.0]", "[nan, 4.0]", ["slots[1]: landing_point_m[0] = nan: must be finite"]),
        (
            "[11.0, 2.0]",
            "[9.9, 2.0]",
            ["slots[1] (robot r2): pad_m = [9.9, 2.0]: is 7.9 m from pad_m of slots[0] (robot r1), "
             "must be 8 m (positions err by 4 m and 4 m)"],
        ),
        (
            "[11.0, 4.0]",
            "[9.0, 6.0]",
            ["slots[1] (robot r2): landing_point_m", "is 7.3 m from landing_point_m of slots[0]"],
        ),
        (
            "[11.0, 4.0]",
            "[12.5, 4.0]",
            ["slots[2] (robot r3): pad_m", "is 7.8 m from landing_point_m of slots[1] (robot r2)"],
        ),
        ("[11.0, 2.0]", "[11.0, -2.0]", ["slots[1] (robot r2): pad_m", "inside the fence"]),
        ("[11.0, 4.0]", "[80.0, 4.0]", ["robots.r2, in slots[1]: landing_point_m", "fence"]),
        ('robot = "r2"\npad_m = [11.0', 'pad_m = [60.0', ["slots[1]: pad_m = [60.0", "fence"]),
        (
            "[robots.r2.robot.limits]",
            "[robots.r2.robot]\nflight.slot_spacing_m = 4.4\n[robots.r2.robot.limits]",
            ["slots[1] (robot r2): height = 1: is 9.4 m, 4.4 m from that of slots[0] (robot r1), "
             "must be 4.5 m (heights err by 2.5 m from each other"],
        ),
        (
            "[robots.r2.robot.limits]",
            "[robots.r2.robot]\nerrors.gps_m = 4.5\n[robots.r2.robot.limits]",
            ["is 9.0 m from pad_m of slots[0] (robot r1), must be 9.5 m", "5.5 m and 4 m"],
        ),
        (
            '# on_stop = "hold"',
            "flight = {min_separation_m = 9.5, slot_spacing_m = 10.0}",
            ["slots[1] (robot r2): pad_m", "is 9.0 m", "must be 9.5 m (min_separation_m)"],
        ),
        (
            "[robots.r2.robot.limits]",
            "[robots.r2.robot]\nflight.min_separation_m = 9.5\nflight.slot_spacing_m = 10.0\n"
            "[robots.r2.robot.limits]",
            ["slots[1] (robot r2): pad_m", "is 9.0 m", "must be 9.5 m (min_separation_m)"],
        ),
        (
            "[robots.r2.robot.limits]",
            "[robots.r2.robot]\nflight.min_separation_m = 9.0\nflight.slot_spacing_m = 10.0\n"
            "flight.base_height_m = 3.5\n[robots.r2.robot.limits]",
            ["height = 1: is 13.5 m, 8.5 m from that of", "must be 9 m (min_separation_m)"],
        ),
        ("buffer_m = 1.5", "buffer_m = 1.0", ["robots.r1, in slots[0]: buffer_m = 1: must be 1.3"]),
        ("[robot]\n#", "[[robot]]\n#", ["robot = [{", "must be a table"]),
        ("[[slots]]\nrobot = \"r1\"", "[slots]", ["is not TOML"]),
    ],
)  # fmt: skip
def test_a_mistake_is_one_line_that_names_it(
    tmp_path: Path, old: str, new: str, names: list[str]
) -> None:
    message = refusal(fleet_file(tmp_path, example(old, new)))
    for name in names:
        assert name in message


def test_receivers_with_corrections_may_stand_nearer(tmp_path: Path) -> None:
    near = example("[11.0, 2.0]", "[4.2, 2.0]").replace("[11.0, 4.0]", "[4.2, 2.0]")
    near = near.replace("landing_point_m = [2.0, 4.0]", "landing_point_m = [2.0, 2.0]")
    assert "must be 8 m" in refusal(fleet_file(tmp_path, near))
    load_fleet(fleet_file(tmp_path, near.replace("# gps_m = 3.0", "gps_m = 0.1")))


def test_the_ground_to_keep_free_is_that_of_the_robot_that_needs_most(tmp_path: Path) -> None:
    """A higher ceiling, a faster robot: more. Nobody who flies: none."""
    margin = load_fleet(EXAMPLE).free_ground()
    assert margin is not None and margin.least_m == 45.0
    limits = "[robots.r2.robot.limits]"
    for old, new in (
        (limits, f"[robots.r2.robot.fence]\nceiling_m = 60\n{limits}"),
        ('rc = "pilot"', 'rc = "pilot"\nfence_margin_m = 6.0'),
    ):
        more = load_fleet(fleet_file(tmp_path, example(old, new))).free_ground()
        assert more is not None and more.least_m > margin.least_m
    text = example()
    nobody = text[: text.index("# Who flies where")]
    assert load_fleet(fleet_file(tmp_path, nobody)).free_ground() is None


def test_a_file_that_cannot_be_read(tmp_path: Path) -> None:
    for path in (tmp_path / "none.toml", tmp_path):
        assert refusal(path).startswith("cannot be read: ")
    path = tmp_path / "fleet.toml"
    path.write_bytes(b'fleet = "\xff"')
    assert refusal(path).startswith("is not TOML")


VALUES: st.SearchStrategy[Any] = st.recursive(
    st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.datetimes(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner),
    max_leaves=4,
)


def _places(value: Any) -> list[tuple[Any, Any]]:
    """Every key of every table, and every element of every list."""
    items = value.items() if isinstance(value, dict) else enumerate(value)
    inner = [(value, key) for key, _ in items]
    nested = value.values() if isinstance(value, dict) else value
    return inner + [p for v in nested if isinstance(v, dict | list) for p in _places(v)]


@settings(deadline=None)
@given(data=st.data())
def test_whatever_stands_there_is_taken_or_refused_in_one_line(
    data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    document = tomllib.loads(COMMENTED_OUT.sub(r"\1", example()))
    table, key = data.draw(st.sampled_from(_places(document)))
    table[key] = data.draw(VALUES)
    path = fleet_file(tmp_path_factory.mktemp("fleet"), tomlkit.dumps(document))
    try:
        config = load_fleet(path)
    except ConfigError as error:
        one_line(str(error), path)
    else:
        for slot in config.slots:
            if slot.robot is not None:
                rendered(config, slot.robot, path.parent)


# Choosing


def test_robots_come_in_the_order_of_the_slots(tmp_path: Path) -> None:
    text = example('robot = "r1"', 'robot = "r11"').replace('robot = "r3"', 'robot = ""')
    config = load_fleet(fleet_file(tmp_path, text))

    def chosen(names: str | None) -> list[str]:
        return [robot.name for robot in select(config, names)]

    assert chosen(None) == ["r11", "r2", "r1", "r3"]
    assert chosen("r3, r2,r3,") == ["r2", "r3"]
    with pytest.raises(ConfigError, match="'r9' is unknown; known are r11, r2, r1, r3"):
        select(config, "r2,r9")
    with pytest.raises(ConfigError, match="none is chosen; known are r11"):
        select(config, " ,")


def test_a_fleet_without_robots_is_one_to_begin_with(tmp_path: Path) -> None:
    text = 'fleet = "a"\nimage = "i"\nbundle = "b"\nworld = "w"\n\n[robot.autopilot]\n'
    path = fleet_file(tmp_path, text + 'url = "udpin://127.0.0.1:14551"')
    with pytest.raises(ConfigError, match="the file has no robots yet"):
        select(load_fleet(path), None)
    add_robot(path, "r1", "10.0.0.1", 1)
    assert [robot.host for robot in select(load_fleet(path), None)] == ["10.0.0.1"]


# A new file


def test_a_new_file_is_the_fleet_that_was_meant(tmp_path: Path) -> None:
    path = tmp_path / "fleet.toml"
    written = write_fleet(path, "Made by a test.", mapping())
    assert path.read_text().startswith("# Made by a test.\n")
    assert written == load_fleet(path)
    assert robot_toml(written, "r1") == robot_toml(load_fleet(EXAMPLE), "r1")


def test_a_file_that_would_be_wrong_is_not_written(tmp_path: Path) -> None:
    path = tmp_path / "fleet.toml"
    tables = mapping()
    tables["robots"]["r2"]["robot_id"] = 1
    with pytest.raises(ConfigError, match=r"robots\.r2: robot_id = 1: robot r1 has it too"):
        write_fleet(path, "", tables)
    assert not path.exists()


def test_a_robot_may_have_its_files_elsewhere(tmp_path: Path) -> None:
    config = load_fleet(EXAMPLE)
    places = RobotPaths("/policy", "field.env", "who", "kept", "127.0.0.1")
    write_robot(tmp_path / "r2" / "robot.toml", config, "r2", places)
    robot = load_config(tmp_path / "r2" / "robot.toml")
    assert (robot.policy.bundle, robot.policy.world, robot.log.folder) == (
        "/policy", str(tmp_path / "r2" / "field.env"), str(tmp_path / "r2" / "kept"),
    )  # fmt: skip
    assert robot.link.listen == ("tls/127.0.0.1:7447",)
    assert robot.link.connect == config.robot_config("r2").link.connect


# Edits


def changed_lines(old: str, new: str) -> list[str]:
    lines = difflib.unified_diff(old.splitlines(), new.splitlines(), n=0, lineterm="")
    return [line for line in itertools.islice(lines, 2, None) if not line.startswith("@@")]


def test_a_robot_is_added_and_nothing_else_changes(tmp_path: Path) -> None:
    path = fleet_file(tmp_path, example())
    path.chmod(0o640)
    link = tmp_path / "link.toml"
    link.symlink_to(path)
    add_robot(link, "r12", "drone12", 12, user="voxl", port=2222, address="10.0.0.12")
    assert changed_lines(example(), path.read_text()) == [
        "+[robots.r12]",
        '+host = "drone12"',
        "+robot_id = 12",
        '+user = "voxl"',
        "+port = 2222",
        '+address = "10.0.0.12"',
        "+",
    ]
    assert "\n\n[robots.r12]\n" in path.read_text()
    assert "\n\n# Who flies where" in path.read_text()
    assert link.is_symlink()
    assert path.stat().st_mode & 0o777 == 0o640
    added = path.read_bytes()
    add_robot(path, "r12", "drone12", 12, user="voxl", port=2222)
    assert path.read_bytes() == added
    for other in ({"port": 22}, {"address": "10.0.0.13"}):
        with pytest.raises(ConfigError, match="exists already"):
            add_robot(path, "r12", "drone12", 12, user="voxl", **other)


@pytest.mark.parametrize("ending", ["", "\n", "\n\n"])
def test_a_robot_is_added_where_there_are_no_slots(tmp_path: Path, ending: str) -> None:
    text = example().partition("# Who flies")[0].rstrip() + ending
    path = fleet_file(tmp_path, text)
    add_robot(path, "r12", "10.0.0.12", 12)
    added = text.rstrip() + '\n\n[robots.r12]\nhost = "10.0.0.12"\nrobot_id = 12\n'
    assert path.read_text() == added


def test_slots_change_hands(tmp_path: Path) -> None:
    path = fleet_file(tmp_path, example())
    assign(path, 1, "r11")
    assert changed_lines(example(), path.read_text()) == ['-robot = "r2"', '+robot = "r11"']
    assign(path, 0, None)
    line = '"r1"  # empty: the slot is free'
    assert path.read_text() == example('robot = "r2"', 'robot = "r11"').replace(
        line, line.replace("r1", "")
    )
    assign(path, 0, "r2")
    sitting = [slot.robot for slot in load_fleet(path).slots]
    assert sitting == ["r2", "r11", "r3"]
    there = path.stat()
    assign(path, 0, "r2")
    assert path.stat() == there


def test_a_slot_without_the_key_gets_it_first(tmp_path: Path) -> None:
    text = example('[[slots]]\nrobot = "r2"', "# Free.\n[[slots]]  # here\n# Quiet.")
    path = fleet_file(tmp_path, text.replace('robot = "r3"', '  # Last.\nrobot = "r3"'))
    before = path.read_text()
    assign(path, 1, None)
    assert path.read_text() == before
    assign(path, 1, "r11")
    assert changed_lines(before, path.read_text()) == ['+robot = "r11"']
    assert '[[slots]]  # here\nrobot = "r11"\n# Quiet.\n' in path.read_text()


def test_slots_may_be_written_inline(tmp_path: Path) -> None:
    head = example().partition("# The robots:")[0]
    text = """
slots = [{pad_m = [2, 2], landing_point_m = [4, 4]}]
robots = {r1 = {host = "10.0.0.1", robot_id = 1}}
"""
    path = fleet_file(tmp_path, head.replace("\n[robot]\n", text + "\n[robot]\n"))
    assign(path, 0, "r1")
    assert load_fleet(path).slots[0].robot == "r1"
    before = path.read_bytes()
    with pytest.raises(ConfigError, match=r"robots\.r2: can only be added where"):
        add_robot(path, "r2", "10.0.0.2", 2)
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("arguments", "names"),
    [
        (("r1", "10.0.0.9", 1), ["robots.r1: exists already", "192.168.8.11"]),
        (("r12", "10.0.0.9", 1), ["robots.r12: robot_id = 1: robot r1 has it too"]),
        (("r12", "-x", 12), ["robots.r12: host = '-x'"]),
        (("r12", "alias", 12), ["robots.r12: address is missing"]),
        (("r.12", "10.0.0.9", 12), ["robots: key = 'r.12'"]),
        (("r\n", "10.0.0.9", 12), ["robots: key = 'r\\n'"]),
        ((1, "r11"), None),
        ((0, "r2"), ["slots[1]: robot = 'r2': slots[0] has it too"]),
        ((0, "r9"), ["slots[0]: robot = 'r9': is not in [robots]"]),
        ((3, "r11"), ["slots[3]: there are 3 slots"]),
        ((-1, "r11"), ["slots[-1]: there are 3 slots"]),
    ],
)
def test_a_change_that_would_be_wrong_leaves_the_file(
    tmp_path: Path, arguments: tuple[Any, ...], names: list[str] | None
) -> None:
    path = fleet_file(tmp_path, example())
    edit = assign if isinstance(arguments[0], int) else add_robot
    if names is None:
        edit(path, *arguments)
        assert path.read_text() != example()
    else:
        with pytest.raises(ConfigError) as caught:
            edit(path, *arguments)
        message = one_line(str(caught.value), path)
        assert all(name in message for name in names)
        assert path.read_text() == example()
    assert list(tmp_path.iterdir()) == [path]


def test_changes_at_once_are_all_kept(tmp_path: Path) -> None:
    path = fleet_file(tmp_path, example())
    ids = range(20, 28)
    threads = [
        threading.Thread(target=add_robot, args=(path, f"r{i}", f"10.0.0.{i}", i)) for i in ids
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert {f"r{i}" for i in ids} < set(load_fleet(path).robots)
