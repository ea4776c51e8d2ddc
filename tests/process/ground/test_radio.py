"""`lpac fleet radio` on robots that fly in this process, over real zenoh and a real ground."""

import json
import os
import re
import subprocess
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from edge.messages.topics import MESSAGE, Topic
from lpac.ground.station.protocol import SetOrigin
from lpac.radio.records import read_records
from lpac.sim.air import Subscriptions
from lpac.sim.fleet.robots import OpenLink, SimulatedRobot
from tests.host.fleet.field import lpac_fleet
from tests.live import ORIGIN, FlownFleet
from tests.process.ground.conftest import GroundStation, all_heard

NAMES = ("r0", "r1", "r2")


class ThinAir(FlownFleet):
    """Of what each robot of `muffled` tells the others every second message is lost."""

    muffled: frozenset[int] = frozenset()

    def _open_link(self, robot: SimulatedRobot, subscriptions: Subscriptions) -> OpenLink:
        return _ThinLink(super()._open_link(robot, subscriptions), self, robot.config.robot_id)


class _ThinLink:
    def __init__(self, link: OpenLink, fleet: ThinAir, robot_id: int) -> None:
        self._link, self._fleet, self._robot_id = link, fleet, robot_id
        self._count = 0
        self.is_claimed, self.peers, self.refused = link.is_claimed, link.peers, link.refused
        self.close = link.close

    def publish(self, topic: Topic, data: bytes) -> None:
        if topic is MESSAGE and self._robot_id in self._fleet.muffled:
            self._count += 1
            if self._count % 2:
                return
        self._link.publish(topic, data)


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ThinAir]:
    """Three robots r0, r1, r2, and r3, a spare."""
    with ThinAir(tmp_path_factory.mktemp("air"), 3, spares=1) as running:
        yield running


@pytest.fixture(scope="module")
def deaf(fleet: ThinAir) -> Iterator[GroundStation]:
    """Their ground, before there is an origin."""
    # A socket's path must be short.
    with tempfile.TemporaryDirectory(prefix="lpac-") as runtime:
        log = fleet.folder / "ground.log"
        station = GroundStation(fleet.fleet_toml, Path(runtime), "alice", log)
        station.start()
        try:
            station.wait_for(all_heard)
            yield station
        finally:
            station.kill()


@pytest.fixture(scope="module")
def station(deaf: GroundStation) -> GroundStation:
    """Their ground, when robots know where they are."""
    assert deaf.command(SetOrigin(ORIGIN)).done
    deaf.wait_for(
        lambda p: all(r.status and len(r.status.neighbour_messages) == 3 for r in p.robots)
    )
    return deaf


Answer = subprocess.CompletedProcess[str]


def ask(
    station: GroundStation, fleet: FlownFleet, *options: object, path: str | None = None
) -> Answer:
    environment = {"XDG_RUNTIME_DIR": str(station.runtime)}
    if path is not None:
        environment["PATH"] = path
    return lpac_fleet(fleet.fleet_toml, "radio", *options, environment=environment)


def told(answer: Answer) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(answer.stdout)
    return found


def test_without_an_origin_the_operator_is_told_what_to_do_first(
    fleet: ThinAir, deaf: GroundStation
) -> None:
    answer = ask(deaf, fleet)
    assert (answer.returncode, answer.stdout) == (1, "")
    assert answer.stderr.splitlines()[-1] == (
        "lpac: radio: r0, r1, r2: no mission origin, and so no position to send: first "
        "`lpac mission origin`"
    )


def test_without_a_ground_it_says_so(fleet: ThinAir, tmp_path: Path) -> None:
    answer = lpac_fleet(fleet.fleet_toml, "radio", environment={"XDG_RUNTIME_DIR": str(tmp_path)})
    assert answer.returncode == 1
    assert "start `lpac ground`" in answer.stderr


def test_idle_robots_on_the_ground_speak_as_in_a_mission(
    fleet: ThinAir, station: GroundStation, tmp_path: Path
) -> None:
    records = tmp_path / "radio.jsonl"
    answer = ask(
        station, fleet, "--seconds", 12, "--json", "--record", records, "--out", tmp_path / "out"
    )
    found = told(answer)
    assert found["transport"] == "mesh"
    assert {(p["receiver"], p["sender"]) for p in found["pairs"]} == {
        (a, b) for a in NAMES for b in NAMES if a != b
    }
    # What a held-up machine makes late is late, but nothing is lost.
    for pair in found["pairs"]:
        assert pair["sent"] >= 10
        assert pair["delivered"] >= 0.8
        assert pair["age_p50_s"] is not None
    room = found["room"]
    assert 1.5 <= room["message_hz"] <= 3.5
    # The shipped policy's, with beacon.
    assert 1000.0 <= room["ground_bytes"] <= room["flight_bytes"] <= 4000.0
    assert not room["rate_told"] and room["busy_share"] is None
    assert answer.returncode == (0 if found["ok"] else 1)
    if found["ok"]:
        assert found["sentence"].startswith("carries 3 robots; by the model there is room for ")
    kept = read_records(records)
    assert len(kept) == 6
    assert {record.distance_m for record in kept} != {None}
    assert (tmp_path / "out" / "radio.png").stat().st_size > 10_000


def test_who_is_heard_badly_is_named(fleet: ThinAir, station: GroundStation) -> None:
    fleet.muffled = frozenset({1})
    try:
        answer = ask(station, fleet, "--seconds", 10)
    finally:
        fleet.muffled = frozenset()
    assert answer.returncode == 1
    last = answer.stderr.splitlines()[-1]
    assert last.startswith("lpac: radio: the others hear ") and " of r1" in last
    assert "arrived, %: a row receives, a column sends" in answer.stdout


# Robots' computers are this machine's shell, with a radio that is busy three tenths of the time.
PROGRAMS = {
    "ssh": """for last; do :; done
case "$last" in
*/dev/zero*) while head -c 100000 /dev/zero; do sleep 0.1; done ;;
*) exec sh -c "$last" ;;
esac
""",
    "sudo": 'shift\nexec "$@"\n',
    "iw": """case "$*" in
dev) printf 'phy#0\\n\\tInterface wlan0\\n\\t\\tifindex 3\\n\\t\\ttype managed\\n' ;;
*link) printf 'Connected to 70:4f:57:00:aa:01 (on wlan0)\\n\\tSSID: field\\n\\tfreq: 5180\\n'
  printf '\\tsignal: -58 dBm\\n\\ttx bitrate: 144.4 MBit/s VHT-MCS 7 short GI VHT-NSS 2\\n' ;;
*survey*) ms=$(date +%s%3N)
  printf 'Survey data from wlan0\\n\\tfrequency:\\t\\t\\t5180 MHz [in use]\\n'
  printf '\\tchannel active time:\\t\\t%d ms\\n' $ms
  printf '\\tchannel busy time:\\t\\t%d ms\\n' $((ms * 3 / 10)) ;;
esac
""",
}


@pytest.fixture
def computers(fleet: ThinAir, tmp_path: Path) -> Iterator[str]:
    """The PATH with which robots are such computers."""
    before = fleet.fleet_toml.read_text()
    text = re.sub(
        r'host = "r(\d)\.invalid"', lambda found: f'host = "127.0.0.{int(found[1]) + 1}"', before
    )
    fleet.fleet_toml.write_text(text)
    folder = tmp_path / "programs"
    folder.mkdir()
    for name, script in PROGRAMS.items():
        program = folder / name
        program.write_text(f"#!/bin/sh\n{script}")
        program.chmod(0o755)
    yield f"{folder}:{os.environ['PATH']}"
    fleet.fleet_toml.write_text(before)


def test_radios_tell_of_signal_rate_and_channel_and_a_bulk_stream_is_told(
    fleet: ThinAir, station: GroundStation, computers: str
) -> None:
    def listen(*options: str) -> dict[str, Any]:
        return told(ask(station, fleet, "--seconds", 10, "--json", *options, path=computers))

    with ThreadPoolExecutor() as pool:
        with_load = pool.submit(listen, "--load")
        found, loaded = listen(), with_load.result()
    for robot in found["robots"].values():
        assert robot["wifi_problem"] is None
        assert robot["wifi"] == {
            "rate_mbit_s": 144.4, "signal_dbm": -58.0, "busy_share": pytest.approx(0.3, abs=0.01)
        }  # fmt: skip
    room = found["room"]
    assert room["rate_told"]
    assert room["rate_mbit_s"] == pytest.approx(144.4)
    assert room["busy_share"] == pytest.approx(0.3, abs=0.01)
    assert loaded["bulk_stream"]["robot"] == "r0"
    assert loaded["bulk_stream"]["rate_mbit_s"] > 0.0
    assert loaded["room"]["busy_share"] is None


def test_a_bulk_stream_that_breaks_off_is_told(
    fleet: ThinAir, station: GroundStation, computers: str
) -> None:
    ssh = Path(computers.partition(":")[0], "ssh")
    ssh.write_text("#!/bin/sh\necho 'ssh: connect: Connection refused' >&2\nexit 255\n")
    answer = ask(station, fleet, "--seconds", 10, "--load", path=computers)
    assert answer.returncode == 1
    assert answer.stderr.splitlines()[-1] == (
        "lpac: bulk stream from r0: nothing listens on its ssh port"
    )


def test_robots_of_a_simulated_fleet_have_no_computer_to_load_the_radio_from(
    fleet: ThinAir, station: GroundStation
) -> None:
    answer = ask(station, fleet, "--load")
    assert answer.returncode == 1
    assert answer.stderr.splitlines() == [
        "lpac: --load: no robot has a computer that could send a bulk stream"
    ]
