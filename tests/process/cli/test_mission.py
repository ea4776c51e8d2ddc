"""`lpac mission` and `lpac site`, with a ground process and robots that fly in this process."""

import contextlib
import io
import json
import math
import os
import pty
import re
import signal
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from edge.messages.mission import FlightState, Order, OrderKind
from lpac.analysis.snapshot import FleetSnapshot
from lpac.cli.main import main
from tests.conftest import ROOT
from tests.flown import PRECISE, FlownRobot
from tests.live import ORIGIN, FlownFleet, until
from tests.process.ground.conftest import wait_for_snapshot

_S = FlightState
AT = (str(ORIGIN.latitude_deg), str(ORIGIN.longitude_deg), str(ORIGIN.heading_deg))
SCRIPT = ROOT / "docs" / "script.toml"
# By how much a place that a robot takes itself to be at errs here.
NOISE_M = 0.5
PADS_M = ((2.0, 2.0), (6.0, 2.0), (10.0, 2.0))


class Done(NamedTuple):
    """What a command left."""

    code: int
    out: str
    err: str

    @property
    def robots(self) -> dict[str, Any]:
        """Of --json."""
        robots: dict[str, Any] = json.loads(self.out)["robots"]
        return robots


class Field(NamedTuple):
    """A fleet that runs, and its ground's environment."""

    fleet: FlownFleet
    environment: dict[str, str]

    @property
    def robots(self) -> list[FlownRobot]:
        return self.fleet.flown[:3]

    def lpac(self, *arguments: str | Path) -> Done:
        """The command, in this process."""
        out, err = io.StringIO(), io.StringIO()
        code: int | str | None = 0
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "argv", ["lpac", *map(str, arguments)])
            with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
                try:
                    main()
                except SystemExit as stop:
                    code = stop.code
        if isinstance(code, str):
            return Done(1, out.getvalue(), f"{err.getvalue()}{code}\n")
        return Done(code or 0, out.getvalue(), err.getvalue())

    def do(self, *arguments: str | Path) -> Done:
        """The command, which must be done by all."""
        done = self.lpac(*arguments)
        assert done.code == 0, done
        return done

    def refused(self, *arguments: str | Path) -> str:
        """The line that says why the command was not done."""
        done = self.lpac(*arguments)
        assert done.code == 1, done
        last = done.err.splitlines()[-1]
        assert last.startswith("lpac: ")
        assert "Traceback" not in done.err
        return last.removeprefix("lpac: ")

    def stand(self, places_m: Mapping[int, Sequence[float]]) -> None:
        """Put robots there, and wait until the ground knows it."""
        for robot, place_m in places_m.items():
            self.fleet.stand(robot, place_m)

        def knows(snapshot: FleetSnapshot) -> bool:
            said = [snapshot.robots[robot].status for robot in places_m]
            return all(
                each and each.position_m and math.dist(each.position_m[:2], place_m) < NOISE_M
                for each, place_m in zip(said, places_m.values(), strict=True)
            )

        wait_for_snapshot(self.fleet.name, knows)

    @contextlib.contextmanager
    def running(self, *arguments: str | Path) -> Iterator["subprocess.Popen[str]"]:
        """The command, in a process of its own."""
        with subprocess.Popen(
            [sys.executable, "-m", "lpac.cli.main", *map(str, arguments)],
            cwd=ROOT, env=self.environment, text=True,
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        ) as process:  # fmt: skip
            try:
                yield process
            finally:
                process.kill()


@contextlib.contextmanager
def ground(folder: Path, fleet: FlownFleet, name: str) -> Iterator[dict[str, str]]:
    """A ground station with a folder of its own; the environment in which its clients find it."""
    folder.mkdir()
    environment = os.environ | {"XDG_RUNTIME_DIR": str(folder), "LPAC_FLEET": str(fleet.fleet_toml)}
    process = subprocess.Popen(
        [sys.executable, "-m", "lpac.cli.main", "ground", "--name", name],
        cwd=ROOT, env=environment, stdout=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("XDG_RUNTIME_DIR", str(folder))
            wait_for_snapshot(fleet.name)
        yield environment
    finally:
        # The second Ctrl-C ends it also while robots fly.
        process.terminate()
        process.wait()


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Field]:
    folder = tmp_path_factory.mktemp("field")
    with (
        FlownFleet(folder, 3, spares=1) as fleet,
        ground(folder / "run", fleet, "alice") as environment,
    ):
        yield Field(fleet, environment)


@pytest.fixture
def field(shared: Field, monkeypatch: pytest.MonkeyPatch) -> Iterator[Field]:
    """The fleet on the ground, with the origin set, and nothing asked of it."""
    for name in ("XDG_RUNTIME_DIR", "LPAC_FLEET"):
        monkeypatch.setenv(name, shared.environment[name])
    shared.do("mission", "origin", *AT)
    stand_at_pads(shared)
    yield shared
    with_pilot = [f"r{i}" for i, robot in enumerate(shared.robots) if robot.state is _S.PILOT]
    if with_pilot:
        shared.lpac("mission", "resume")
        shared.do("mission", "rejoin", *with_pilot)
    shared.do("mission", "land", "--wait")
    shared.do("mission", "resume")


def stand_at_pads(field: Field) -> None:
    field.stand(dict(enumerate(PADS_M)))


def states(field: Field) -> list[FlightState]:
    return [robot.state for robot in field.robots]


# Mistakes


def test_operators_mistakes_are_one_line_each(field: Field, tmp_path: Path) -> None:
    bad = tmp_path / "bad.env"
    bad.write_text("CircularBND 1 2\n")
    mission = field.refused
    assert "is unknown; known are r0, r1, r2" in mission("mission", "hold", "--robots", "r7")
    assert "is unknown; known are" in mission("mission", "kill", "r7", "--yes")
    assert mission("mission", "origin", "48", "11", "360") == (
        "origin: heading_deg = 360.0: must be in [0, 360)"
    )
    assert "origin: mission origin latitude = 91.0 deg: must be in [-90, 90]" in mission(
        "mission", "origin", "91", "11", "0"
    )
    assert "LAT LON HEADING_DEG, or --from ROBOT" in mission("mission", "origin", "48", "11")
    assert "not both" in mission("mission", "origin", *AT, "--from", "r1")
    assert "'r9' is unknown" in mission("mission", "origin", "--from", "r9")
    assert "fence set: '3': must be X,Y" in mission("mission", "fence", "set", "3", "4,5")
    assert "fence set: vertices_m has 2" in mission("mission", "fence", "set", "3,3", "4,5")
    assert "--yes" in mission("mission", "fence", "off")
    assert "--yes" in mission("mission", "kill", "r1")
    assert "--yes" in mission("mission", "kill", "--robots", "r1")
    assert "kill: name the robots" in mission("mission", "kill", "--yes")
    for by_name in ("pilot", "rejoin"):
        assert f"{by_name}: name the robots, such as" in mission("mission", by_name)
    assert "not both" in mission("mission", "pilot", "r1", "--robots", "r1")
    assert f"{bad}: record 1 (CircularBND): sigma is missing" in mission("mission", "world", bad)
    assert "cannot be read" in mission("mission", "world", tmp_path / "none.env")
    assert "there is no such site; known are none" in mission("site", "use", "park")
    assert "--toward needs --from" in mission("site", "save", "park", "--toward", "r1")
    missing = tmp_path / "fleet.toml"
    assert f"{missing}: cannot be read" in mission("mission", "hold", "--fleet", missing)
    assert all(state in (_S.IDLE, _S.PREFLIGHT) for state in states(field))


def test_without_ground_or_origin_nothing_takes_off(
    tmp_path: Path, short_path: Path, field: Field, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "other"
    folder.mkdir()
    with FlownFleet(folder, 1) as fleet:
        at = ("--fleet", fleet.fleet_toml)
        why = field.refused("mission", "takeoff", *at)
        assert f"fleet {fleet.name} here: start `lpac ground`" in why
        assert "start `lpac ground`" in field.refused("mission", "rehearse", *at)
        with ground(short_path / "run", fleet, "bob") as environment:
            monkeypatch.setenv("XDG_RUNTIME_DIR", environment["XDG_RUNTIME_DIR"])
            assert "no mission origin" in field.refused("mission", "takeoff", *at)
            assert "the origin is not set" in field.refused("mission", "assign", *at)
            assert fleet.flown[0].state is _S.IDLE
    monkeypatch.setenv("XDG_RUNTIME_DIR", field.environment["XDG_RUNTIME_DIR"])


# A flight


def test_fleet_flies_as_it_is_told(field: Field) -> None:
    field.do("mission", "enable")
    done = field.do("mission", "takeoff", "--interval", "0.1", "--json")
    assert {name: robot["done"] for name, robot in done.robots.items()} == {
        "r0": True, "r1": True, "r2": True,
    }  # fmt: skip
    world = field.fleet.folder / "world.env"
    assert "r0, r1, r2 are armed" in field.refused("mission", "world", world)
    assert "are armed" in field.refused("mission", "origin", *AT)
    assert "are armed" in field.refused("mission", "fence", "on")
    assert "armed: carry disarmed robots only" in field.refused("mission", "rehearse")
    assert "r0 is armed: land first" in field.refused("mission", "assign", "--seconds", "0.5")

    done = field.lpac("mission", "disarm", "r1")
    assert done.code == 1
    assert re.search(r"r1 +FAILED +in the air: land it first", done.out)
    assert "disarm: 0 of 1 robot did it; failed: r1" in done.err

    field.do("mission", "start")
    assert states(field) == [_S.MISSION] * 3
    field.do("mission", "pilot", "r2")
    assert states(field) == [_S.MISSION, _S.MISSION, _S.PILOT]
    field.do("mission", "rejoin", "--robots", "r2")
    field.do("mission", "hold", "r0")
    assert states(field) == [_S.HOLD, _S.MISSION, _S.HOLD]
    field.do("mission", "resume", "--robots", "r0")
    assert states(field)[0] is _S.MISSION
    assert "fly the mission: hold or land first" in field.refused("mission", "again")
    field.do("mission", "disable")
    assert states(field) == [_S.HOLD] * 3
    field.do("mission", "enable")
    field.do("mission", "return", "--wait")
    assert states(field) == [_S.LANDED] * 3

    field.do("mission", "again", "windy")
    snapshot = wait_for_snapshot(
        field.fleet.name, lambda p: p.ground is not None and p.ground.trial == "windy"
    )
    # Nobody flies it yet.
    assert [r.status and r.status.trial for r in snapshot.robots[:3]] == ["", "", ""]
    field.do("mission", "disarm")


def test_ctrl_c_withdraws_no_return(field: Field) -> None:
    field.do("mission", "enable")
    field.do("mission", "takeoff", "--interval", "0")
    with field.running("mission", "return", "--wait") as process:
        assert process.stderr is not None
        assert "r" in process.stderr.readline()
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60.0)
    assert process.returncode == 130
    last = err.splitlines()[-1]
    assert last == "lpac: return: interrupted: robots that were told to return go on with it"
    until(lambda: states(field) == [_S.LANDED] * 3)


def test_kill_names_its_robots_and_asks(field: Field) -> None:
    field.do("mission", "enable")
    field.do("mission", "takeoff", "--robots", "r1")
    assert "KILL r1? What flies falls." in on_terminal(field, "n\n", "mission", "kill", "r1")
    assert field.robots[1].state is _S.HOLD
    on_terminal(field, "y\n", "mission", "kill", "r1")
    assert states(field)[1] is _S.FAULT
    assert states(field)[0] is not _S.FAULT
    with field.fleet.paused():
        field.robots[1].program.start()
    until(lambda: field.robots[1].state in (_S.IDLE, _S.PREFLIGHT))


def on_terminal(field: Field, answer: str, *arguments: str) -> str:
    """What a command prints on a terminal at which somebody types."""
    ours, theirs = pty.openpty()
    with subprocess.Popen(
        [sys.executable, "-m", "lpac.cli.main", *arguments],
        cwd=ROOT, env=field.environment, stdin=theirs, stdout=theirs, stderr=theirs,
    ) as process:  # fmt: skip
        os.close(theirs)
        os.write(ours, answer.encode())
        printed = b""
        with contextlib.suppress(OSError):  # its end
            while chunk := os.read(ours, 4096):
                printed += chunk
        process.wait()
    os.close(ours)
    return printed.decode()


def test_observer_may_hold_and_must_ask_for_the_rest(
    field: Field, short_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    field.do("mission", "enable")
    field.do("mission", "takeoff", "--interval", "0")
    field.do("mission", "start")
    with ground(short_path / "run", field.fleet, "bob") as environment:
        monkeypatch.setenv("XDG_RUNTIME_DIR", environment["XDG_RUNTIME_DIR"])
        assert "alice" in field.refused("mission", "return")
        field.do("mission", "hold")
        assert states(field) == [_S.HOLD] * 3
        field.do("mission", "command")
        field.do("mission", "land", "--wait")
        monkeypatch.setenv("XDG_RUNTIME_DIR", field.environment["XDG_RUNTIME_DIR"])
        assert "bob" in field.refused("mission", "start")
        field.do("mission", "command")


# Where

NEAR = ("39.9530", "-75.1648", "0.5")  # not where the field's origin is


def test_origin_is_as_given_or_as_robots_stand(field: Field) -> None:
    before = field.robots[0].said.origin
    far = field.lpac("mission", "origin", "-33.86", "-151.2", "0.5")
    assert re.search(r"NOTE: robots are up to 1\d+\.\d km from this origin", far.err)
    # Nor do they take it up.
    assert far.code == 1 and "0 of 3 robots did it; failed: r0, r1, r2" in far.err
    assert field.robots[0].said.origin == before
    field.do("mission", "origin", *NEAR)
    origin = field.robots[0].said.origin
    assert origin is not None
    assert (origin.latitude_deg, origin.longitude_deg) == (39.9530, -75.1648)

    done = field.do("mission", "origin", "--from", "r1", "--seconds", "0.5")
    assert re.search(r"r1 stands within 0\.\d\d m, its heading is within 0\.\d deg", done.err)
    origin = field.robots[0].said.origin
    assert origin is not None
    assert origin.heading_deg == pytest.approx(ORIGIN.heading_deg, abs=0.1)

    # r2 stands 4 m to the right of r1.
    done = field.do("mission", "origin", "--from", "r1", "--toward", "r2", "--seconds", "0.5")
    told = re.search(r"(.\..) m apart: 1 m of GPS error turns the heading by (\d+) deg", done.err)
    assert told is not None
    assert float(told[1]) == pytest.approx(4.0, abs=NOISE_M)
    turned_deg = math.degrees(math.atan2(1.0, float(told[1])))
    assert float(told[2]) == pytest.approx(turned_deg, abs=1.0)
    origin = field.robots[0].said.origin
    assert origin is not None
    # Either of the two may err.
    most_deg = math.degrees(math.atan2(2.0 * NOISE_M, 4.0))
    assert origin.heading_deg == pytest.approx(ORIGIN.heading_deg + 90.0, abs=most_deg)


def test_fence_is_set_switched_off_and_on(field: Field) -> None:
    corners = ("-2,-2", "20,-2", "20,20", "-2,20")
    field.do("mission", "fence", "set", *corners, "--ceiling", "25")
    fences = {robot.said.fence for robot in field.robots}
    (fence,) = fences
    assert fence is not None
    assert fence.vertices_m == ((-2.0, -2.0), (20.0, -2.0), (20.0, 20.0), (-2.0, 20.0))
    assert (fence.buffer_m, fence.floor_m, fence.ceiling_m) == (1.5, 2.5, 25.0)
    field.do("mission", "fence", "off", "--yes")
    fence = field.robots[0].said.fence
    assert fence is not None
    assert fence.distance_m(0.0, 0.0) == 100.0
    field.do("mission", "fence", "on")
    assert field.robots[0].said.fence == field.fleet.layout.fence
    assert field.fleet.layout.fence.vertices_m[2] == (34.0, 34.0)


def test_world_is_parsed_and_sent(field: Field, tmp_path: Path) -> None:
    file = tmp_path / "small.env"
    file.write_text("CircularBND 100 100 20 5\n")
    before = field.robots[0].said.world_id
    done = field.do("mission", "world", file)
    world_id = field.robots[0].said.world_id
    assert world_id != before
    assert f"world: small.env, {world_id}" in done.err
    field.do("mission", "world", field.fleet.folder / "world.env")


def test_robots_get_the_slots_of_the_pads_where_they_stand(field: Field) -> None:
    def slots() -> list[int]:
        lowest_m, spacing_m = 5.0, PRECISE.slot_spacing.least_m
        heights_m = [robot.said.slot_height_m for robot in field.robots]
        return [round((height_m - lowest_m) / spacing_m) for height_m in heights_m]

    field.stand({0: PADS_M[1], 1: PADS_M[0]})
    done = field.do("mission", "assign", "--seconds", "0.5", "--json")
    pads = {name: robot["pad"] for name, robot in done.robots.items()}
    assert pads == {"r0": 1, "r1": 0, "r2": 2}
    assert slots() == [1, 0, 2]

    def problem(robot: int, place_m: tuple[float, float]) -> str:
        field.stand({robot: place_m})
        return field.refused("mission", "assign", "--seconds", "0.5")

    why = problem(2, (7.0, 9.0))
    assert re.search(r"r2 at \([67]\.., [89]\..\) m stands within 3 m of no pad", why)
    why = problem(2, (8.3, 2.0))
    assert re.search(r"r2 at \([78]\.., [12]\..\) m is ambiguous: pad 2 is [12]\.. m", why)
    assert "r1 and r2 stand at one pad, 0" in problem(2, (1.5, 2.0))
    stand_at_pads(field)
    assert "r0 stands at pad 0, which r1 has: assign both at once" in field.refused(
        "mission", "assign", "--seconds", "0.5", "--robots", "r0"
    )
    field.do("mission", "assign", "--seconds", "0.5")
    assert slots() == [0, 1, 2]


def test_site_is_saved_and_used_again(field: Field) -> None:
    park = ("site", "save", "park", "--land-at-pads", "--seconds", "0.5", "--json")
    field.stand({0: (6.0, 8.0), 1: (8.0, 8.0), 2: (14.0, 8.0)})
    why = field.refused(*park)
    assert re.search(r"is [12]\.\d+ m from pad_m of height 1, must be 2\.5 m", why)
    field.stand({i: (6.0 + 4.0 * i, 8.0) for i in range(3)})
    field.do("mission", "fence", "set", "0,0", "30,0", "30,30", "0,30")
    done = field.do(*park)
    slots = json.loads(done.out)["slots"]
    saved_m = [slot["pad_m"] for slot in slots]
    for pad_m, place_m in zip(saved_m, [(6.0, 8.0), (10.0, 8.0), (14.0, 8.0)], strict=True):
        assert math.dist(pad_m, place_m) < NOISE_M
    assert "park.toml: is there already: add --force" in field.refused("site", "save", "park")

    # Another site, from the robots: r0 is its origin, and r1 stands along its y axis.
    save = ("site", "save", "yard", "--from", "r0", "--toward", "r1", "--seconds", "0.5")
    why = field.refused(*save)
    assert re.search(r"r0 stands at \(-?0\.., -?0\..\) m, outside the fence: another --from", why)
    field.do("mission", "fence", "on")
    field.do(*save)
    yard = tomllib.loads((field.fleet.folder / "sites" / "yard.toml").read_text())
    second = yard["slots"][1]
    assert math.dist(second["pad_m"], (0.0, 4.0)) < NOISE_M
    assert second["landing_point_m"] == [6.0, 2.0]

    field.do("mission", "origin", *NEAR)
    field.do("site", "use", "park")
    for robot, slot in zip(field.robots, slots, strict=True):
        fence = robot.said.fence
        assert robot.said.origin == ORIGIN
        assert fence is not None and fence.vertices_m[2] == (30.0, 30.0)
        assert list(robot.said.landing_point_m) == slot["landing_point_m"]
    (field.fleet.folder / "sites" / "torn.toml").write_text("[origin")
    done = field.do("site", "list")
    assert re.search(r"torn +unreadable *\n", done.out)
    assert "torn.toml: no TOML" in done.err
    assert re.search(r"park .* used last *\n", done.out)
    assert re.search(r"yard .* 3 +\n", done.out)
    assert "pads of site park" in field.do("mission", "assign", "--seconds", "0.5").err
    assert "yard has another origin than the fleet" in field.refused(
        "mission", "assign", "--site", "yard"
    )

    field.do("mission", "takeoff", "--robots", "r0")
    assert "r0 is armed" in field.refused("site", "use", "yard")
    field.do("mission", "land", "--wait")
    stand_at_pads(field)
    field.do("mission", "fence", "on")
    field.do("mission", "origin", *AT[:2], "30.5")  # so that no site is in use
    field.do("mission", "assign", "--seconds", "0.5")


def test_rehearsal_shows_the_command_from_the_nose(field: Field) -> None:
    done = field.do("mission", "rehearse", "--robots", "r1", "--seconds", "0.5")
    assert re.search(
        r"r1: x [56]\.. m, y [12]\.. m, nose (0|360) deg, inside the fence by [34]\.. m, "
        r"commanded: \S \d\.\d m/s, [a-z-]+ \d+ deg( left| right)?\n",
        done.out,
    )
    done = field.do("mission", "rehearse", "--robots", "r1", "--seconds", "0.5", "--json")
    seen = json.loads(done.out.splitlines()[0])
    assert math.dist(seen["position_m"], PADS_M[1]) < NOISE_M
    assert seen["commanded"]["arrow"] in "↑↗→↘↓↙←↖"


# Scripts


def write_script(field: Field, duration_s: float, **changes: str) -> Path:
    """The example, flown faster."""
    text = SCRIPT.read_text()
    for before, after in (
        ("latitude_deg = 47.397742", f"latitude_deg = {ORIGIN.latitude_deg}"),
        ("longitude_deg = 8.545594", f"longitude_deg = {ORIGIN.longitude_deg}"),
        ("duration_s = 120.0", f"duration_s = {duration_s}"),
        ("at_s = 40.0", "at_s = 0.5"),
        ("at_s = 80.0", f"at_s = {min(1.5, duration_s)}"),
        ("trials = 3", "trials = 2"),
        ("# interval_s = 2.0", "interval_s = 0.1"),
        *changes.items(),
    ):
        assert before in text
        text = text.replace(before, after)
    path = field.fleet.folder / "script.toml"
    path.write_text(text)
    return path


@contextlib.contextmanager
def flown(field: Field, script: Path) -> Iterator["subprocess.Popen[str]"]:
    """A process that runs the script, from when the mission is flown."""
    with field.running("mission", "run", script, "--yes") as process:
        assert process.stderr is not None
        while "mission, 600 s" not in process.stderr.readline():
            assert process.poll() is None
        yield process


def test_example_script_is_flown(field: Field) -> None:
    assert "asks before the next trial takes off" in field.refused(
        "mission", "run", write_script(field, 6.0)
    )
    field.do("mission", "again", "paper-4")
    script = write_script(field, 6.0)
    done = field.do("mission", "run", script, "--yes", "--json")
    assert "left the mission" not in done.err
    lines = [re.sub(r"^ *[\d.]+ s  ", "", line) for line in done.err.splitlines()]
    in_trial = ["reset maps", "preflight, 60 s", "takeoff", "start", "mission, 6 s",
                "r2 is given to a pilot", "r2 is back in the mission", "return"]  # fmt: skip
    steps = [line.partition(": ")[2] if line.startswith("trial") else line for line in lines]
    assert [step for step in steps if step in in_trial] == [*in_trial, *in_trial]
    assert steps[0] == "origin"
    *ended, outcome = map(json.loads, done.out.splitlines())
    assert ended[-1]["step"] == "trial 2 of 2: return" and ended[-1]["duration_s"] > 0.0
    assert outcome == {"script": str(script), "done": True, "problem": None}
    assert lines[-1].endswith("script.toml: done")
    assert states(field) == [_S.LANDED] * 3
    assert {robot.said.trial for robot in field.robots} == {"paper-6"}


def test_interrupted_script_holds_the_fleet(field: Field) -> None:
    script = write_script(field, 600.0, **{"at_s = 1.5": "at_s = 599.5"})
    with field.running("mission", "run", script, "--yes") as process:
        until(lambda: states(field) == [_S.MISSION, _S.MISSION, _S.PILOT])
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60.0)
    assert process.returncode == 130
    assert states(field)[:2] == [_S.HOLD, _S.HOLD]
    assert "interrupted; " in err
    assert "next `lpac mission land`, `lpac mission return`, or `lpac mission resume`" in err
    assert "Traceback" not in err


def test_script_starts_again_who_holds_by_itself_and_gives_way_to_people(field: Field) -> None:
    script = write_script(
        field, 600.0, **{"at_s = 0.5": "at_s = 599.0", "at_s = 1.5": "at_s = 599.5"}
    )
    with flown(field, script) as process:
        with field.fleet.paused():
            field.robots[0].program.loops["control"].hang(0.9)
        until(lambda: field.robots[0].state is _S.HOLD)
        until(lambda: field.robots[0].state is _S.MISSION)
        field.do("mission", "hold")
        _, err = process.communicate(timeout=60.0)
    assert process.returncode == 1
    assert re.search(r"r0 left the mission: hold: control was silent for \d\.\d s", err)
    assert "mission (steps[2]): alice commands hold: the fleet is theirs" in err
    assert states(field) == [_S.HOLD] * 3


def test_script_ends_with_the_step_that_fails_and_holds_the_fleet(
    field: Field, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = field.robots[2]

    def once_it_lands(order: Order) -> bool:
        """Its battery is critical just before."""
        if order.kind == "pilot":
            robot.vehicle.battery_remaining = 0.1
        return order.kind != "pilot" or robot.state is _S.LAND

    monkeypatch.setitem(field.fleet.hears, 2, once_it_lands)
    with flown(field, write_script(field, 600.0)) as process:
        _, why = process.communicate(timeout=60.0)
    assert process.returncode == 1
    robot.vehicle.battery_remaining = 1.0
    assert "trial 1 of 2: mission (steps[2]): r2: pilot is not taken in land" in why
    assert "the fleet is told to hold, but r2: land: battery critical" in why
    assert "next `lpac mission land`" in why
    assert states(field)[:2] == [_S.HOLD, _S.HOLD]

    bad = write_script(field, 2.0, **{'robot = "r2"': 'robot = "r8"'})
    assert "script.toml: robot 'r8' is unknown; known are r0" in field.refused(
        "mission", "run", bad, "--yes"
    )


def test_hold_is_the_operators_also_while_the_script_starts_a_robot(
    field: Field, monkeypatch: pytest.MonkeyPatch
) -> None:
    kinds: list[OrderKind] = []

    def heard(order: Order) -> bool:
        """Its policy falls silent once it is taken back, so that it does not start again."""
        kinds.append(order.kind)
        if order.kind == "rejoin":
            field.robots[2].program.loops["policy"].hang(60.0)
        return True

    monkeypatch.setitem(field.fleet.hears, 2, heard)
    with flown(field, write_script(field, 600.0)) as process:
        until(lambda: "rejoin" in kinds and kinds[-1] == "start")
        field.do("mission", "hold")
        _, err = process.communicate(timeout=60.0)
    assert process.returncode == 1
    assert "mission (steps[2]): alice commands hold: the fleet is theirs" in err
    assert "told to hold" not in err
    # It thinks again, for the tests that follow.
    field.robots[2].program.loops["policy"].hang(0.0)


def test_script_says_what_is_missing(field: Field) -> None:
    field.do("mission", "enable")
    wait_for_snapshot(
        field.fleet.name, lambda p: all(r.status and r.status.ready for r in p.robots[:3])
    )
    field.do("mission", "hold", "r1")
    script = write_script(field, 2.0, **{"# at_most_s = 60": "at_most_s = 1"})
    why = field.refused("mission", "run", script, "--yes")
    assert "trial 1 of 2: preflight (steps[0]): not ready after 1 s: r1 is told to hold" in why
    assert "nobody is in the air" in why
