"""An invalid configuration gives one line with key, value and what is allowed."""

from pathlib import Path

import pytest

from edge.core.schema import ConfigError
from lpac.train.config import config_digest, read_config
from tests.conftest import ROOT
from tests.training import SMALL, read


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("seed = 3", "seed = -1", "small.toml: seed = -1: must be at least 0"),
        ("seed = 3", "speed = 3", "small.toml: unknown key 'speed'; known are perception, "),
        ("flights = 2", "flights = 0", "data: flights = 0: must be at least 1"),
        ("flights = 2", "flights = 2.5", "data: flights = 2.5: must be a whole number"),
        ("flights = 2\n", "", "data: flights is missing"),
        ("states = 3", 'expert = "me"', "data: expert = 'me': allowed are 'clairvoyant-cvt', "),
        ("duration_s = 2.0", "duration_s = 0.5", "data: duration_s = 0.5: must be from 1 to 3600"),
        ("[2, 3]", "[3, 2]", r"worlds\[0\]: robots = \[3, 2\]: must be \[least, greatest\]"),
        ("[2, 3]", "[2]", r"worlds\[0\]: robots = \[2\]: must be \[least, greatest\]"),
        ("[128, 160]", "[32, 160]", r"world_size\[0\] = 32: must be from 64 to 8192"),
        ("[0.0, 0.5]", "[0.0, 1.5]", r"disturbances: loss\[1\] = 1.5: must be from 0 to 1"),
        (
            "[64.0, 128.0]",
            "[64.0, inf]",
            r"communication_range\[1\] = inf: must be at least 1 and finite",
        ),
        ("come_back = 0.5", "come_back = 2.0", "come_back = 2.0: must be from 0 to 1"),
        ("epochs = 2", "epochs = 0", "fit: epochs = 0: must be at least 1"),
        ("epochs = 2", "epochs = 2\nlearning_rate = 0.0", "learning_rate = 0.0: must be above 0"),
        (
            "epochs = 2",
            "epochs = 2\nbegin_with = 'no.pt'",
            r"fit.begin_with = '.*no.pt': there is no such",
        ),
        ("epochs = 2", "epochs = 2\nbegin_with = 'small.toml'", "begin_with: .* no torch file"),
        ("rounds = 1", "rounds = -1", "dagger: rounds = -1: must be at least 0"),
        ('"n3"', '"n4"', "select: set_ups = 'n4': allowed are field, n1, n3, "),
        ('["n3"]', "[]", "select: set_ups = \\[\\]: must be at least 1 long"),
        ('"small"', '"a/b"', "export: name = 'a/b': must be letters, digits"),
        ("image_size = 8", "depth = 8", "network: unknown key 'depth'; known are channels, "),
        ("sensor_size = 32", "sensor_size = 31", "perception: sensor_size = 31: must be positive"),
        ("max_speed = 5.0", "max_speed = 0.0", "training: max_speed = 0.0: must be above 0"),
        ("[fit]", "[fit", "small.toml: is not TOML"),
    ],
)
def test_what_cannot_be(tmp_path: Path, old: str, new: str, text: str) -> None:
    (tmp_path / "small.toml").write_text(SMALL.replace(old, new, 1))
    with pytest.raises(ConfigError, match=text) as raised:
        read_config(tmp_path / "small.toml")
    assert "\n" not in str(raised.value)


def test_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.toml: cannot be read: there is no such"):
        read_config(tmp_path / "none.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff")
    with pytest.raises(ConfigError, match=r"is not TOML: .*utf-8"):
        read_config(tmp_path / "binary.toml")


def test_only_the_number_of_rounds_may_change(tmp_path: Path) -> None:
    digest = read(tmp_path).digest
    assert digest == read(tmp_path, ("rounds = 1", "rounds = 4")).digest
    assert digest == config_digest("# of what follows\n" + SMALL)
    assert digest != read(tmp_path, ("states = 3", "states = 4")).digest


@pytest.mark.parametrize("name", ["field", "general", "quick"])
def test_the_examples_can_be_trained(name: str) -> None:
    path = ROOT / "examples" / f"{name}.toml"
    read = read_config(path)
    assert read.config.export.name == path.stem
    assert read.config.parameters.training.env_scale == read.config.data.scale.env_scale
