"""The file of a script: what it says, and every mistake as one line."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from edge.messages.mission import FlightState, Origin, RobotStatus
from lpac.analysis.snapshot import FRESH_S, RobotSnapshot
from lpac.ground.procedure import Procedure, Until, collect_statuses
from lpac.ground.script import (
    LandStep,
    MissionStep,
    OriginStep,
    Perturbation,
    PreflightStep,
    ReturnStep,
    ScriptError,
    ScriptRun,
    TakeoffStep,
    WorldStep,
    load_script,
    take_site,
)
from lpac.ground.site import SavedSite, Sites, SiteSlot
from lpac.ground.station.protocol import (
    CommandReport,
    NextTrial,
    Request,
    ResultCode,
    RobotCommand,
    RobotResult,
    SafetyCommand,
    SetFence,
    SetOrigin,
    SetPlaces,
    SetWorld,
    Start,
)
from lpac.ground.station.station import is_down
from tests.conftest import ROOT
from tests.unit.ground.snapshots import FENCE, ORIGIN, on_ground, setup, snapshot, status

EXAMPLE = ROOT / "docs" / "script.toml"


@pytest.fixture
def script(tmp_path: Path) -> Path:
    """The example, beside a world."""
    (tmp_path / "world.env").write_text("CircularBND 100 100 20 5\n")
    return Path(shutil.copy(EXAMPLE, tmp_path))


def change(path: Path, before: str, after: str) -> None:
    text = path.read_text()
    assert before in text
    path.write_text(text.replace(before, after, 1))


def test_example_is_the_papers_experiment(script: Path) -> None:
    loaded = load_script(script, Sites(script))
    assert (loaded.trial, loaded.trials, loaded.robots) == ("paper", 3, ())
    origin, world = loaded.before
    assert isinstance(origin, OriginStep)
    assert origin.given() == Origin(47.397742, 8.545594, 30.0)
    assert world == WorldStep("world.env")
    perturb = (Perturbation(40.0, "r2", "pilot"), Perturbation(80.0, "r2", "rejoin"))
    mission = MissionStep(120.0, True, perturb)
    assert loaded.steps == (PreflightStep(), TakeoffStep(), mission, ReturnStep())


def test_examples_comments_show_the_defaults(script: Path) -> None:
    shown = load_script(script, Sites(script))
    text = script.read_text()
    for key in ("robots = []", "at_most_s", "interval_s", "abort_on_failure"):
        text = text.replace(f"# {key}", key)
    script.write_text(text)
    assert load_script(script, Sites(script)) == shown


@pytest.mark.parametrize(
    ("before", "after", "problem"),
    [
        ("trials = 3", "trials = 0", "trials = 0: must be from 1 to 1000"),
        ("trials = 3", "trails = 3", "unknown key 'trails'; known are trial, trials, robots"),
        ('trial = "paper"', 'trial = "a b"', "trial = 'a b': must be at most 24 letters"),
        ('do = "takeoff"', 'do = "go"', r"steps\[1\]: do = 'go': allowed are 'preflight', 'take"),
        ('do = "takeoff"', 'do = "world"', r"steps\[1\]: do = 'world': allowed are 'preflight'"),
        ('do = "takeoff"', "interval_s = 1", r"steps\[1\]: do = '': allowed are"),
        ("# interval_s = 2.0", "interval_s = -1", r"steps\[1\] \(takeoff\): interval_s = -1: must"),
        ("# interval_s", "intervall_s", r"steps\[1\] \(takeoff\): unknown key 'intervall_s'"),
        ("duration_s = 120.0", "", r"steps\[2\] \(mission\): duration_s is missing"),
        ("duration_s = 120.0", 'duration_s = ""', r"\(mission\): duration_s = '': must be a num"),
        ("at_s = 80.0", "at_s = 121.0", "perturb: at_s = 121.0: must be below duration_s = 120.0"),
        ('do = "rejoin"', 'do = "kill"', r"perturb\[1\]: do = 'kill': allowed are 'pilot', "),
        ("heading_deg = 30.0", "heading_deg = 360.0", r"before\[0\] \(origin\): heading_deg = "),
        ("heading_deg = 30.0", 'heading_deg = 30.0\ntoward_robot = "r2"',
         r"before\[0\] \(origin\): latitude_deg, longitude_deg and heading_deg must be given, or"),
        ("heading_deg = 30.0", "", r"before\[0\] \(origin\): latitude_deg, longitude_deg and"),
        ("# from_robot", "from_robot", r"before\[0\] \(origin\): from_robot: measures the origin"),
        ('file = "world.env"', 'file = "w.env"', r"w.env: cannot be read: there is no such file"),
        ('[[steps]]\ndo = "takeoff"', "[steps]", "is not TOML"),
        ('at_s = 40.0\nrobot = "r2"', 'at_s = 90.0\nrobot = "r2"',
         r"perturb: at_s = 80.0: r2 has no pilot: must be handed"),
        ('do = "rejoin"', 'do = "pilot"', r"perturb: at_s = 80.0: r2 has a pilot already"),
        ('do = "return"', 'do = "preflight"', r"steps\[3\] \(preflight\): robots are in the air"),
        ('[[steps]]\ndo = "return"', "", r"steps: the last step is 'mission': must be 'return' or"),
        ('do = "takeoff"', 'do = "preflight"', r"steps\[2\] \(mission\): robots are on the ground"),
        ('do = "mission"', 'do = "return"\n[[steps]]\ndo = "mission"',
         r"steps\[3\] \(mission\): robots are on the ground: must come after takeoff"),
        ('do = "return"', 'do = "mission"\nduration_s = 5\n[[steps]]\ndo = "return"',
         r"steps\[3\] \(mission\): return or land must come between two missions"),
    ],
)  # fmt: skip
def test_mistake_is_one_line(script: Path, before: str, after: str, problem: str) -> None:
    change(script, before, after)
    with pytest.raises(ValueError, match=problem) as raised:
        load_script(script, Sites(script))
    assert str(script.parent) in str(raised.value)
    assert "\n" not in str(raised.value)


def test_worlds_sites_and_steps_must_be_there(script: Path) -> None:
    (script.parent / "world.env").write_text("CircularBND 100 100 20\n")
    with pytest.raises(ValueError, match=r"world.env: record 1 \(CircularBND\): scale is missing"):
        load_script(script, Sites(script))
    (script.parent / "world.env").write_text("CircularBND 100 100 20 5\n")
    for line in ("[[before]]", 'do = "site"', 'name = "park"'):
        change(script, f"# {line}", line)
    with pytest.raises(ValueError, match=r"park.toml: no such site; known are none"):
        load_script(script, Sites(script))
    script.write_text("trials = 2\n")
    with pytest.raises(ValueError, match=r"steps = \[\]: must be one or more \[\[steps\]\] tables"):
        load_script(script, Sites(script))
    with pytest.raises(ValueError, match=r"none.toml: cannot be read: there is no such file"):
        load_script(script.with_name("none.toml"), Sites(script))


class Told:
    """A ground as a procedure sees it; r0 stands, r1 flies, and r2 was never heard."""

    def __init__(self) -> None:
        self.setup = setup(3)
        self.now_s, self.unix_now_s = 100.0, 1e9
        self.tell(on_ground(0), status(1), None)

    def tell(self, *said: RobotStatus | None, age_s: float = 0.1) -> None:
        ages_s = [None if each is None else age_s for each in said]
        robots = (RobotSnapshot(f"r{i}", i, each, ages_s[i]) for i, each in enumerate(said))
        self.snapshot = snapshot(*robots)


class Heard:
    """Listener that keeps what a script reports."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def step(self, name: str, at_most_s: float | None) -> None: ...

    def line(self, text: str) -> None:
        self.lines.append(text)

    def confirm(self, question: str) -> bool:
        return True


def result_of(procedure: Procedure[Any], answer: object) -> Any:
    with pytest.raises(StopIteration) as done:
        procedure.send(answer)
    return done.value.value


@pytest.fixture
def run(script: Path) -> tuple[Told, Heard, ScriptRun]:
    ground, heard = Told(), Heard()
    loaded = replace(load_script(script, Sites(script)), steps=())
    return ground, heard, ScriptRun(loaded, Sites(script), ground, heard)


@pytest.mark.parametrize(
    ("state", "armed", "down"),
    [
        (FlightState.IDLE, False, True), (FlightState.LANDED, None, True),
        (FlightState.PREFLIGHT, True, False), (FlightState.LANDED, True, False),
        (FlightState.FAULT, False, True), (FlightState.FAULT, None, False),
        (FlightState.HOLD, False, False),
    ],
)  # fmt: skip
def test_who_is_down(state: FlightState, armed: bool | None, down: bool) -> None:
    assert is_down(status(0, state=state, armed=armed)) is down


def test_who_flies_is_held_whoever_stands(run: tuple[Told, Heard, ScriptRun]) -> None:
    ground, _, script = run
    holding = script.hold()
    assert next(holding) == SafetyCommand("hold")
    assert result_of(holding, CommandReport()).startswith("hold is commanded: next")
    ground.tell(on_ground(0), on_ground(1), None)
    assert result_of(script.hold(), None) == "no robot is in the air"


def test_who_left_the_mission_is_started_again_if_it_holds_and_there_is_time(
    run: tuple[Told, Heard, ScriptRun],
) -> None:
    ground, heard, script = run
    ground.tell(*(status(i) for i in range(3)))
    flying = script._fly_mission(MissionStep(60.0, restart=True))
    next(flying)

    def wanted(state: FlightState, after_s: float) -> list[Request | Until]:
        """Requests after r1 entered a state, up to the next wait."""
        ground.now_s += after_s
        ground.tell(status(0), status(1, state=state), status(2))
        asked = [flying.send(True)]
        while not isinstance(asked[-1], Until):
            asked.append(flying.send(CommandReport()))
        return asked[:-1]

    assert wanted(FlightState.MISSION, 0.0) == []
    assert wanted(FlightState.RETURN, 1.0) == []
    assert wanted(FlightState.HOLD, 1.0) == []
    assert wanted(FlightState.MISSION, 1.0) == []
    assert wanted(FlightState.HOLD, 1.0) == [Start(("r1",))]
    assert wanted(FlightState.HOLD, 2.0) == []
    assert wanted(FlightState.HOLD, 2.0) == [Start(("r1",))]
    assert wanted(FlightState.HOLD, 46.0) == [], "6 s are left"
    assert heard.lines == [f"r1 left the mission: {s}: mission started" for s in ("return", "hold")]


def test_nothing_of_a_trial_is_left_for_the_next(run: tuple[Told, Heard, ScriptRun]) -> None:
    _, heard, script = run
    flying = script.fly()
    assert isinstance(next(flying), SetOrigin)
    assert isinstance(flying.send(CommandReport()), SetWorld)
    script.piloted.add("r1")
    script._reported.add("r1")
    assert flying.send(CommandReport()) == NextTrial("paper-1")
    assert (script.piloted, script._reported) == (set(), set())

    script.piloted.add("r1")
    rejoining = script._perturb(Perturbation(1.0, "r1", "rejoin"))
    assert next(rejoining) == RobotCommand("rejoin", ("r1",))
    assert isinstance(rejoining.send(CommandReport()), Until)
    assert rejoining.send(True) == Start(("r1",))
    result_of(rejoining, CommandReport())
    assert script.piloted == set() and heard.lines[-1] == "r1 is back in the mission"

    landing = script._execute(LandStep())
    next(landing)
    with pytest.raises(ScriptError) as failed:
        landing.send(CommandReport((RobotResult("r1", ResultCode.NOT_HEARD, "not heard"),)))
    assert not failed.value.hold, "held, the others would not come down"


def test_what_a_site_needs_is_asked_again_after_the_rest() -> None:
    site = SavedSite(ORIGIN, FENCE, (SiteSlot(0, (2.0, 2.0), (2.0, 2.0)),))
    done = CommandReport((RobotResult("r0", ResultCode.DONE, "taken up"),))
    failed = CommandReport((RobotResult("r0", ResultCode.NOT_TAKEN_UP, "outside"),))
    taking = take_site(site, setup(1), ())
    asked = [next(taking)] + [taking.send(report) for report in (done, failed, done)]
    assert [type(each) for each in asked] == [SetOrigin, SetFence, SetPlaces, SetFence]
    assert result_of(taking, done).done


def test_statuses_are_gathered_from_now_on() -> None:
    ground = Told()
    gathering = collect_statuses(ground, ("r0", "r1"), 2.0)
    wanted = next(gathering)
    assert isinstance(wanted, Until) and wanted.at_most_s == 2.0 + FRESH_S

    def holds(passed_s: float, *said: RobotStatus | None, age_s: float = 0.1) -> bool:
        ground.now_s = 100.0 + passed_s
        ground.tell(*said, age_s=age_s)
        return wanted.condition(ground.snapshot)

    assert not holds(0.5, status(0, sequence=7), None, age_s=0.6), "said before"
    assert not holds(1.0, status(0, sequence=8), None, status(2))
    assert not holds(2.5, status(0, sequence=8), None), "r1 is awaited"
    assert holds(3.0, status(0, sequence=9), status(1))
    heard = {name: [s.sequence for s in told] for name, told in result_of(gathering, True).items()}
    assert heard == {"r0": [8, 9], "r1": [9]}
