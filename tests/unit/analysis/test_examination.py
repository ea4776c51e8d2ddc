"""Reports from logs of exactly known flights, written by the real writers."""

import contextlib
import dataclasses
import itertools
import json
import math
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread
from typer.testing import CliRunner

from edge.core.world import parse_world, rasterize
from edge.drivers.flight_log import FlightLog, FlightMetadata
from edge.messages.codes import ReasonCode
from edge.messages.mission import FlightState, LoopStatus, Order, OrderResult, RobotStatus
from edge.messages.mission import world_id as id_of
from edge.policy.bundle import load_bundle
from lpac.analysis import figures
from lpac.analysis.coverage import Coverage
from lpac.analysis.examination import Examined, Wanted, examine
from lpac.analysis.figures import overview
from lpac.analysis.logs import read_logs
from lpac.analysis.missions import find_missions, whole_record
from lpac.analysis.snapshot import FleetSetup, GroundEvent
from lpac.analysis.style import CURVES, SWARM, save
from lpac.analysis.voronoi import coverage_cost
from lpac.analysis.worlds import format_world, random_features
from lpac.analysis.write_report import write
from lpac.cli.main import app
from lpac.ground.record import TOPICS, GroundMetadata
from tests.conftest import SHIPPED
from tests.said import reason, refusal
from tests.unit.analysis.test_coverage import STATUS
from tests.unit.ground.snapshots import FENCE

S = FlightState
NAN = math.nan
BEGAN_S = 1.7e9
PERIOD_S = 0.25
HEARD_AFTER_S = 0.01
AGE_S = 0.02
SCALE = 16.0
WORLD = format_world(random_features(np.random.default_rng(3), 8, 512))
IMPORTANCE = rasterize(parse_world(WORLD), 512, 2.0, 1.0)
BUNDLE = load_bundle(SHIPPED)


@dataclass(frozen=True)
class Flown:
    """A mission that each robot flies in a straight line, from `start_m` by `step_m` per s."""

    trial: str
    begin_s: float
    duration_s: float
    start_m: tuple[tuple[float, float], ...]
    step_m: tuple[tuple[float, float], ...]

    def place_m(self, robot: int, at_s: float) -> tuple[float, float]:
        """Position at a time; constant before and after the mission."""
        flown_s = min(max(at_s - self.begin_s, 0.0), self.duration_s)
        (x, y), (dx, dy) = self.start_m[robot], self.step_m[robot]
        return x + dx * flown_s, y + dy * flown_s

    def state(self, at_s: float) -> S:
        after_s, left_s = at_s - self.begin_s, self.begin_s + self.duration_s - at_s
        for state, over in (
            (S.PREFLIGHT, after_s < -4.0), (S.TAKEOFF, after_s < -1.0), (S.HOLD, after_s < 0.0),
            (S.MISSION, left_s >= 0.0), (S.LAND, left_s >= -3.0),
        ):  # fmt: skip
            if over:
                return state
        return S.LANDED

    def cost(self, at_s: float) -> float:
        places_m = [self.place_m(robot, at_s) for robot in range(len(self.start_m))]
        return coverage_cost(IMPORTANCE, np.array(places_m) * SCALE)


FIRST = Flown("t1", 20.0, 10.0, ((4.0, 4.0), (8.0, 4.0), (4.0, 8.0)), ((1, 0.5), (1, 1), (0, 1)))
SECOND = Flown("t2", 60.0, 12.0, ((4.0, 5.0), (8.0, 5.0), (4.0, 9.0)), ((1, 0.5), (1, 1), (0, 1)))


class Writer:
    """Writes the logs of `flights`, one after another, of robots whose clocks are `ahead_s`.

    Every tenth message from robot 0 to robot 1 is lost.
    """

    def __init__(
        self, flights: Sequence[Flown], ahead_s: Sequence[float] = (0.0, 0.0, 0.0), nonce: int = 7
    ) -> None:
        self.flights = flights
        self.ahead_s = ahead_s
        self.nonce = nonce
        self.world = WORLD
        self.bundle_id = BUNDLE.id
        self.age_s = AGE_S
        # Other values of the ground's setup, and changes of each status in the files.
        self.setup: dict[str, Any] = {}
        self.rates = [{"perception_hz": 5.0, "policy_hz": 2.5, "control_hz": 10.0}] * 3
        self.refused = {2: "not ready: battery"}
        self.written: Callable[[dict[str, Any]], dict[str, Any]] = lambda status: status
        self.change: Callable[[RobotStatus, float], RobotStatus] = lambda status, _: status

    def _times_s(self) -> Iterator[tuple[float, Flown]]:
        for flight in self.flights:
            last_s = flight.begin_s + flight.duration_s + 6.0
            for k in range(round((last_s - (flight.begin_s - 6.0)) / PERIOD_S)):
                yield flight.begin_s - 6.0 + k * PERIOD_S, flight

    def _statuses(self, robot: int) -> Iterator[tuple[float, RobotStatus]]:
        loop = LoopStatus(0, 0, 0, 0.5, 2.0 + robot, 5.0 + robot)
        for sequence, (at_s, flight) in enumerate(self._times_s()):
            state = flight.state(at_s)
            status = dataclasses.replace(
                STATUS, robot_id=robot, boot_nonce=self.nonce + robot, sequence=sequence,
                uptime_s=at_s, unix_time_s=BEGAN_S + at_s + self.ahead_s[robot], state=state,
                armed=state in (S.TAKEOFF, S.HOLD, S.MISSION, S.LAND), trial=flight.trial,
                position_m=(*flight.place_m(robot, at_s), 4.0 + 2.0 * robot), fence=FENCE,
                bundle_id=self.bundle_id, world_id=id_of(self.world), battery=0.8,
                loops={"control": loop, "policy": loop, "perception": loop},
            )  # fmt: skip
            yield at_s, self.change(status, at_s)

    def robots(self, folder: Path) -> None:
        """Write to FOLDER/robots/<i>/logs, as `lpac sim` does."""
        for robot in range(3):
            configuration = json.dumps(
                {
                    "policy": {"env_scale": SCALE, "world": "gone"},
                    "fence": dataclasses.asdict(FENCE),
                    "rates": self.rates[robot],
                }
            )
            metadata = FlightMetadata(
                robot, self.nonce + robot, self.bundle_id, str(SHIPPED), configuration, "0"
            )
            log = FlightLog(folder / "robots" / str(robot) / "logs", metadata)
            with contextlib.closing(log):
                for at_s, status in self._statuses(robot):
                    said = self.written(dataclasses.asdict(status))
                    log.record("status", status.unix_time_s, said)
                    self._receive(log, robot, status.sequence, at_s)
                    log.flush()
                order = Order("a", robot, self.nonce, "takeoff", 1.0, "ann", "")
                answer = OrderResult("a", refusal(self.refused.get(robot, "")))
                log.record(
                    "order", BEGAN_S + self.flights[0].begin_s - 4.0 + self.ahead_s[robot],
                    {**dataclasses.asdict(order), "answer": dataclasses.asdict(answer)},
                )  # fmt: skip

    def _receive(self, log: FlightLog, robot: int, sequence: int, at_s: float) -> None:
        for sender in range(3):
            if sender == robot or (robot == 1 and sender == 0 and sequence % 10 == 5):
                continue
            heard_s = BEGAN_S + at_s + AGE_S + self.ahead_s[robot]
            log.record(
                "received", heard_s,
                {"sender": sender, "sequence": sequence, "age_s": self.age_s, "rejection": None},
            )  # fmt: skip

    def ground(self, folder: Path) -> None:
        """Write the ground's log, FOLDER/ground-0001.mcap."""
        perception = BUNDLE.manifest.perception
        assert perception is not None
        setup = FleetSetup(
            fleet="f", operator="ann", robots={"r0": 0, "r1": 1, "r2": 2}, slots=(), fence=FENCE,
            world=self.world, world_id=id_of(self.world), bundle_id=self.bundle_id,
            world_size=perception.world_size, sensor_size=perception.sensor_size,
            communication_range=perception.communication_range, env_scale=SCALE, truncation=2.0,
            norm=1.0,
        )  # fmt: skip
        log = FlightLog(folder, GroundMetadata("f", "0"), TOPICS)
        with contextlib.closing(log):
            told_s = BEGAN_S + self.flights[0].begin_s - 6.0
            log.record("setup", told_s, {**dataclasses.asdict(setup), **self.setup})
            for flight in self.flights:
                event = GroundEvent(
                    BEGAN_S + flight.begin_s, "command", "", "start <b>now</b>", "ann", flight.trial
                )
                log.record("event", event.unix_time_s, dataclasses.asdict(event))
            for robot in range(3):
                for at_s, status in self._statuses(robot):
                    heard_s = BEGAN_S + at_s + HEARD_AFTER_S
                    heard = {
                        **self.written(dataclasses.asdict(status)), "name": f"r{robot}",
                        "heard_at_unix_s": heard_s, "clock_offset_s": self.ahead_s[robot],
                    }  # fmt: skip
                    log.record("status", heard_s, heard)
                    log.flush()


def examined(*folders: Path, **wanted: Any) -> Examined:
    return examine(folders, Wanted(**wanted), lambda *_: None)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two missions, in logs of the ground and of robots with wrong clocks."""
    folder = tmp_path_factory.mktemp("flown")
    writer = Writer((FIRST, SECOND), ahead_s=(0.0, 3.0, -5000.0))
    writer.robots(folder)
    writer.ground(folder / "logs")
    return folder


@pytest.fixture(scope="module")
def found(flown: Path) -> Examined:
    return examined(flown, times_s=(0.0, 5.0, 11.0))


def test_a_mission_has_the_rates_that_all_of_its_robots_have(
    found: Examined, tmp_path: Path
) -> None:
    assert [record.rates for record in found.records] == [(5.0, 2.5), (5.0, 2.5)]
    writer = Writer((FIRST,))
    writer.rates[1] = {**writer.rates[1], "policy_hz": 1.0}
    writer.robots(tmp_path)
    [differing] = examined(tmp_path).records
    assert differing.rates is None


def test_two_answers_at_the_same_moment_are_in_any_order(flown: Path, tmp_path: Path) -> None:
    """As in two simulated flights with the same clocks."""
    other = Writer((FIRST,), ahead_s=(0.0, 3.0, -5000.0))
    other.refused = {}
    other.robots(tmp_path)
    assert examined(flown, tmp_path).records


class Page(HTMLParser):
    """References and images of a page."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.references: list[str] = []
        self.tags: list[str] = []
        self.text = ""
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.references += [v for k, v in attrs if k in ("src", "href", "srcset") and v is not None]

    def handle_data(self, data: str) -> None:
        self.text += data


def test_the_numbers_are_those_of_the_flights(found: Examined) -> None:
    trials = found.summary()["trials"]
    assert [values["trial"] for values in trials] == ["t1", "t2"]
    for values, flight in zip(trials, (FIRST, SECOND), strict=True):
        begin_s, end_s = flight.begin_s, flight.begin_s + flight.duration_s
        assert values["began_unix_s"] == pytest.approx(BEGAN_S + begin_s + HEARD_AFTER_S, abs=0.01)
        assert values["duration_s"] == pytest.approx(flight.duration_s, abs=0.01)
        assert values["robots"] == ["r0", "r1", "r2"]
        cost = values["cost"]
        assert cost["initial"] == pytest.approx(flight.cost(begin_s))
        assert cost["final"] == pytest.approx(flight.cost(end_s))
        assert cost["normalized"] == pytest.approx(flight.cost(end_s) / flight.cost(begin_s))
        middle = np.interp(5.0, cost["time_s"], cost["curve"])
        assert middle == pytest.approx(flight.cost(begin_s + 5.0) / flight.cost(begin_s), rel=1e-3)
        assert 0.0 < cost["lloyd"] < cost["final"]
        assert cost["normalized_lloyd"] == pytest.approx(cost["lloyd"] / cost["initial"])
        end_m = {f"r{robot}": flight.place_m(robot, end_s) for robot in range(3)}
        assert {k: pytest.approx(v) for k, v in values["end_m"].items()} == end_m
        times_s = np.linspace(begin_s, end_s, 500).tolist()
        closest_m = min(
            math.dist((*flight.place_m(i, at_s), 2.0 * i), (*flight.place_m(j, at_s), 2.0 * j))
            for i, j in itertools.combinations(range(3), 2)
            for at_s in times_s
        )
        assert values["separation"]["distance_m"] == pytest.approx(closest_m, abs=0.01)
        margin_m = min(
            FENCE.distance_m(*flight.place_m(robot, at_s)) for robot in range(3) for at_s in times_s
        )
        assert values["fence_margin_m"] == pytest.approx(margin_m, abs=0.01)
        assert values["restarts"] == {} and values["alarms"] == []
        (started,) = values["commands"]
        assert (started["operator"], started["text"]) == ("ann", "start <b>now</b>")
        control = values["loops"]["control"]
        assert (control["p99_ms"], control["max_ms"]) == (4.0, 7.0)


def test_message_ages_are_corrected_and_losses_counted(found: Examined) -> None:
    """Clocks are off by seconds and by hours, and every tenth message of one pair is lost."""
    first, second = (values["messages"] for values in found.summary()["trials"])
    for told, flight in ((first, FIRST), (second, SECOND)):
        assert told["rejected"] == 0
        assert told["age_p50_s"] == pytest.approx(AGE_S, abs=1e-3)
        assert told["age_p99_s"] == pytest.approx(AGE_S, abs=1e-3)
        sent = told["came"] + told["lost"]
        assert sent == pytest.approx(6 * flight.duration_s / PERIOD_S, abs=6)
        assert told["lost"] == pytest.approx(flight.duration_s / PERIOD_S / 10.0, abs=1)
        assert told["loss_share"] == told["lost"] / sent
    assert found.notes == ("t1: lasted 10.0 s: no snapshot at 11 s",)


@pytest.mark.slow
@pytest.mark.usefixtures("sketched")
def test_the_page_holds_everything(tmp_path: Path, found: Examined) -> None:
    html = write(found, tmp_path, (0.0, 5.0, 11.0), lambda *_: None).read_text()
    page = Page(html)
    assert all(r.startswith(("data:image/png;base64,", "#mission-")) for r in page.references)
    assert not {"script", "link", "iframe", "b"} & set(page.tags)
    assert "url(" not in html and "@import" not in html
    for text in ("t1", "t2", "start <b>now</b>", "ann", "Repeatability", "r2"):
        assert text in page.text
    figures = ("snapshots", "start-and-end", "cost", "states", "messages", "loops")
    assert page.tags.count("img") == 2 * len(figures) + 1
    common = [tmp_path / name for name in ("repeatability", "costs")]
    for path in common + [tmp_path / trial / name for trial in ("t1", "t2") for name in figures]:
        assert path.with_suffix(".pdf").read_bytes().startswith(b"%PDF")
        assert path.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    summary = json.loads((tmp_path / "report.json").read_text())
    assert summary == json.loads(json.dumps(found.summary()))


def test_from_the_robots_logs_alone(tmp_path: Path) -> None:
    Writer((FIRST,)).robots(tmp_path)
    (tmp_path / "world.env").write_text(WORLD)
    found = examined(tmp_path)
    (values,) = found.summary()["trials"]
    assert values["robots"] == ["r0", "r1", "r2"]
    takeoffs = [(c["robot"], c["text"], c["done"]) for c in values["commands"]]
    assert sorted(takeoffs) == [
        ("r0", "takeoff", True), ("r1", "takeoff", True),
        ("r2", "takeoff: not ready: battery", False),
    ]  # fmt: skip
    assert found.notes == ()
    normalized = FIRST.cost(30.0) / FIRST.cost(20.0)
    assert values["cost"]["normalized"] == pytest.approx(normalized)


def test_from_the_grounds_log_alone(tmp_path: Path) -> None:
    Writer((FIRST,)).ground(tmp_path)
    found = examined(tmp_path)
    (values,) = found.summary()["trials"]
    assert values["cost"]["normalized"] == pytest.approx(FIRST.cost(30.0) / FIRST.cost(20.0))
    assert values["messages"] is None
    (note,) = found.notes
    assert "no log of any robot:" in note


@pytest.mark.usefixtures("sketched")
def test_without_a_world_there_is_no_cost(tmp_path: Path) -> None:
    Writer((FIRST,)).robots(tmp_path)
    found = examined(tmp_path)
    (values,) = found.summary()["trials"]
    assert values["cost"]["initial"] is None and values["end_m"].keys() == {"r0", "r1", "r2"}
    assert [f"the file of world {id_of(WORLD)} is missing" in note for note in found.notes] == [
        True
    ]
    assert found.without_cost == {"t1": found.notes[0]}
    write(found, tmp_path / "out", (0.0,), lambda *_: None)
    assert (tmp_path / "out/t1/snapshots.png").exists()
    assert not (tmp_path / "out/t1/cost.png").exists()
    other = tmp_path / "other.txt"
    other.write_text("CircularBND 100 100 20 5\n")
    given = examined(tmp_path, world=other)
    assert given.summary()["trials"][0]["cost"]["initial"] is not None
    assert not given.without_cost
    assert [f"--world is {id_of(other.read_text())}" in note for note in given.notes] == [True]


@pytest.mark.parametrize("bundle_id", [BUNDLE.id, "another"])
def test_each_mission_has_the_sizes_of_its_own_policy(tmp_path: Path, bundle_id: str) -> None:
    Writer((FIRST,)).ground(tmp_path / "a")
    (alone,) = examined(tmp_path).records
    other = Writer((SECOND,), nonce=99)
    other.bundle_id = bundle_id
    other.setup = {"world_size": 1024, "env_scale": 32.0, "sensor_size": 128}
    other.ground(tmp_path / "b")
    first, second = examined(tmp_path).records
    assert first.cost.tolist() == alone.cost.tolist() and first.sensor_size == alone.sensor_size
    assert second.coverage is not None and second.coverage.importance.shape == (1024, 1024)
    assert second.sensor_size == 128


def test_robots_logs_alone_have_the_sizes_of_the_bundle_they_flew(tmp_path: Path) -> None:
    writer = Writer((FIRST,))
    writer.bundle_id = "another"  # than the one at its path now
    writer.robots(tmp_path)
    (note,) = [note for note in examined(tmp_path).notes if "bundle" in note]
    assert note.startswith("t1: the policy's bundle is missing: give it with --bundle")
    assert not [n for n in examined(tmp_path, bundle=SHIPPED).notes if "bundle" in n]


@pytest.mark.usefixtures("sketched")
def test_a_world_without_importance_has_no_normalised_cost(tmp_path: Path) -> None:
    writer = Writer((FIRST, SECOND))
    writer.world = "CircularBND 100 100 20 0\n"
    writer.ground(tmp_path)
    arguments = ["report", str(tmp_path), "--out", str(tmp_path / "out"), "--times", "0"]
    result = CliRunner().invoke(app, arguments)
    assert "cost" not in result.stdout.splitlines()[0] and "nan" not in result.stdout
    assert "note: t1: no normalised cost, because the world has no importance" in result.stdout
    cost = json.loads((tmp_path / "out/report.json").read_text())["trials"][0]["cost"]
    assert cost["initial"] == 0.0 and cost["normalized"] is cost["normalized_lloyd"] is None
    assert cost["curve"] == cost["time_s"] == []
    assert "nan" not in Page((tmp_path / "out/report.html").read_text()).text
    drawn = {path.name for path in (tmp_path / "out").rglob("*.png")}
    assert "snapshots.png" in drawn and not drawn & {"cost.png", "costs.png", "repeatability.png"}


def test_logs_that_break_off_and_robots_that_are_missing(tmp_path: Path, flown: Path) -> None:
    shutil.copytree(flown / "robots", tmp_path / "robots")
    shutil.copytree(flown / "logs", tmp_path / "logs")
    shutil.rmtree(tmp_path / "robots/0")
    for name, share in (("robots/1/logs/robot-1-0001.mcap", 0.4), ("logs/ground-0001.mcap", 0.9)):
        whole = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(whole[: int(share * len(whole))])
    (tmp_path / "robots/2/logs/robot-2-0002.mcap").write_bytes(b"")
    (tmp_path / "robots/2/logs/robot-2-0003.mcap").write_bytes(b"nothing of the kind")
    logs = read_logs([tmp_path], lambda *_: None)
    missions = [(mission.name, mission.robots) for mission in find_missions(logs)]
    assert missions == [("t1", (0, 1, 2)), ("t2", (0, 1, 2))]
    assert logs.programs_logged == {(1, 8), (2, 9)} and len(logs.received) == 2
    assert len([note for note in logs.notes if note.endswith("skipped")]) == 2
    found = examined(tmp_path, missions=("t1",))
    (values,) = found.summary()["trials"]
    assert values["robots"] == ["r0", "r1", "r2"]
    assert any("no log of r0:" in note for note in found.notes)
    assert values["cost"]["normalized"] == pytest.approx(FIRST.cost(30.0) / FIRST.cost(20.0))


def test_a_flight_without_a_mission_has_a_record_and_a_figure(tmp_path: Path) -> None:
    """As of a simulated fleet whose mission does not begin."""
    writer = Writer((FIRST,))
    writer.change = held_back
    writer.robots(tmp_path)
    logs = read_logs([tmp_path], lambda *_: None)
    assert find_missions(logs) == []
    record = whole_record(logs, range(4), Coverage(IMPORTANCE, SCALE), 64, FENCE)
    assert (record.duration_s, len(record.cost), len(record.true_cost)) == (0.0, 0, 0)
    assert math.isnan(record.lloyd) and not len(record.normalized)
    assert record.separation is not None and record.true_separation is None
    assert [record.mission_share(robot) for robot in record.robots] == [0.0] * 4
    assert save(overview(record), tmp_path / "overview").startswith(b"\x89PNG")


def held_back(status: RobotStatus, _: float) -> RobotStatus:
    return dataclasses.replace(status, state=S.HOLD) if status.state is S.MISSION else status


def test_the_swarm_shares_no_curves_colour() -> None:
    assert SWARM not in {colour for colour, _ in CURVES}


@pytest.mark.usefixtures("sketched")
def test_restarts_and_alarms_are_told(tmp_path: Path) -> None:
    writer = Writer((FIRST,))

    def change(status: RobotStatus, at_s: float) -> RobotStatus:
        if status.robot_id == 1 and at_s >= 25.0:
            return dataclasses.replace(
                status, alarms=(reason("battery <low>", ReasonCode.BATTERY_LOW),)
            )
        if status.robot_id == 2 and at_s >= 26.0:
            return dataclasses.replace(status, boot_nonce=99, uptime_s=at_s - 26.0)
        return status

    writer.change = change
    writer.ground(tmp_path)
    found = examined(tmp_path)
    (values,) = found.summary()["trials"]
    assert values["restarts"] == {"r2": 1}
    (alarm,) = values["alarms"]
    assert (alarm["robot"], alarm["code"], alarm["text"]) == ("r1", "battery_low", "battery <low>")
    assert alarm["time_s"] == pytest.approx(5.0, abs=0.01)
    page = write(found, tmp_path / "out", (0.0,), lambda *_: None)
    assert "battery <low>" in Page(page.read_text()).text


def test_one_name_flown_twice_is_two_missions(tmp_path: Path) -> None:
    again = dataclasses.replace(FIRST, begin_s=200.0)
    for folder, flight, nonce in (("a", FIRST, 10), ("b", again, 20)):
        Writer((flight,), nonce=nonce).robots(tmp_path / folder)
    # Folder names of `lpac fleet pull`.
    (tmp_path / "a/robots/0").rename(tmp_path / "a/robots/alpha")
    logs = read_logs([tmp_path / name for name in "ab"], lambda *_: None)
    assert [mission.name for mission in find_missions(logs)] == ["t1", "t1 (2)"]
    assert [logs.name(robot) for robot in range(3)] == ["alpha", "r1", "r2"]


def landed(status: RobotStatus, _: float) -> RobotStatus:
    return status


def reset_in_the_air(status: RobotStatus, at_s: float) -> RobotStatus:
    return dataclasses.replace(held(status, at_s), trial="" if 35.0 < at_s < 50.0 else "t1")


def held(status: RobotStatus, _: float) -> RobotStatus:
    return status if status.state is S.MISSION else dataclasses.replace(status, state=S.HOLD)


def one_landed(status: RobotStatus, at_s: float) -> RobotStatus:
    return status if status.robot_id == 0 else held(status, at_s)


@pytest.mark.parametrize(
    ("change", "flights"), [(landed, 2), (reset_in_the_air, 2), (held, 1), (one_landed, 1)]
)
def test_a_mission_ends_when_all_have_landed_or_are_reset(
    tmp_path: Path, change: Callable[[RobotStatus, float], RobotStatus], flights: int
) -> None:
    """As when `lpac mission run` flies a script's trial twice without restarting the robots."""
    writer = Writer((FIRST, dataclasses.replace(FIRST, begin_s=50.0)))
    writer.change = change
    writer.ground(tmp_path)
    found = find_missions(read_logs([tmp_path], lambda *_: None))
    assert [mission.name for mission in found] == ["t1", "t1 (2)"][:flights]
    for mission in found:
        lasted_s = mission.end_s - mission.begin_s
        assert lasted_s == pytest.approx(10.0 if flights == 2 else 40.0, abs=0.01)


def test_a_robot_that_does_not_know_where_it_is_counts_where_it_was(tmp_path: Path) -> None:
    writer = Writer((FIRST,))

    def change(status: RobotStatus, at_s: float) -> RobotStatus:
        lost = status.robot_id == 1 and (22.0 < at_s < 23.5 or at_s > 26.0)
        return dataclasses.replace(status, position_m=None) if lost else status

    writer.change = change
    writer.ground(tmp_path)
    cost = examined(tmp_path).records[0]
    after_s = cost.cost_time_s
    expected = np.array([FIRST.cost(20.0 + at_s) for at_s in after_s])
    assert cost.cost[after_s < 6.0] == pytest.approx(expected[after_s < 6.0], rel=1e-3)
    # It stays at its last position, which the least distance ignores.
    places_m = np.array([FIRST.place_m(robot, 30.0) for robot in range(3)])
    places_m[1] = FIRST.place_m(1, 26.0)
    assert cost.cost[-1] == pytest.approx(coverage_cost(IMPORTANCE, places_m * SCALE), rel=1e-3)
    assert "r1" not in cost.places_at(10.0)


def test_without_any_position_for_seconds_the_cost_does_not_jump(tmp_path: Path) -> None:
    writer = Writer((FIRST,))

    def change(status: RobotStatus, at_s: float) -> RobotStatus:
        lost = status.robot_id != 2 and 22.0 < at_s < 27.5
        return dataclasses.replace(status, position_m=None) if lost else status

    writer.change = change
    writer.ground(tmp_path)
    record = examined(tmp_path).records[0]
    assert len(record.curve_time_s) == len(record.cost_time_s)
    after_s = record.curve_time_s
    # Robots 0 and 1 move, then stay at their last positions.
    in_between = (after_s > 2.0) & (after_s < 7.0)
    for at_s, cost in zip(after_s[in_between], record.cost[in_between], strict=True):
        places_m = [FIRST.place_m(robot, 22.0 if robot < 2 else 20.0 + at_s) for robot in range(3)]
        assert cost == pytest.approx(
            coverage_cost(IMPORTANCE, np.array(places_m) * SCALE), rel=0.05
        )


@pytest.mark.slow
def test_nothing_of_a_figure_is_cut(tmp_path: Path) -> None:
    """With each state, an alarm and a restart, legends have the most entries."""
    writer = Writer((FIRST,))
    flown = (S.ARMING, S.TAKEOFF, S.HOLD, S.RETURN, S.PILOT, S.FAULT, S.INIT)
    states = dict(enumerate(flown, 2))

    def change(status: RobotStatus, at_s: float) -> RobotStatus:
        state = states.get(int(at_s) - 20, status.state) if status.robot_id == 1 else status.state
        alarms = (reason("battery", ReasonCode.BATTERY_LOW),) if at_s > 25.0 else ()
        nonce = 99 if status.robot_id == 2 and at_s >= 26.0 else status.boot_nonce
        return dataclasses.replace(status, state=state, alarms=alarms, boot_nonce=nonce)

    writer.change = change
    writer.ground(tmp_path)
    writer.robots(tmp_path)
    [record] = examined(tmp_path).records
    assert record.messages is not None and record.restarts
    for figure in (
        figures.states(record), figures.start_and_end(record), figures.overview(record),
        figures.costs([record]), figures.snapshots(record, (0.0, 3.0, 6.0, 10.0)),
        figures.snapshots_and_costs({"a policy of some name": record, "another": record}),
        figures.repeatability([record, record]), figures.messages(record, record.messages),
        figures.loops(record),
    ):  # fmt: skip
        save(figure, tmp_path / "figure")
        assert (tmp_path / "figure.pdf").read_bytes().startswith(b"%PDF")
        pixels = imread(tmp_path / "figure.png")
        assert pixels.shape[0] > 250 and pixels.shape[1] > 1000
        edges = (pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1])
        assert all((edge == 1.0).all() for edge in edges), figure


def nowhere(status: RobotStatus, _: float) -> RobotStatus:
    return dataclasses.replace(status, position_m=None, loops={}, fence=None)


def alone(status: RobotStatus, _: float) -> RobotStatus:
    state = status.state if status.robot_id == 1 else S.IDLE
    return dataclasses.replace(status, state=state, trial="")


def at_once(status: RobotStatus, at_s: float) -> RobotStatus:
    return dataclasses.replace(status, state=S.MISSION if at_s == 20.0 else S.IDLE)


@pytest.mark.usefixtures("sketched")
@pytest.mark.parametrize("change", [nowhere, alone, at_once])
def test_odd_flights_have_a_report_too(
    tmp_path: Path, change: Callable[[RobotStatus, float], RobotStatus]
) -> None:
    writer = Writer((FIRST,))
    writer.change = change
    writer.robots(tmp_path)
    (tmp_path / "world.env").write_text(WORLD)
    found = examined(tmp_path)
    assert write(found, tmp_path / "out", (0.0,), lambda *_: None).exists()
    (values,) = found.summary()["trials"]
    if change is nowhere:
        assert values["cost"]["initial"] is None and values["end_m"] == {}
    elif change is alone:
        assert (values["trial"], values["robots"]) == ("no name", ["r1"])
        assert values["separation"] is None and values["cost"]["normalized"] > 0.0
    else:
        assert values["duration_s"] == 0.25


@pytest.mark.parametrize(
    ("odd", "why"),
    [
        ({}, "'landing_point_m' is missing"),
        ({"landing_point_m": [1.0, 1.0], "state": "hovering"}, "status: state = 'hovering'"),
        ({"landing_point_m": [1.0, 1.0], "uptime_s": NAN}, "uptime_s = NaN"),
        ({"landing_point_m": [1.0, 1.0], "fence": {"vertices_m": 3}}, "fence: vertices_m = 3"),
    ],
)
def test_what_is_not_understood_is_left_out_and_told(
    tmp_path: Path, odd: dict[str, Any], why: str
) -> None:
    """As another version may have written it."""
    writer = Writer((FIRST,))

    def written(status: dict[str, Any]) -> dict[str, Any]:
        if status["robot_id"] == 1:
            del status["landing_point_m"]
            status |= odd
        return status | {"another": 1}

    writer.written = written
    writer.robots(tmp_path)
    found = examined(tmp_path)
    assert found.summary()["trials"][0]["robots"] == ["r0", "r2"]
    told = [re.sub("^.*/", "", note) for note in found.notes]
    assert told[0].startswith(f"robot-1-0001.mcap: {why}") and "88 messages of topic" in told[0]


@pytest.mark.usefixtures("sketched")
def test_numbers_that_are_not_finite_are_not_known(tmp_path: Path) -> None:
    writer = Writer((FIRST,))

    def written(status: dict[str, Any]) -> dict[str, Any]:
        if status["robot_id"] == 1:
            status |= {"battery": NAN, "landing_point_m": (NAN, 1.0)}
            status["position_m"] = (NAN, 1.0, math.inf)
            status["loops"]["control"]["lateness_p99_ms"] = NAN
        return status

    writer.written = written
    writer.robots(tmp_path)
    (tmp_path / "world.env").write_text(WORLD)
    found = examined(tmp_path)
    (values,) = found.summary()["trials"]
    assert found.notes == () and values["robots"] == ["r0", "r1", "r2"]
    assert values["end_m"].keys() == {"r0", "r2"} and values["loops"]["control"]["p99_ms"] == 4.0
    text = Page(write(found, tmp_path / "out", (0.0,), lambda *_: None).read_text()).text
    assert "80 %" in text and "nan" not in text


def test_a_setup_of_another_version_is_understood(tmp_path: Path) -> None:
    writer = Writer((FIRST,))
    writer.setup = {"max_speed_m_s": 2.0}
    writer.ground(tmp_path)
    assert examined(tmp_path).records[0].cost[0] == pytest.approx(FIRST.cost(20.0))


def test_a_message_of_unknown_age_has_arrived(tmp_path: Path) -> None:
    writer = Writer((FIRST,))
    writer.age_s = math.nan
    writer.robots(tmp_path)
    (record,) = examined(tmp_path).records
    assert record.messages is not None and len(record.messages.heard_at_s) > 0
    assert math.isnan(record.messages.age_quantile_s(0.5))


def test_mistakes_are_one_line(tmp_path: Path, flown: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    grounded = tmp_path / "grounded"
    writer = Writer((FIRST,))
    writer.change = lambda status, _: dataclasses.replace(status, state=S.IDLE)
    writer.robots(grounded)
    (grounded / "robot-9.mcap").mkdir()
    cut = tmp_path / "cut"
    cut.mkdir()
    for number in range(5):
        (cut / f"robot-1-000{number}.mcap").write_bytes(b"")
    for arguments, text in (
        ([empty], r"empty: holds no logs \(robot-\*\.mcap, ground-\*\.mcap\)"),
        ([tmp_path / "none"], r"none: is not a folder"),
        ([grounded], r"no mission in these logs, of 3 robots$"),
        ([cut], r"of 0 robots; .*robot-1-0000\.mcap: .*: skipped; .*; and 2 more notes$"),
    ):
        with pytest.raises(ValueError, match=text):
            examined(*arguments)
    with pytest.raises(ValueError, match=r"--trial 't9': the logs have 't1', 't2'"):
        examined(flown, missions=("t9",))
    with pytest.raises(ValueError, match=r"--times -1: must be 0 or above"):
        Wanted(times_s=(-1.0,))
    with pytest.raises(OSError, match="nowhere"):
        examined(flown, world=tmp_path / "nowhere")
    result = CliRunner().invoke(app, ["report", str(flown), "--times", "0,x"])
    assert "--times 0,x: must be numbers such as 0,20,60" in str(result.exception)


@pytest.mark.usefixtures("sketched")
def test_the_command_prints_the_summary(tmp_path: Path, flown: Path) -> None:
    arguments = ["report", str(flown), "--trial", "t2", "--out", str(tmp_path), "--times", "0"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0
    line, last = result.stdout.splitlines()
    assert re.fullmatch(
        r"t2: 20\d\d-\d\d-\d\d \d\d:\d\d:\d\d, 3 robots, 12 s, "
        r"cost \d\.\d\d of the initial, Lloyd's algorithm, knowing the world, \d\.\d\d, "
        r"least distance \d\.\d\d m, \d\.\d % of the messages lost", line
    )  # fmt: skip
    assert last == f"see {tmp_path / 'report.html'}"
    listed = CliRunner().invoke(app, ["log", "trials", str(flown), "--json"])
    found = json.loads(listed.stdout)
    assert found["logs/ground-0001.mcap"].keys() == {"t1", "t2"}
