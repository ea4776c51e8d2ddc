"""Studies in TOML files, and one-line errors."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.schema import ConfigError
from lpac.shipped import SHIPPED_BUNDLE
from lpac.sim.ticks import Clocks
from lpac.study.file import read_study
from lpac.study.study import Study
from lpac.study.worlds import FIELD
from tests.conftest import ROOT

STUDY = """
title = "Loss in wind"
worlds = 3
baselines = ["decentralized-cvt-prior"]
figures = ["curves"]

[policies]
field = []

[scenario]
world_size = 640
duration_s = 20.0

[[conditions]]
loss = [0.0, 0.3]
clocks.policy_s = [0.4, 0.8]

[[conditions]]
engine = "simulated"
wind_m_s = 5.0
"""


def written(folder: Path, *changes: tuple[str, str]) -> Path:
    text = STUDY
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    path = folder / "wind.toml"
    path.write_text(text)
    return path


def read(folder: Path, *changes: tuple[str, str]) -> Study:
    return read_study(written(folder, *changes))


def test_what_it_means(tmp_path: Path) -> None:
    study = read(tmp_path)
    field, prior, clairvoyant = study.all_methods
    assert [method.name for method in study.methods] == ["field", "decentralized-cvt-prior"]
    assert field.trainings[0].path == str(SHIPPED_BUNDLE.resolve()) and not prior.trained
    assert clairvoyant.name == "clairvoyant-cvt"
    *lossy, windy = study.conditions
    assert [(c.scenario.loss, c.scenario.clocks.policy_s) for c in lossy] == [
        (0.0, 0.4), (0.0, 0.8), (0.3, 0.4), (0.3, 0.8),
    ]  # fmt: skip
    assert lossy[3].name == "loss 0.3, clocks policy_s 0.8"
    assert (windy.engine, windy.scenario.wind_m_s, windy.scenario.clocks) == (
        "simulated", 5.0, Clocks(),
    )  # fmt: skip
    for condition in study.conditions:
        assert condition.scenario.world_size == 640 and condition.scenario.duration_s == 20.0
        # All else equals the field's.
        assert condition.scenario.random_feature_count == FIELD.features
    assert (study.title, study.worlds, study.figures) == ("Loss in wind", 3, ("curves",))


def test_a_world_of_ones_own_and_paths_count_from_the_files_folder(tmp_path: Path) -> None:
    (tmp_path / "one.env").write_text("CircularBND 100 100 50 1\n")
    path = str(SHIPPED_BUNDLE.resolve())
    study = read(
        tmp_path,
        ("field = []", f'field = ["{path}", "{path}"]'),
        ("world_size = 640", 'world = "one.env"'),
    )
    assert len(study.methods[0].trainings) == 2
    flights = [f for f in study.flights() if f.scenario.controller == "lpac"]
    assert len({flight.scenario.features for flight in flights}) == 1
    assert len({flight.scenario.seed for flight in flights}) == 3


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("[0.0, 0.3]", "[0.0, 3.0]", "conditions[0]: loss = 3.0: must be from 0 to 1"),
        ("= 5.0", "= -5.0", "conditions[1]: wind_m_s = -5.0: must be from 0 to 30"),
        ('"simulated"', '"gazebo"', "conditions[1]: engine = 'gazebo': allowed are 'point', "),
        ("world_size", "world_sise", "scenario: unknown key 'world_sise'; known are title, engine"),
        ("= 640", "= 0", "scenario: world_size = 0: must be at least 1"),
        ("= 640", '= "640"', "scenario: world_size = '640': must be a whole number"),
        ("world_size = 640", "seed = 1", "scenario: unknown key 'seed'; known are "),
        ("world_size = 640", 'set_up = "n4"', "scenario: set_up = 'n4': allowed are field, n1, "),
        ("decentralized-cvt-prior", "cvt", "baselines[0] = 'cvt': allowed are "),
        ("field = []", 'field = ["gone"]', "policies: "),
        ("worlds = 3", "worlds = 0", "worlds = 0: must be from 1 to 10000"),
        ("worlds = 3", "world = 3", "unknown key 'world'; known are title, text, policies"),
        ('"curves"', '"curve"', "figures[0] = 'curve': allowed are 'curves', "),
        ("wind_m_s", "lag_s", "conditions[1]: lag_s = 5.0: must be 0.0 for whole robots"),
        ("clocks.policy_s", "clocks.jitter", "conditions[0]: clocks: jitter = 0.8: must be "),
        ("wind_m_s = 5.0", 'lost = "2"', "conditions[1]: lost = '2': must be ROBOTS@SECONDS"),
        ("wind_m_s = 5.0", "robots = 31", "conditions[1]: robots = 31: must be from 1 to 30"),
        ("[[conditions]]", "[[conditions", "wind.toml: "),
        ("[0.0, 0.3]", "[]", "conditions[0]: loss = []: must have at least one"),
        ("[0.0, 0.3]", "[[0.0, 0.3]]", "conditions[0]: loss = [0.0, 0.3]: "),
        ("[0.0, 0.3]", "0.3\nmethods = []", "conditions[0]: methods = []: must be at least 1 long"),
        ("[0.0, 0.3]", '0.3\nmethods = ["g"]', "conditions[0]: methods = 'g': must be one of "),
        ("field = []", "clairvoyant-cvt = []", "policies: name = 'clairvoyant-cvt': is a base"),
        ("field = []", '"" = []', "policies: name = '': must be 1 to 200 letters on one line"),
        ("field = []", '"a\\nb|c" = []', "policies: name = 'a\\nb|c': must be "),
        ("field = []", f"{'a' * 300} = []", "policies: name = 'aaa"),
        ("wind_m_s = 5.0", 'title = "loss 0.3, clocks policy_s 0.8"', "[1]: title = 'loss 0.3, "),
        ("wind_m_s = 5.0", 'title = "../mine"', "conditions[1]: title = '../mine': must be "),
        ("wind_m_s = 5.0", 'lost = "2@9"', "conditions[1]: lost = 2@9: must not be given for whol"),
        ("wind_m_s = 5.0", "from_pads = true", "conditions[1]: from_pads = True: must be False "),
        ("wind_m_s = 5.0", 'fault = "landed"', "conditions[1]: fault = landed: must not be given"),
        ("wind_m_s = 5.0", 'sensor = "eyes"', "conditions[1]: sensor"),
        ("wind_m_s = 5.0", "robots = 2\nworld_size = 64", "conditions[1]: robots = 2: 1 fit on 4"),
        ("wind_m_s = 5.0", 'world = "nix.env"', "conditions[1]: world = 'nix.env': "),
        ('"simulated"', '"px4"', "conditions[1]: engine = 'px4': needs PX4's build folder"),
        ("[0.0, 0.3]", '0.3\nlost = "2@20"', "conditions[0]: lost = 2@20: must be in flight"),
        ("= 640", "= 7", "scenario: world_size = 7: must be from 64 to 8192"),
        ("= 640", "= 70000000", "scenario: world_size = 70000000: must be from 64 to 8192"),
        ("= 640", "= 640\nrobots = 1\nstarts_m = [[41, 0]]", "starts_m: [41.0, 0.0]: must be with"),
        ("= 640", "= 640\nrandom_feature_count = 0", "scenario: random_feature_count = 0: must be"),
        ('"curves"', '"repeatability"', "figures = 'repeatability': needs trials of at least 2"),
        ('"curves"', '"perturbation"', "figures = 'perturbation': needs a policy, and failures"),
        ("worlds = 3", "worlds = 100000000", "worlds = 100000000: must be from 1 to 10000"),
    ],
)
def test_a_mistake_is_one_line(tmp_path: Path, old: str, new: str, text: str) -> None:
    with pytest.raises(ConfigError) as raised:
        read(tmp_path, (old, new))
    said = str(raised.value)
    assert text in said and "\n" not in said and said.startswith(f"{tmp_path / 'wind.toml'}: ")


def test_what_a_title_stands_for_and_a_list_of_all_make_names(tmp_path: Path) -> None:
    study = read(
        tmp_path,
        ("[scenario]", "[scenario]\ndelay_s = [0.0, 0.1]"),
        ("clocks.policy_s = [0.4, 0.8]", 'title = "lossy"'),
        ("wind_m_s = 5.0", "wind_m_s = 5.0\ndelay_s = 0.0"),
    )
    assert [condition.name for condition in study.conditions] == [
        "lossy, delay_s 0, loss 0", "lossy, delay_s 0, loss 0.3",
        "lossy, delay_s 0.1, loss 0", "lossy, delay_s 0.1, loss 0.3",
        "delay_s 0, engine simulated, wind_m_s 5",
    ]  # fmt: skip


@given(st.floats().filter(lambda loss: not 0.0 <= loss <= 1.0))
def test_no_value_out_of_bounds_is_taken(
    tmp_path_factory: pytest.TempPathFactory, loss: float
) -> None:
    with pytest.raises(ConfigError, match="loss = "):
        read(tmp_path_factory.mktemp("study"), ("[0.0, 0.3]", f"[{loss!r}]"))


def test_the_example_and_the_papers_studies_are_whole() -> None:
    example = read_study(ROOT / "examples" / "study.toml")
    assert {condition.engine for condition in example.conditions} == {"point", "simulated"}
    paths = sorted((ROOT / "lpac" / "paper" / "studies").glob("*.toml"))
    assert len(paths) == 7
    for path in paths:
        assert read_study(path).title
