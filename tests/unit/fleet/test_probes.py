"""Output of the robot's tools, parsed: any numbers and names, cut off anywhere."""

import asyncio
import dataclasses
import json
import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.messages.codes import CheckCode, FailedCheck
from lpac.fleet import doctor, probes, up
from lpac.fleet.settings import load_fleet
from tests.conftest import ROOT
from tests.local_session import LocalSession

NAMES = st.from_regex(r"[a-z][a-z0-9-]{0,14}", fullmatch=True)
ANYTHING = st.text(max_size=200)


@given(sent=st.integers(1, 500), share=st.floats(0.0, 1.0), mean_ms=st.floats(0.01, 5000.0))
def test_ping_tells_loss_and_times(sent: int, share: float, mean_ms: float) -> None:
    received = round(share * sent)
    text = (
        "PING 10.0.0.2 (10.0.0.2) 56(84) bytes of data.\n\n--- 10.0.0.2 ping statistics ---\n"
        f"{sent} packets transmitted, {received} received, {100 - 100 * received // sent}% packet "
        "loss, time 1836ms\n"
    )
    if received:
        text += f"rtt min/avg/max/mdev = 0.031/{mean_ms:.3f}/{2 * mean_ms:.3f}/0.020 ms, pipe 2\n"
    found = probes.ping_summary(text)
    assert found["loss"] == pytest.approx(1.0 - received / sent)
    if received:
        assert found["mean_ms"] == pytest.approx(mean_ms, abs=0.001)
        assert found["max_ms"] == pytest.approx(2 * mean_ms, abs=0.001)
    else:
        assert found["mean_ms"] is None


def test_ping_with_errors_and_duplicates() -> None:
    errors = "10 packets transmitted, 0 received, +3 errors, 100% packet loss, time 9ms\n"
    assert probes.ping_summary(errors)["loss"] == 1.0
    twice = (
        "5 packets transmitted, 6 received, +1 duplicates, 0% packet loss, time 9ms\n"
        "rtt min/avg/max/mdev = 1.0/2.0/3.0/0.1 ms\n"
    )
    assert probes.ping_summary(twice) == {"loss": 0.0, "mean_ms": 2.0, "max_ms": 3.0}
    assert probes.ping_summary("connect: Network is unreachable\n")["loss"] == 1.0


@given(name=NAMES, level=st.integers(-110, -1))
def test_the_signal_of_the_kernels_table(name: str, level: int) -> None:
    text = (
        "Inter-| sta-|   Quality        |   Discarded packets               | Missed | WE\n"
        " face | tus | link level noise |  nwid  crypt   frag  retry   misc | beacon | 22\n"
        f" {name}: 0000   70.  {level}.  -256        0      0      0      0     12        0\n"
    )
    assert probes.wireless(text) == {name: level}


@given(
    network=st.from_regex(r"[A-Za-z0-9]([A-Za-z0-9 _.-]{0,20}[A-Za-z0-9])?", fullmatch=True),
    signal=st.integers(-110, -1),
    rate=st.floats(1.0, 2000.0),
)
def test_iw_tells_the_network(network: str, signal: int, rate: float) -> None:
    text = (
        "Connected to 70:4f:57:00:aa:01 (on wlan0)\n"
        f"\tSSID: {network}\n\tfreq: 5180\n\tRX: 9384 bytes (31 packets)\n"
        f"\tsignal: {signal} dBm\n\ttx bitrate: {rate:.1f} MBit/s VHT-MCS 9 80MHz VHT-NSS 2\n"
    )
    found = probes.iw_link(text)
    assert found["connected"] is True
    assert found["network"] == network
    assert found["signal_dbm"] == signal
    assert found["rate_mbit_s"] == float(f"{rate:.1f}")
    assert found["frequency_mhz"] == 5180.0


def test_iw_without_a_network_or_not_there() -> None:
    assert probes.iw_link("Not connected.\n")["connected"] is False
    assert probes.iw_link("")["connected"] is None


@given(active_ms=st.integers(0, 10**9), busy_ms=st.integers(0, 10**9), at=st.integers(0, 2))
def test_iw_tells_of_the_channel_in_use(active_ms: int, busy_ms: int, at: int) -> None:
    used = (
        "Survey data from wlan0\n\tfrequency:\t\t\t5180 MHz [in use]\n\tnoise:\t\t\t\t-95 dBm\n"
        f"\tchannel active time:\t\t{active_ms} ms\n\tchannel busy time:\t\t{busy_ms} ms\n"
        "\tchannel receive time:\t\t900 ms\n\tchannel transmit time:\t\t34 ms\n"
    )
    other = (
        "Survey data from wlan0\n\tfrequency:\t\t\t5200 MHz\n\tnoise:\t\t\t\t-93 dBm\n"
        "\tchannel active time:\t\t121 ms\n\tchannel busy time:\t\t119 ms\n"
    )
    blocks = [other, other]
    blocks.insert(at, used)
    found = probes.iw_survey("".join(blocks))
    assert found == {"active_ms": float(active_ms), "busy_ms": float(busy_ms)}


@pytest.mark.parametrize(
    "text",
    [
        "",
        "command failed: Operation not supported (-95)\n",
        # Of a driver that only measures noise.
        "Survey data from wlan0\n\tfrequency:\t\t\t5180 MHz [in use]\n\tnoise:\t\t\t\t-95 dBm\n",
        "Survey data from wlan0\n\tfrequency:\t\t\t5200 MHz\n\tchannel active time:\t\t121 ms\n",
    ],
)
def test_iw_that_does_not_count_the_channels_time(text: str) -> None:
    assert probes.iw_survey(text) == {"active_ms": None, "busy_ms": None}


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-1000, 1000) | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner),
    max_leaves=8,
)
COMMENTS = st.sampled_from(
    ["/* waits */", "/**\n * The options:\n * \"off\", 'figure_eight'\n */\n", "// to the end\n"]
)


@given(
    values=st.dictionaries(st.text(max_size=20), VALUES), comment=COMMENTS, indent=st.integers(0, 8)
)
def test_comments_in_json_are_left_out_but_not_in_strings(
    values: dict[str, Any], comment: str, indent: int
) -> None:
    values["url"] = "udp://127.0.0.1 /* no comment */"
    text = comment + json.dumps(values, indent=indent).replace(",\n", f",\n{comment}") + comment
    # A string with a line's end in it has it escaped, so that only ends of lines were replaced.
    assert json.loads(probes.without_comments(text)) == values


@given(
    st.dictionaries(
        NAMES, st.tuples(st.booleans(), st.booleans(), st.booleans()), min_size=1, max_size=5
    )
)
def test_units(wanted: dict[str, tuple[bool, bool, bool]]) -> None:
    blocks = [
        f"Id={name}.service\nLoadState={'loaded' if there else 'not-found'}\n"
        f"ActiveState={'active' if active else 'inactive'}\n"
        f"UnitFileState={'enabled' if enabled else 'disabled'}\n"
        for name, (there, active, enabled) in wanted.items()
    ]
    assert probes.units_of("\n".join(blocks)) == {
        name: {"there": there, "active": active, "enabled": enabled}
        for name, (there, active, enabled) in wanted.items()
    }


@given(
    name=NAMES,
    image=NAMES,
    running=st.booleans(),
    policy=st.sampled_from(["no", "always", "unless-stopped", "on-failure"]),
    network=st.sampled_from(["host", "bridge", "none"]),
    bind=st.sampled_from(["/dev", "/dev/ttyS1:/dev/ttyS1", "/home/root:/data", "/devices:/x"]),
)
def test_containers(
    name: str, image: str, running: bool, policy: str, network: str, bind: str
) -> None:
    inspected = {
        "Name": f"/{name}",
        "Config": {"Image": image},
        "State": {"Running": running},
        "HostConfig": {
            "NetworkMode": network,
            "RestartPolicy": {"Name": policy, "MaximumRetryCount": 0},
            "Binds": [bind],
            "Devices": None,
            "Privileged": False,
        },
    }
    assert probes.containers_of(json.dumps([inspected])) == [
        {
            "name": name,
            "image": image,
            "running": running,
            "restarts": policy,
            "host_network": network == "host",
            "devices": bind.startswith(("/dev:", "/dev/")) or bind == "/dev",
        }
    ]


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("         System clock synchronized: yes\n", True),
        ("      System clock synchronized: no\nsystemd-timesyncd.service active: no\n", False),
        ("NTP enabled: no\nNTP synchronized: yes\n", True),
        ("Failed to create bus connection\n", None),
    ],
)
def test_timedatectl(text: str, wanted: bool | None) -> None:
    assert probes.synchronized(text) is wanted


@given(total=st.integers(1, 10**8), available=st.integers(0, 10**8))
def test_memory(total: int, available: int) -> None:
    text = f"MemTotal:  {total} kB\nMemFree:   12 kB\nMemAvailable:   {available} kB\n"
    found = probes.memory(text)
    assert found == {"total_bytes": 1024.0 * total, "available_bytes": 1024.0 * available}
    assert probes.memory("MemTotal: 12 kB\n") is None


@given(ANYTHING)
def test_nothing_that_a_tool_prints_is_a_mistake_of_ours(text: str) -> None:
    assert 0.0 <= probes.ping_summary(text)["loss"] <= 1.0
    assert all(level is None or math.isfinite(level) for level in probes.wireless(text).values())
    probes.iw_link(text)
    probes.iw_survey(text)
    probes.units_of(text)
    probes.memory(text)
    probes.synchronized(text)
    probes.systemd_version(text)
    probes.without_comments(text)
    probes.vision_hub(text)
    probes.disks_of(text)
    probes.hottest_c(text)
    probes.wifi_of(text)
    probes.containers_of(text)


def test_systemd_version() -> None:
    assert probes.systemd_version("systemd 237\n+PAM +AUDIT\n") == 237
    assert probes.systemd_version("systemd 252 (252.39-1~deb12u1)\n") == 252
    assert probes.systemd_version("") is None


class Robot(LocalSession):
    """On the ground, with a program that says one thing after another."""

    def __init__(self, *states: dict[str, Any]) -> None:
        self.states = list(states)
        self.ran: list[str] = []

    async def call(self, function: str, **arguments: object) -> dict[str, Any]:
        if function == "service":
            return self.states.pop(0)
        if function == "run":
            self.ran.append(arguments["command"][2])  # type: ignore[index]
        return {} if function == "require_disarmed" else {"code": 0, "out": "", "err": ""}


def test_a_clock_is_set_by_its_offset(monkeypatch: pytest.MonkeyPatch) -> None:
    # The only clock here is this machine's.
    robot, config = Robot(), load_fleet(ROOT / "docs" / "fleet.toml")
    set_to: list[float] = []
    monkeypatch.setattr("time.clock_gettime", lambda _: 1000.0)
    monkeypatch.setattr("time.clock_settime", lambda _, seconds: set_to.append(seconds))
    asyncio.run(up.set_clock(robot, config.robots["r1"], -20.0))
    exec(robot.ran[0])
    assert set_to == [1020.0]


def test_a_program_is_waited_for_until_it_has_looked() -> None:
    told = [CheckCode.CHECKS_RUNNING, CheckCode.FAILSAFE_NOT_READ, CheckCode.GPS_NO_FIX]

    def said(code: CheckCode) -> dict[str, Any]:
        check = dataclasses.asdict(FailedCheck(code, "x"))
        return {"fresh": True, "status": {"failed_checks": [check]}}

    robot = Robot(*map(said, told[1:]))
    assert asyncio.run(doctor._settled(robot, said(told[0]))) == said(CheckCode.GPS_NO_FIX)


def test_ports_that_others_reach() -> None:
    text = (
        'udp UNCONN 0 0 0.0.0.0:14556 0.0.0.0:* users:(("voxl-mavlink-s",pid=7,fd=3))\n'
        'udp UNCONN 0 0 127.0.0.1:14551 0.0.0.0:* users:(("python3",pid=8,fd=3))\n'
        'tcp LISTEN 0 128 [::]:22 [::]:* users:(("sshd",pid=9,fd=4))\n'
        "tcp LISTEN 0 128 [::1]:631 [::]:*\n"
        "tcp LISTEN 0 128 *:80 *:*\n"
    )
    assert probes.open_ports(text) == [
        {"protocol": "tcp", "port": 22, "program": "sshd"},
        {"protocol": "tcp", "port": 80, "program": "?"},
        {"protocol": "udp", "port": 14556, "program": "voxl-mavlink-s"},
    ]


@given(ANYTHING)
def test_whatever_ss_prints_names_no_port_or_some(text: str) -> None:
    assert isinstance(probes.open_ports(text), list)


def test_what_tools_seldom_print() -> None:
    """A level that is no dBm, a network without an access point, a unit that starts, devices."""
    assert probes.wireless("\n\n wlan0: 0000   54.   200.  0\n") == {"wlan0": None}
    assert probes.iw_link("Joined IBSS 02:11:22:33:44:55 (on wlan0)\n")["connected"] is True
    starting = "Id=a.service\nLoadState=loaded\nActiveState=activating\n"
    assert probes.units_of(starting) == {"a": {"there": True, "active": True, "enabled": False}}
    told = json.dumps([{"Name": "/box", "HostConfig": {"Privileged": True}}])
    (box,) = probes.containers_of(told) or []
    assert box["devices"]
