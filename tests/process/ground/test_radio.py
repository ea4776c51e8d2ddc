"""`lpac fleet radio` on robots that fly in this process, over real zenoh and a real ground."""

import json
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from edge.messages.topics import MESSAGE, Topic
from lpac.ground.station.protocol import SetOrigin
from lpac.radio.records import read_records
from lpac.sim.fleet.robots import OpenLink, SimulatedRobot
from lpac.sim.radio import Subscriptions
from tests.host.fleet.field import lpac_fleet
from tests.live import ORIGIN, FlownFleet
from tests.process.ground.conftest import GroundStation, NewStation, all_heard

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


@pytest.fixture
def fleet(tmp_path: Path) -> Iterator[ThinAir]:
    """Three robots r0, r1, r2, and r3, a spare."""
    with ThinAir(tmp_path, 3, spares=1) as running:
        yield running


def ask(station: GroundStation, fleet: FlownFleet, *options: object) -> "Answer":
    # A busy machine holds robots up for a moment: so long that one late message is no share.
    environment = {"XDG_RUNTIME_DIR": str(station.runtime)}
    return lpac_fleet(fleet.fleet_toml, "radio", *options, environment=environment)


Answer = subprocess.CompletedProcess[str]


def told(answer: Answer) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(answer.stdout)
    return found


def listening(fleet: FlownFleet, new_station: NewStation) -> GroundStation:
    """A ground whose robots know where they are."""
    station = new_station(fleet.fleet_toml)
    station.wait_for(all_heard)
    assert station.command(SetOrigin(ORIGIN)).done
    station.wait_for(
        lambda p: all(r.status and len(r.status.neighbour_arrivals) == 3 for r in p.robots)
    )
    return station


def test_without_an_origin_the_operator_is_told_what_to_do_first(
    fleet: ThinAir, new_station: NewStation
) -> None:
    station = new_station(fleet.fleet_toml)
    station.wait_for(all_heard)
    answer = ask(station, fleet)
    assert (answer.returncode, answer.stdout) == (1, "")
    assert answer.stderr.splitlines()[-1] == (
        "lpac: radio: r0, r1, r2: no mission origin, and so no position to speak of: first "
        "`lpac mission origin`"
    )


def test_without_a_ground_it_says_so(fleet: ThinAir, tmp_path: Path) -> None:
    answer = lpac_fleet(fleet.fleet_toml, "radio", environment={"XDG_RUNTIME_DIR": str(tmp_path)})
    assert answer.returncode == 1
    assert "start `lpac ground`" in answer.stderr


def test_idle_robots_on_the_ground_speak_as_in_a_mission(
    fleet: ThinAir, new_station: NewStation, tmp_path: Path
) -> None:
    station = listening(fleet, new_station)
    records = tmp_path / "radio.jsonl"
    answer = ask(
        station, fleet, "--seconds", 8, "--json", "--record", records, "--out", tmp_path / "out"
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
        assert found["sentence"].startswith("carries 3 robots with room for ")
    kept = read_records(records)
    assert len(kept) == 6
    assert {record.distance_m for record in kept} != {None}
    assert (tmp_path / "out" / "radio.png").stat().st_size > 10_000


def test_who_is_heard_badly_is_named(fleet: ThinAir, new_station: NewStation) -> None:
    station = listening(fleet, new_station)
    fleet.muffled = frozenset({1})
    answer = ask(station, fleet, "--seconds", 10)
    assert answer.returncode == 1
    last = answer.stderr.splitlines()[-1]
    assert last.startswith("lpac: radio: the others hear ") and " of r1" in last
    assert "arrived %: a row hears, a column says" in answer.stdout


def test_robots_of_a_simulated_fleet_have_no_computer_to_load_the_radio_from(
    fleet: ThinAir, new_station: NewStation
) -> None:
    answer = ask(listening(fleet, new_station), fleet, "--load")
    assert answer.returncode == 1
    assert answer.stderr.splitlines() == [
        "lpac: --load: the robots are no computers that could send a bulk stream"
    ]
