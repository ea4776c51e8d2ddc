"""robot.toml: what is in it, and one clear line for every mistake."""

import re
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.frames import ModelScale
from edge.core.schema import ConfigError
from edge.core.wire import FLOAT_PAYLOADS
from edge.robot.config import LinkConfig, PolicyConfig, load_config
from edge.robot.pac import PacParameters
from tests.conftest import ROOT

EXAMPLE = ROOT / "docs" / "robot.toml"
# A value that is commented out, at the start of its line, and the head of such a table.
COMMENTED_OUT = re.compile(r"^# ((?:\w+ = |\[\w+\]).*)$", re.MULTILINE)


def refusal(tmp_path: Path, text: str) -> str:
    """Why a file with this text is not taken, without the file's name, which comes first."""
    path = tmp_path / "robot.toml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"{path}: ")
    return message.removeprefix(f"{path}: ")


def with_line(old: str, new: str) -> str:
    text = EXAMPLE.read_text()
    assert text.count(old) == 1, old
    return text.replace(old, new)


def test_the_example_is_complete_and_shows_the_defaults(tmp_path: Path) -> None:
    spelled_out = tmp_path / "robot.toml"
    spelled_out.write_text(COMMENTED_OUT.sub(r"\1", EXAMPLE.read_text()))
    short, long = load_config(EXAMPLE), load_config(spelled_out)
    tables = tomllib.loads(spelled_out.read_text())
    for name, value in tables.items():
        mine, theirs = getattr(short, name), getattr(long, name)
        if not isinstance(value, dict):
            assert mine == theirs
            continue
        keys = set(type(theirs).__dataclass_fields__)
        assert set(value) == keys, name
        paths = {"bundle", "world", "folder"}
        assert all(getattr(mine, k) == getattr(theirs, k) for k in keys - paths), name
    assert set(tables) == set(type(long).__dataclass_fields__)


def test_relative_paths_are_meant_from_the_files_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    config = load_config(EXAMPLE)
    assert Path(config.policy.bundle).samefile(ROOT / "policies" / "field" / "field")
    assert config.policy.world == str(EXAMPLE.parent / "world.env")
    assert config.log.folder == str(EXAMPLE.parent / "logs")
    (tmp_path / "robot.toml").write_text(
        with_line('world = "world.env"', 'world = "/srv/world.env"') + '\n[log]\nfolder = "here"\n'
    )
    config = load_config(Path("robot.toml"))
    assert config.policy.world == "/srv/world.env"
    assert config.log.folder == str(tmp_path / "here")


@pytest.mark.parametrize(
    ("old", "new", "names"),
    [
        ("robot_id = 0", "robot_id = -1", ["robot_id = -1", "0 to 65535"]),
        ("robot_id = 0", 'robot_id = "0"', ["robot_id", "'0'", "a whole number"]),
        ("robot_id = 0", "robot_ids = 0", ["unknown key 'robot_ids'", "robot_id,"]),
        ('fleet = "demo"', "", ["fleet is missing"]),
        ('fleet = "demo"', 'fleet = "a/b"', ["fleet = 'a/b'", "letters"]),
        ('fleet = "demo"', f'fleet = "{"a" * 33}"', ["fleet = ", "1 to 32"]),
        ("system_id = 1", "system_id = 0", ["autopilot: system_id = 0", "1 to 255"]),
        ("127.0.0.1:14551", "127.0.0.1", ["autopilot: url", "udpin://ADDRESS:PORT"]),
        ("127.0.0.1:14551", "127.0.0.1:99999", ["autopilot: url", "1 to 65535"]),
        ("127.0.0.1:14551", "127.0.0.1:0", ["autopilot: url", "1 to 65535"]),
        ('"tls/0.0.0.0:7447"', '"0.0.0.0:7447"', ["link: listen", "tcp/ADDRESS:PORT"]),
        (
            '"tls/0.0.0.0:7447"',
            '"tls/127.0.0.011:7447"',
            ["link: listen = '127.0.0.011': looks like an address", "leading zeros"],
        ),
        ("connect = []", 'connect = ["tls/10.1:7447"]', ["link: connect = '10.1': looks like"]),
        (
            "connect = []",
            'connect = ["tcp/10.0.0.1:7447"]',
            ["link: connect = 'tcp/10.0.0.1:7447': must be tls"],
        ),
        (
            "connect = []",
            'connect = []\ngroup = "239.1.2.3:0"\ninterface = "10.0.0.1"',
            ["link: group = '239.1.2.3:0'", "1 to 65535"],
        ),
        ("connect = []", 'connect = ["tls/10.0.0.1:\u0667"]', ["connect = ", "tls/ADDRESS:PORT"]),
        (
            "connect = []",
            'connect = []\ngroup = "239.1.2.3:7450"\ninterface = "10.0.0.01"',
            ["link: interface = '10.0.0.01': must be the robot's own IPv4 address"],
        ),
        ("127.0.0.1:14551", "0.0.0.0:14551", ["autopilot: url", "pose as", "insecure = true"]),
        ("127.0.0.1:14551", "192.168.8.11:14551", ["autopilot: url", "insecure = true"]),
        ("127.0.0.1:14551", "127.0.0.011:14551", ["autopilot: url = '127.0.0.011': looks like"]),
        ('["tls/0.0.0.0:7447"]', "[]", ["link: listen, connect and scouting"]),
        ('"/var/lib/lpac/identity"', '""', ["[identity] folder is missing", "insecure = true"]),
        (
            "# insecure = false  # true: tcp",
            "insecure = true # tcp",
            ["link.insecure = true: not with [identity]"],
        ),
        ("slot = 0", "slot = 40", ["slot = 40", "185 m", "ceiling_m = 30"]),
        ("[4.0, 4.0]", "[40.0, 4.0]", ["landing_point_m", "inside the fence"]),
        ("[4.0, 4.0]", "[4.0]", ["flight: landing_point_m = [4.0]", "[x, y]"]),
        ("[34.0, 34.0]", "[8.0, 8.0]", ["fence: vertices_m", "convex"]),
        ("ceiling_m = 30.0", "ceiling_m = 1.0", ["fence: ceiling_m = 1.0", "floor_m = 2.0"]),
        ("lag_s = 1.3", "lag_s = nan", ["limits: lag_s = nan", "finite"]),
        ("lag_s = 1.3", "lag_s = true", ["limits: lag_s", "True", "a number"]),
        ('rc = "pilot"', 'rc = "maybe"', ["failsafe: rc = 'maybe'", "'pilot', 'none'"]),
        ("# fence_margin_m = 5.0", "fence_margin_m = -1.0", ["failsafe: fence_margin_m = -1.0"]),
        ("# command_timeout_s = 0.5", "command_timeout_s = 0.1", ["command_timeout_s = 0.1"]),
        ("# command_timeout_s = 0.5", "command_timeout_s = 0.8", ["command_timeout_s = 0.8"]),
        ("buffer_m = 1.5", "buffer_m = 1.3", ["buffer_m = 1.3: must be 1.38 m", "wind carries it"]),
        (
            "# base_height_m = 5.0",
            "base_height_m = 4.7",
            ["at 4.7 m: must be 4.75 m"],
        ),
        (
            "# fence_margin_m = 5.0",
            "fence_margin_m = 2.7",
            ["margin_m = 2.7: must be 2.77 m"],
        ),
        ("# [errors]", "[errors]\nwind_m = 1.0", ["buffer_m = 1.5: must be 1.63 m"]),
        ("# [errors]", "[errors]\ngps_m = -1.0", ["errors: gps_m = -1.0: must be at least 0"]),
        ("# [errors]", "[errors]\ndrone_m = 0.0", ["errors: drone_m = 0.0: must be above 0"]),
        ("# [errors]", "[errors]\nheight_m = 1.0", ["errors: unknown key 'height_m'", "gps_m"]),
        ("# [rates]", "[rates]\ncontrol_hz = 2.0", ["rates: control_hz = 2.0", "4 Hz"]),
        ("# [rates]", "[rates]\npolicy_hz = inf", ["rates: policy_hz = inf", "0.1 to 100"]),
        ("# [log]", "[log]\nmax_total_mb = 5", ["log: max_total_mb = 5", "at least 50"]),
        ("# [reach]", "[reach]\nceiling_m = 0.0", ["reach: ceiling_m = 0.0: must be above 0"]),
        ("# [log]", "[[log]]", ["log", "expected a table"]),
        ("# payload", 'payload = "int4" #', ["policy: payload = 'int4'", "'float16', 'int8'"]),
        ("# env_scale = 16.0", "env_scale = 0.0", ["policy: env_scale = 0.0"]),
        ("# max_message_age_s = 0.8", "max_message_age_s = -1.0", ["max_message_age_s = -1.0"]),
        ("# max_input_age_s = 1.0", "max_input_age_s = 0.0", ["max_input_age_s = 0.0"]),
        ("[policy]", "policy = 3\n[other]", ["unknown key 'other'"]),
        ("[policy]", "[policy", ["is not TOML", "line 8"]),
    ],
)
def test_a_mistake_is_one_line_that_names_it(
    tmp_path: Path, old: str, new: str, names: list[str]
) -> None:
    message = refusal(tmp_path, with_line(old, new))
    for name in names:
        assert name in message


def test_the_loop_has_the_configured_parameters() -> None:
    config = load_config(EXAMPLE)
    policy = replace(
        config.policy, env_scale=8.0, velocity_scale=0.5, max_message_age_s=0.5, max_input_age_s=1.5
    )
    config = replace(config, policy=policy, limits=replace(config.limits, max_speed_m_s=1.0))
    expected = PacParameters(ModelScale(8.0, 0.5), 1.0, 0.5, 1.5, "float16")
    assert config.pac(FLOAT_PAYLOADS) == expected


HERE, THERE = ("tcp/127.0.0.1:7447",), ("tcp/10.0.0.1:7447",)


@pytest.mark.parametrize(
    ("link", "leaves"),
    [
        (LinkConfig(listen=HERE, connect=HERE), False),
        (LinkConfig(listen=THERE), True),
        (LinkConfig(listen=HERE, connect=THERE), True),
        (LinkConfig(listen=HERE, scouting=True), True),
        # A peer that is not told where to listen does so everywhere.
        (LinkConfig(connect=HERE), True),
        (LinkConfig(listen=HERE, group="239.1.2.3:7450", interface="10.0.0.1"), True),
        (LinkConfig(listen=HERE, group="239.1.2.3:7450", interface="127.0.0.1"), False),
        (LinkConfig(type="other", listen=HERE), True),
    ],
)
def test_whether_messages_from_other_computers_may_arrive(link: LinkConfig, leaves: bool) -> None:
    assert link.leaves_machine is leaves


def test_messages_are_as_small_as_the_policy_was_judged_with() -> None:
    policy = PolicyConfig("bundle", "world.env")
    assert policy.payload_of(("int8", "float32", "float16")) == "int8"
    assert policy.payload_of(("float16", "float32")) == "float16"
    assert replace(policy, payload="float32").payload_of(FLOAT_PAYLOADS) == "float32"
    with pytest.raises(ConfigError, match=r"^policy: payload = 'int8': bundle was judged with "):
        replace(policy, payload="int8").payload_of(FLOAT_PAYLOADS)


def test_a_file_that_cannot_be_read(tmp_path: Path) -> None:
    for path in (tmp_path / "none.toml", tmp_path):
        with pytest.raises(ConfigError, match=f"^{re.escape(str(path))}: cannot be read: "):
            load_config(path)
    (tmp_path / "robot.toml").write_bytes(b'fleet = "\xff"')
    with pytest.raises(ConfigError, match="is not TOML"):
        load_config(tmp_path / "robot.toml")


VALUES: st.SearchStrategy[Any] = st.recursive(
    st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner),
    max_leaves=4,
)


@given(data=st.data())
def test_whatever_stands_there_is_taken_or_refused_in_one_line(
    data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    mapping: dict[str, Any] = tomllib.loads(COMMENTED_OUT.sub(r"\1", EXAMPLE.read_text()))
    table = data.draw(st.sampled_from(sorted(k for k, v in mapping.items() if isinstance(v, dict))))
    key = data.draw(st.sampled_from(sorted(mapping[table])))
    mapping[table][key] = data.draw(VALUES)
    path = tmp_path_factory.mktemp("config") / "robot.toml"
    path.write_text(toml(mapping))
    try:
        load_config(path)
    except ConfigError as error:
        assert str(error).startswith(f"{path}: ")
        assert "\n" not in str(error)


def toml(value: Any) -> str:
    """A TOML document of inline values."""
    return "".join(f"{inline(key)} = {inline(v)}\n" for key, v in value.items())


def inline(value: Any) -> str:
    match value:
        case bool():
            return str(value).lower()
        case str():
            escaped = "".join(
                c if c.isalnum() and c.isascii() else f"\\U{ord(c):08X}" for c in value
            )
            return f'"{escaped}"'
        case list():
            return f"[{', '.join(map(inline, value))}]"
        case dict():
            return "{" + ", ".join(f"{inline(k)} = {inline(v)}" for k, v in value.items()) + "}"
        case _:
            return repr(value)
