"""Variants of an ablation; an invalid one gives one line with key and value."""

import tomllib
from pathlib import Path

import pytest

from edge.core.schema import ConfigError
from lpac.ablate.config import read_ablation
from lpac.sim.ticks import Clocks
from tests.conftest import ROOT
from tests.training import SMALL

ABLATION = """
base = "small.toml"
seeds = [0, 4]
worlds = 6
set_up = "n3"
duration_s = 1.0
train.data.disturbances.loss = [0.1, 0.6]
fly.loss = 0.1

[[variants]]
name = "no-features"
why = "Nobody heeds what neighbours say."
train.network.hops = 0

[[variants]]
name = "slow"
why = "Perception and policy are slow."
fly.clocks = {perception_s = 0.4, policy_s = 0.8}
"""


def written(folder: Path, *changes: tuple[str, str], base: str = SMALL) -> Path:
    """The file with changed text, beside the base's."""
    text = ABLATION
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    (folder / "small.toml").write_text(base)
    path = folder / "parts.toml"
    path.write_text(text)
    return path


def test_what_it_means(tmp_path: Path) -> None:
    ablation = read_ablation(written(tmp_path))
    base, features, slow = ablation.variants
    assert [training.name for training in ablation.trainings] == [
        "base-0", "base-4", "no-features-0", "no-features-4",
    ]  # fmt: skip
    assert slow.trainings == base.trainings and not slow.trained
    for variant, hops in ((base, 1), (features, 0)):
        for training in variant.trainings:
            config = training.read.config
            assert config.network["hops"] == hops and config.network["width"] == 4
            assert config.export.name == training.name and config.seed == training.seed
            assert config.data.disturbances.loss == (0.1, 0.6)
            # Other keys of a changed table stay.
            assert config.data.disturbances.lag_s == (0.0, 0.5)
            assert tomllib.loads(training.read.text)["data"]["worlds"][0]["robots"] == [2, 3]
    assert base.condition.scenario.loss == slow.condition.scenario.loss == 0.1
    assert slow.condition.scenario.clocks == Clocks(perception_s=0.4, policy_s=0.8)
    # After the two worlds that select weights.
    assert ablation.worlds == range(2, 8)
    opened = read_ablation(written(tmp_path, ("worlds = 6", 'worlds = 6\nworld_set = "test"')))
    assert opened.worlds == range(6)


def test_whatever_a_configuration_says_is_what_the_training_is_told(tmp_path: Path) -> None:
    base = SMALL.replace(
        "[network]\n", '[network]\n"an odd \\"key\\"" = [{on = true, size = -1.5e-7}, "\\u00e9"]\n'
    )
    with pytest.raises(ConfigError, match=r"base: network: unknown key 'an odd \"key\"'"):
        read_ablation(written(tmp_path, base=base))


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ('"small.toml"', '"none.toml"', r"none\.toml: cannot be read: there is no such"),
        ("seeds = [0, 4]", "seed = 0", r"parts\.toml: unknown key 'seed'; known are base, "),
        ("[0, 4]", "[]", r"seeds = \[\]: must be one or more, at least 0, each once"),
        ("[0, 4]", "[1, 1]", r"seeds = \[1, 1\]: must be one or more, at least 0, each once"),
        ("worlds = 6", "worlds = 0", "worlds = 0: must be at least 1"),
        ("worlds = 6", 'world_set = "training"', "'training': allowed are 'validation', 'test'"),
        ('"n3"', '"n4"', "set_up = 'n4': allowed are field, n1, n3, "),
        ("duration_s = 1.0", "duration_s = 0.5", "duration_s = 0.5: must be from 1 to 3600"),
        ("fly.loss = 0.1", "fly.loss = 2.0", "base: fly: loss = 2.0: must be from 0 to 1"),
        ("fly.loss = 0.1", "fly.delay = 2.0", "base: fly: unknown key 'delay'; known are "),
        ('"slow"', '"no-features"', "name = 'no-features': is used twice"),
        ('"slow"', '"base"', r"variants\[1\]: name = 'base': is reserved for the base"),
        ('"slow"', '"clairvoyant-cvt"', r"name = 'clairvoyant-cvt': is reserved for the base"),
        ('"slow"', '"a/b"', r"variants\[1\]: name = 'a/b': must be letters, digits"),
        ('"Perception and policy are slow."', '" "', r"variants\[1\]: why = ' ': must be a sent"),
        ("fly.clocks = ", "# ", r"variants\[1\]: train and fly are empty"),
        ("fly.clocks = {", "fly.clocks = {jitter = 1, ", "slow: fly: clocks: jitter = 1: must"),
        ("train.network.hops", "train.seed", "no-features: train.seed: must not be set: it foll"),
        ("train.data", "train.export", r"parts\.toml: train.export: must not be set"),
        ("train.network.hops = 0", "train.network.hops = -1", "no-features: network: hops = -1: "),
        ("train.network.hops", "train.hops", "no-features: unknown key 'hops'; known are perc"),
        (
            "train.network.hops = 0", "train.data.flights = 3",
            "no-features: train.data.flights = 3: must be the base's, 2, for equal compute",
        ),
        (
            "train.network.hops = 0", "train.dagger.rounds = 0",
            "dagger.rounds = 0: must be .*; dagger.expert_flights = 1 switches DAgger off",
        ),
        ("train.network.hops = 0", "train.fit.epochs = 3", "train.fit.epochs = 3: must be the"),
        ("train.network.hops = 0", "train.data.states = 4", "train.data.states = 4: must be"),
        ("[[variants]]", "[[variants", r"parts\.toml: is not TOML"),
    ],
)  # fmt: skip
def test_what_cannot_be(tmp_path: Path, old: str, new: str, text: str) -> None:
    path = written(tmp_path, (old, new))
    with pytest.raises(ConfigError, match=text) as raised:
        read_ablation(path)
    assert "\n" not in str(raised.value)


def test_the_example_leaves_out_each_part() -> None:
    ablation = read_ablation(ROOT / "examples" / "ablation.toml")
    assert [variant.name for variant in ablation.variants if variant.trained] == [
        "base", "no-messages", "no-features", "one-hop", "two-hops", "one-layer",
        "no-explored-map", "no-own-cell", "no-shared-map", "no-overshoot", "no-dagger",
        "no-loss-and-delay",
    ]  # fmt: skip
    assert [variant.name for variant in ablation.variants if not variant.trained] == [
        "float32", "half-rates", "double-rates",
    ]  # fmt: skip
    assert len(ablation.trainings) == 36 and len(ablation.worlds) == 40
