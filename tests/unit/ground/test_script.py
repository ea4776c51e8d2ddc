"""The file of a script: what it says, and every mistake as one line."""

import shutil
from pathlib import Path

import pytest

from edge.messages.mission import Origin
from lpac.ground.script import (
    MissionStep,
    OriginStep,
    Perturbation,
    PreflightStep,
    ReturnStep,
    TakeoffStep,
    WorldStep,
    load_script,
)
from lpac.ground.site import Sites
from tests.conftest import ROOT

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
        ('trial = "paper"', 'trial = "a b"', "trial = 'a b': must be 1 to 24 letters"),
        ('do = "takeoff"', 'do = "go"', r"steps\[1\]: do = 'go': allowed are 'preflight', 'take"),
        ('do = "takeoff"', 'do = "world"', r"steps\[1\]: do = 'world': allowed are 'preflight'"),
        ('do = "takeoff"', "interval_s = 1", r"steps\[1\]: do = '': allowed are"),
        ("# interval_s = 2.0", "interval_s = -1", r"steps\[1\] \(takeoff\): interval_s = -1.0"),
        ("# interval_s", "intervall_s", r"steps\[1\] \(takeoff\): unknown key 'intervall_s'"),
        ("duration_s = 120.0", "", r"steps\[2\] \(mission\): duration_s is missing"),
        ("duration_s = 120.0", 'duration_s = ""', r"\(mission\): duration_s = '': expected float"),
        ("at_s = 80.0", "at_s = 121.0", "perturb: at_s = 121.0: must be 0 or above"),
        ('do = "rejoin"', 'do = "kill"', r"perturb\[1\]: do = 'kill': allowed are 'pilot', "),
        ("heading_deg = 30.0", "heading_deg = 360.0", r"before\[0\] \(origin\): heading_deg = "),
        ("heading_deg = 30.0", "", r"before\[0\] \(origin\): latitude_deg, longitude_deg and"),
        ("# from_robot", "from_robot", r"before\[0\] \(origin\): from_robot: measures the origin"),
        ('file = "world.env"', 'file = "w.env"', r"w.env: cannot be read: there is no such file"),
        ('[[steps]]\ndo = "takeoff"', "[steps]", "no TOML"),
        ('at_s = 40.0\nrobot = "r2"', 'at_s = 90.0\nrobot = "r2"',
         r"perturb: at_s = 80.0: r2 has no pilot: must be given"),
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
    with pytest.raises(ValueError, match=r"park.toml: there is no such site; known are none"):
        load_script(script, Sites(script))
    script.write_text("trials = 2\n")
    with pytest.raises(ValueError, match="steps: none are given"):
        load_script(script, Sites(script))
    with pytest.raises(ValueError, match=r"none.toml: cannot be read: there is no such file"):
        load_script(script.with_name("none.toml"), Sites(script))
