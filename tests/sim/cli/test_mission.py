"""`lpac mission` and `lpac site` in this process, with grounds and robots on a simulated clock."""

import contextlib
import json
import math
import re
import shutil
import signal
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any, NamedTuple

import numpy as np
import pytest

from edge.identity.envelope import HEAD_BYTES
from edge.messages.codec import decode
from edge.messages.mission import FlightState, Order
from edge.messages.topics import ORDER
from lpac.ground.procedure import Procedure, Until
from lpac.ground.station.protocol import (
    CommandReport,
    Enable,
    Request,
    SafetyCommand,
    SetOrigin,
    Start,
    Takeoff,
)
from lpac.sim.air import RadioLink
from lpac.sim.fleet.layout import ORIGIN
from lpac.sim.fleet.simulated import SimulatedFleet, SimulatedGround
from lpac.sim.scenario import Scenario
from tests.command import called
from tests.conftest import ROOT, SHIPPED
from tests.flown import PRECISE, QUICK
from tests.sim.ground.field import SPARING, Field, FieldRobot

_S = FlightState
AT = (str(ORIGIN.latitude_deg), str(ORIGIN.longitude_deg), str(ORIGIN.heading_deg))
SCRIPT = ROOT / "docs" / "script.toml"
# By how much a place that a robot takes itself to be at errs here.
NOISE_M = 0.5
PADS_M = ((2.0, 2.0), (6.0, 2.0), (10.0, 2.0))


class Looking:
    """A `GroundSubscriber` of a simulated ground; a context."""

    def __init__(self, ground: SimulatedGround) -> None:
        self._ground = ground

    def __enter__(self) -> "Looking":
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing is open."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._ground, name)

    def wait_for(self, condition: Callable[[Any], bool], timeout_s: float) -> bool:
        def wait() -> Procedure[bool]:
            came: bool = yield Until(condition, timeout_s)
            return came

        return self._ground.carry_out(wait())


class Commanded:
    """A field that `lpac` commands by way of the ground `at`."""

    def __init__(self, field: Field, folder: Path) -> None:
        self.field = field
        self.folder = folder
        self.fleet = field.fleet
        self.robots = field.robots[:3]
        self.at = "alice"

    @property
    def ground(self) -> SimulatedGround:
        return self.fleet.grounds[self.at]

    def do(self, *arguments: str | Path) -> "CompletedProcess[str]":
        """The command, which must be done by all."""
        done = called(*arguments)
        assert done.returncode == 0, done
        return done

    def refused(self, *arguments: str | Path) -> str:
        """The line that says why the command was not done."""
        done = called(*arguments)
        assert done.returncode == 1, done
        last = done.stderr.splitlines()[-1]
        assert last.startswith("lpac: ")
        assert "Traceback" not in done.stderr
        return last.removeprefix("lpac: ")

    def stand(self, places_m: Mapping[int, Sequence[float]]) -> None:
        """Put robots there, and wait until the ground knows it."""
        for robot, place_m in places_m.items():
            north_m, east_m = self.fleet.layout.to_world_m(np.array(place_m))
            self.robots[robot].vehicle.position_m = np.array([north_m, east_m, 0.0])
        self.field.run(2.0)

    def stand_at_pads(self) -> None:
        self.stand(dict(enumerate(PADS_M)))

    def states(self) -> list[FlightState]:
        return [robot.state for robot in self.robots]

    def once(self, condition: Callable[[], object], do: Callable[[], object]) -> None:
        """Do it at the first moment when that is so, whatever runs then."""

        def look() -> None:
            if condition():
                looks.stop()
                do()

        looks = self.fleet.schedule.every(0.05, look)

    def hears(self, robot: FieldRobot, heard: Callable[[Order], bool]) -> None:
        """Let an order reach the robot only if `heard` says so."""
        link = robot.program._link
        assert isinstance(link, RadioLink)
        hear = link._subscriptions[ORDER]

        def hear_order(key: str, data: bytes) -> None:
            payload = ORDER.unpacked(data[HEAD_BYTES:])
            assert payload is not None
            order = decode(Order, payload)
            if order.robot_id != robot.robot_id or heard(order):
                hear(key, data)

        link._subscriptions = {**link._subscriptions, ORDER: hear_order}


class Stages(NamedTuple):
    """Fleets that tests copy, and the folder that describes them."""

    folder: Path
    standing: Field
    on_ground: Field
    flying: Field


@pytest.fixture(scope="module")
def stages(tmp_path_factory: pytest.TempPathFactory) -> Stages:
    """Three robots and a spare, with noses along the y axis."""
    folder = tmp_path_factory.mktemp("field")
    scenario = Scenario(
        robots=4, seed=3, errors=False, budget=PRECISE, starts_m=(*PADS_M, (14.0, 2.0))
    )
    fleet = SimulatedFleet(
        scenario, folder, SHIPPED, operator="alice", settings=SPARING, spares=1, vehicle_step_s=0.1
    )
    for each in fleet.vehicles:
        each.vehicle.parameters |= QUICK
        each.vehicle.heading_rad = math.radians(ORIGIN.heading_deg)
    standing = Field(fleet)
    standing.until(lambda: all(robot.program.status for robot in standing.robots))
    standing.until(lambda: standing.states() == {_S.IDLE})
    on_ground = standing.copy()
    on_ground.done(SetOrigin(ORIGIN))
    flying = on_ground.copy()
    for request in (Enable(), Takeoff(interval_s=0.0), Start()):
        flying.done(request)
    return Stages(folder, standing, on_ground, flying)


@pytest.fixture
def field(stages: Stages, tmp_path: Path) -> Iterator[Commanded]:
    """The fleet on the ground, with the origin set, and nothing asked of it."""
    with commanded(stages.on_ground, stages.folder, tmp_path) as on_ground:
        yield on_ground


@pytest.fixture
def flying(stages: Stages, tmp_path: Path) -> Iterator[Commanded]:
    """The fleet in its mission."""
    with commanded(stages.flying, stages.folder, tmp_path) as in_mission:
        yield in_mission


@contextlib.contextmanager
def commanded(stage: Field, described: Path, folder: Path) -> Iterator[Commanded]:
    for name in ("fleet.toml", "world.env"):
        shutil.copy(described / name, folder)
    field = Commanded(stage.copy(), folder)

    def command(_: str, request: Request, *__: object) -> CommandReport:
        return field.ground.command(request)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lpac.ground.station.client.command", command)
        patch.setattr(
            "lpac.ground.station.subscriber.GroundSubscriber", lambda _: Looking(field.ground)
        )
        patch.setenv("LPAC_FLEET", str(folder / "fleet.toml"))
        # A script has its own.
        before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP)}
        yield field
        for number, handler in before.items():
            signal.signal(number, handler)


# Mistakes


def test_operators_mistakes_are_one_line_each(field: Commanded, tmp_path: Path) -> None:
    bad = tmp_path / "bad.env"
    bad.write_text("CircularBND 1 2\n")
    refused = field.refused
    assert "is unknown; known are r0, r1, r2" in refused("mission", "hold", "--robots", "r7")
    assert "is unknown; known are" in refused("mission", "kill", "r7", "--yes")
    assert refused("mission", "origin", "48", "11", "360") == (
        "origin: heading_deg = 360.0: must be at least 0 and below 360"
    )
    assert "origin: latitude_deg = 91.0: must be from -90 to 90" in refused(
        "mission", "origin", "91", "11", "0"
    )
    assert "LAT LON HEADING_DEG, or --from ROBOT" in refused("mission", "origin", "48", "11")
    assert "not both" in refused("mission", "origin", *AT, "--from", "r1")
    assert "'r9' is unknown" in refused("mission", "origin", "--from", "r9")
    assert "fence set: '3': must be X,Y" in refused("mission", "fence", "set", "3", "4,5")
    assert "fence set: vertices_m = [(3.0, 3.0), (4.0, 5.0)]: must be 3 to 100 long" in refused(
        "mission", "fence", "set", "3,3", "4,5"
    )
    assert "--yes" in refused("mission", "fence", "off")
    assert "--yes" in refused("mission", "kill", "r1")
    assert "--yes" in refused("mission", "kill", "--robots", "r1")
    assert "kill: name the robots" in refused("mission", "kill", "--yes")
    for by_name in ("pilot", "rejoin"):
        assert f"{by_name}: name the robots, such as" in refused("mission", by_name)
    assert "not both" in refused("mission", "pilot", "r1", "--robots", "r1")
    assert f"{bad}: record 1 (CircularBND): sigma is missing" in refused("mission", "world", bad)
    assert "cannot be read" in refused("mission", "world", tmp_path / "none.env")
    assert "no such site; known are none" in refused("site", "use", "park")
    assert "--toward needs --from" in refused("site", "save", "park", "--toward", "r1")
    missing = tmp_path / "none.toml"
    assert f"{missing}: cannot be read" in refused("mission", "hold", "--fleet", missing)
    assert field.states() == [_S.IDLE] * 3


def test_without_origin_nothing_takes_off(stages: Stages, tmp_path: Path) -> None:
    with commanded(stages.standing, stages.folder, tmp_path) as field:
        assert "no mission origin" in field.refused("mission", "takeoff")
        assert "the origin is not set" in field.refused("mission", "assign")
        assert field.states() == [_S.IDLE] * 3


# A flight


def test_fleet_flies_as_it_is_told(field: Commanded) -> None:
    field.do("mission", "enable")
    done = field.do("mission", "takeoff", "--interval", "0.1", "--json")
    assert {name: robot["done"] for name, robot in json.loads(done.stdout)["robots"].items()} == {
        "r0": True, "r1": True, "r2": True,
    }  # fmt: skip
    assert "r0, r1, r2 are armed" in field.refused("mission", "world", field.folder / "world.env")
    assert "are armed" in field.refused("mission", "origin", *AT)
    assert "are armed" in field.refused("mission", "fence", "on")
    why = field.refused("mission", "rehearse", "--seconds", "0.5")
    assert "armed: carry disarmed robots only" in why
    assert "r0 is armed: land first" in field.refused("mission", "assign", "--seconds", "0.5")

    done = called("mission", "disarm", "r1")
    assert done.returncode == 1
    assert re.search(r"r1 +FAILED +in the air: land it first", done.stdout)
    assert "disarm: 0 of 1 robot did it; failed: r1" in done.stderr

    field.do("mission", "start")
    assert field.states() == [_S.MISSION] * 3
    field.do("mission", "pilot", "r2")
    assert field.states() == [_S.MISSION, _S.MISSION, _S.PILOT]
    field.do("mission", "rejoin", "--robots", "r2")
    field.do("mission", "hold", "r0")
    assert field.states() == [_S.HOLD, _S.MISSION, _S.HOLD]
    field.do("mission", "resume", "--robots", "r0")
    assert field.states()[0] is _S.MISSION
    assert "fly the mission: hold or land first" in field.refused("mission", "again")
    field.do("mission", "disable")
    assert field.states() == [_S.HOLD] * 3
    field.do("mission", "enable")
    field.do("mission", "return", "--wait")
    assert field.states() == [_S.LANDED] * 3

    field.do("mission", "again", "windy")
    snapshot = field.ground.node.snapshot
    assert snapshot.ground is not None and snapshot.ground.trial == "windy"
    # Nobody flies it yet.
    assert [r.status and r.status.trial for r in snapshot.robots[:3]] == ["", "", ""]
    field.do("mission", "disarm")


def test_observer_may_hold_and_must_ask_for_the_rest(flying: Commanded) -> None:
    flying.fleet.join("bob")
    flying.field.run(2.0)
    flying.at = "bob"
    assert "alice" in flying.refused("mission", "return")
    flying.do("mission", "hold")
    assert flying.states() == [_S.HOLD] * 3
    flying.do("mission", "command")
    flying.do("mission", "land", "--wait")
    flying.at = "alice"
    assert "bob" in flying.refused("mission", "start")
    flying.do("mission", "command")


# Where

NEAR = ("39.9530", "-75.1648", "0.5")  # not where the field's origin is


def test_origin_is_as_given_or_as_robots_stand(field: Commanded) -> None:
    before = field.robots[0].said.origin
    far = called("mission", "origin", "-33.86", "-151.2", "0.5")
    assert re.search(r"NOTE: robots are up to 1\d+\.\d km from this origin", far.stderr)
    # Nor do they take it up.
    assert far.returncode == 1 and "0 of 3 robots did it; failed: r0, r1, r2" in far.stderr
    assert field.robots[0].said.origin == before
    field.do("mission", "origin", *NEAR)
    origin = field.robots[0].said.origin
    assert origin is not None
    assert (origin.latitude_deg, origin.longitude_deg) == (39.9530, -75.1648)

    done = field.do("mission", "origin", "--from", "r1", "--seconds", "0.5")
    assert re.search(r"r1 stands within 0\.\d\d m, its heading is within 0\.\d deg", done.stderr)
    origin = field.robots[0].said.origin
    assert origin is not None
    assert origin.heading_deg == pytest.approx(ORIGIN.heading_deg, abs=0.1)

    # r2 stands 4 m to the right of r1.
    done = field.do("mission", "origin", "--from", "r1", "--toward", "r2", "--seconds", "0.5")
    told = re.search(
        r"(.\..) m apart: 1 m of GPS error turns the heading by (\d+) deg", done.stderr
    )
    assert told is not None
    assert float(told[1]) == pytest.approx(4.0, abs=NOISE_M)
    turned_deg = math.degrees(math.atan2(1.0, float(told[1])))
    assert float(told[2]) == pytest.approx(turned_deg, abs=1.0)
    origin = field.robots[0].said.origin
    assert origin is not None
    # Either of the two may err.
    most_deg = math.degrees(math.atan2(2.0 * NOISE_M, 4.0))
    assert origin.heading_deg == pytest.approx(ORIGIN.heading_deg + 90.0, abs=most_deg)


def test_fence_is_set_switched_off_and_on(field: Commanded) -> None:
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


def test_world_is_parsed_and_sent(field: Commanded, tmp_path: Path) -> None:
    file = tmp_path / "small.env"
    file.write_text("CircularBND 100 100 20 5\n")
    before = field.robots[0].said.world_id
    done = field.do("mission", "world", file)
    world_id = field.robots[0].said.world_id
    assert world_id != before
    assert f"world: small.env, {world_id}" in done.stderr


def test_robots_get_the_slots_of_the_pads_where_they_stand(field: Commanded) -> None:
    def slots() -> list[int]:
        lowest_m, spacing_m = 5.0, PRECISE.slot_spacing.least_m
        heights_m = [robot.said.slot_height_m for robot in field.robots]
        return [round((height_m - lowest_m) / spacing_m) for height_m in heights_m]

    field.stand({0: PADS_M[1], 1: PADS_M[0]})
    done = field.do("mission", "assign", "--seconds", "0.5", "--json")
    pads = {name: robot["pad"] for name, robot in json.loads(done.stdout)["robots"].items()}
    assert pads == {"r0": 1, "r1": 0, "r2": 2}
    assert slots() == [1, 0, 2]

    def problem(robot: int, place_m: tuple[float, float]) -> str:
        field.stand({robot: place_m})
        return field.refused("mission", "assign", "--seconds", "0.5")

    why = problem(2, (7.0, 9.0))
    assert re.search(r"r2 at \([67]\.., [89]\..\) m is not within 3 m of any pad", why)
    why = problem(2, (8.3, 2.0))
    assert re.search(r"r2 at \([78]\.., [12]\..\) m is ambiguous: pad 2 is [12]\.. m", why)
    assert "r1 and r2 stand at one pad, 0" in problem(2, (1.5, 2.0))
    field.stand_at_pads()
    assert "r0 stands at pad 0 of r1: assign both at once" in field.refused(
        "mission", "assign", "--seconds", "0.5", "--robots", "r0"
    )
    field.do("mission", "assign", "--seconds", "0.5")
    assert slots() == [0, 1, 2]


def test_site_is_saved_and_used_again(field: Commanded) -> None:
    park = ("site", "save", "park", "--land-at-pads", "--seconds", "0.5", "--json")
    field.stand({0: (6.0, 8.0), 1: (8.0, 8.0), 2: (14.0, 8.0)})
    why = field.refused(*park)
    assert re.search(r"is [12]\.\d+ m from pad_m of height 1, must be 2\.5 m", why)
    field.stand({i: (6.0 + 4.0 * i, 8.0) for i in range(3)})
    field.do("mission", "fence", "set", "0,0", "30,0", "30,30", "0,30")
    done = field.do(*park)
    slots = json.loads(done.stdout)["slots"]
    saved_m = [slot["pad_m"] for slot in slots]
    for pad_m, place_m in zip(saved_m, [(6.0, 8.0), (10.0, 8.0), (14.0, 8.0)], strict=True):
        assert math.dist(pad_m, place_m) < NOISE_M
    assert "park.toml: exists already: add --force" in field.refused("site", "save", "park")

    # Another site, from the robots: r0 is its origin, and r1 stands along its y axis.
    save = ("site", "save", "yard", "--from", "r0", "--toward", "r1", "--seconds", "0.5")
    why = field.refused(*save)
    assert re.search(r"r0 stands at \(-?0\.., -?0\..\) m, outside the fence: another --from", why)
    field.do("mission", "fence", "on")
    field.do(*save)
    yard = tomllib.loads((field.folder / "sites" / "yard.toml").read_text())
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
    (field.folder / "sites" / "torn.toml").write_text("[origin")
    done = field.do("site", "list")
    assert re.search(r"torn +unreadable *\n", done.stdout)
    assert "torn.toml: is not TOML" in done.stderr
    assert re.search(r"park .* used last *\n", done.stdout)
    assert re.search(r"yard .* 3 +\n", done.stdout)
    assert "pads of site park" in field.do("mission", "assign", "--seconds", "0.5").stderr
    assert "yard has another origin than the fleet" in field.refused(
        "mission", "assign", "--site", "yard"
    )
    # The site used last counts only while the fleet has its origin.
    field.stand_at_pads()
    field.do("mission", "fence", "on")
    field.do("mission", "origin", *AT[:2], "30.5")
    assert "pads of fleet.toml" in field.do("mission", "assign", "--seconds", "0.5").stderr

    field.do("mission", "enable")
    field.do("mission", "takeoff", "--robots", "r0")
    assert "r0 is armed" in field.refused("site", "use", "yard")


def test_rehearsal_shows_the_command_from_the_nose(field: Commanded) -> None:
    field.field.run(3.0)
    done = field.do("mission", "rehearse", "--robots", "r1", "--seconds", "0.5")
    assert re.search(
        r"r1: x [56]\.. m, y [12]\.. m, nose (0|360) deg, inside the fence by [34]\.. m, "
        r"commanded: \S \d\.\d m/s, [a-z-]+ \d+ deg( left| right)?\n",
        done.stdout,
    )
    done = field.do("mission", "rehearse", "--robots", "r1", "--seconds", "0.5", "--json")
    seen = json.loads(done.stdout.splitlines()[0])
    assert math.dist(seen["position_m"], PADS_M[1]) < NOISE_M
    assert seen["commanded"]["arrow"] in "↑↗→↘↓↙←↖"


# Scripts


def write_script(folder: Path, duration_s: float, **changes: str) -> Path:
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
    path = folder / "script.toml"
    path.write_text(text)
    return path


@pytest.mark.slow
def test_example_script_is_flown(field: Commanded) -> None:
    assert "asks before the next trial takes off" in field.refused(
        "mission", "run", write_script(field.folder, 3.0)
    )
    field.do("mission", "again", "paper-4")
    script = write_script(field.folder, 3.0)
    done = field.do("mission", "run", script, "--yes", "--json")
    assert "left the mission" not in done.stderr
    lines = [re.sub(r"^ *[\d.]+ s  ", "", line) for line in done.stderr.splitlines()]
    in_trial = ["reset maps", "preflight, 60 s", "takeoff", "start", "mission, 3 s",
                "r2 is handed to a pilot", "r2 is back in the mission", "return"]  # fmt: skip
    steps = [line.partition(": ")[2] if line.startswith("trial") else line for line in lines]
    assert [step for step in steps if step in in_trial] == [*in_trial, *in_trial]
    assert steps[0] == "origin"
    *ended, outcome = map(json.loads, done.stdout.splitlines())
    assert ended[-1]["step"] == "trial 2 of 2: return" and ended[-1]["duration_s"] > 0.0
    assert outcome == {"script": str(script), "done": True, "problem": None}
    assert lines[-1].endswith("script.toml: done")
    assert field.states() == [_S.LANDED] * 3
    assert {robot.said.trial for robot in field.robots} == {"paper-6"}


def test_interrupted_script_holds_the_fleet(field: Commanded) -> None:
    def interrupt() -> None:
        raise KeyboardInterrupt

    script = write_script(field.folder, 600.0, **{"at_s = 1.5": "at_s = 599.5"})
    field.once(lambda: field.states() == [_S.MISSION, _S.MISSION, _S.PILOT], interrupt)
    done = called("mission", "run", script, "--yes")
    assert done.returncode == 130
    assert field.states()[:2] == [_S.HOLD, _S.HOLD]
    assert "interrupted; " in done.stderr
    assert "next `lpac mission land`, `lpac mission return` or `lpac mission resume`" in done.stderr


def test_script_starts_again_who_holds_by_itself_and_gives_way_to_people(field: Commanded) -> None:
    script = write_script(
        field.folder, 600.0, **{"at_s = 0.5": "at_s = 599.0", "at_s = 1.5": "at_s = 599.5"}
    )
    robot = field.robots[0]

    def hang() -> None:
        robot.program.loops["control"].hang(0.9)
        field.once(lambda: robot.state is _S.HOLD, is_held)

    def is_held() -> None:
        field.once(lambda: robot.state is _S.MISSION, hold)

    def hold() -> None:
        field.ground.node.begin(SafetyCommand("hold"))

    field.once(lambda: field.states() == [_S.MISSION] * 3, hang)
    done = called("mission", "run", script, "--yes")
    assert done.returncode == 1
    assert re.search(r"r0 left the mission: hold: control was silent for \d\.\d s", done.stderr)
    assert "mission (steps[2]): alice commands hold: the script ends" in done.stderr
    field.field.until(lambda: field.states() == [_S.HOLD] * 3)


def test_script_ends_with_the_step_that_fails_and_holds_the_fleet(field: Commanded) -> None:
    robot = field.robots[2]

    def once_it_lands(order: Order) -> bool:
        """Its battery is critical just before."""
        if order.kind == "pilot":
            robot.vehicle.battery_remaining = 0.1
        return order.kind != "pilot" or robot.state is _S.LAND

    field.hears(robot, once_it_lands)
    why = field.refused("mission", "run", write_script(field.folder, 600.0), "--yes")
    assert "trial 1 of 2: mission (steps[2]): r2: pilot is not accepted in land" in why
    assert "hold is commanded, but r2: land: battery critical" in why
    assert "next `lpac mission land`" in why
    assert field.states()[:2] == [_S.HOLD, _S.HOLD]

    bad = write_script(field.folder, 2.0, **{'robot = "r2"': 'robot = "r8"'})
    assert "script.toml: robot 'r8' is unknown; known are r0" in field.refused(
        "mission", "run", bad, "--yes"
    )


def test_hold_is_the_operators_also_while_the_script_starts_a_robot(field: Commanded) -> None:
    kinds: list[str] = []

    def heard(order: Order) -> bool:
        """Its policy falls silent once it is taken back, so that it does not start again."""
        kinds.append(order.kind)
        if order.kind == "rejoin":
            field.robots[2].program.loops["policy"].hang(60.0)
        return True

    def starts() -> bool:
        return "rejoin" in kinds and kinds[-1] == "start"

    field.hears(field.robots[2], heard)
    field.once(starts, lambda: field.ground.node.begin(SafetyCommand("hold")))
    done = called("mission", "run", write_script(field.folder, 600.0), "--yes")
    assert done.returncode == 1
    assert "mission (steps[2]): alice commands hold: the script ends" in done.stderr
    assert "told to hold" not in done.stderr


def test_script_says_what_is_missing(field: Commanded) -> None:
    field.do("mission", "enable")
    field.field.until(lambda: all(robot.said.ready for robot in field.robots))
    field.do("mission", "hold", "r1")
    script = write_script(field.folder, 2.0, **{"# at_most_s = 60": "at_most_s = 1"})
    why = field.refused("mission", "run", script, "--yes")
    assert "trial 1 of 2: preflight (steps[0]): not ready after 1 s: r1 is commanded to hold" in why
    assert "no robot is in the air" in why
