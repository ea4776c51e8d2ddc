"""A training that takes seconds: three robots, a tiny network, one DAgger round."""

import tomllib
from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path
from typing import Any

from lpac.sim.cores import Outcome, Task
from lpac.train.config import ReadConfig, read_config

SMALL = """
seed = 3

[perception]
world_size = 280
local_map_size = 64
sensor_size = 32
communication_range = 128

[training]
max_speed = 5.0
time_step = 0.4

[data]
flights = 2
states = 3
duration_s = 2.0

[[data.worlds]]
robots = [2, 3]
world_size = [128, 160]
communication_range = [64.0, 128.0]
features = [2, 3]
sigma = [20.0, 30.0]

[data.disturbances]
loss = [0.0, 0.5]
lag_s = [0.0, 0.5]
position_bias = [0.0, 4.0]
lost_robots = [0, 1]
come_back = 0.5

[network]
image_size = 8
cnn_channels = [2]
features = 2
layers = 1
hops = 1
width = 4
mlp_width = 4

[fit]
epochs = 2
batch_robots = 6
lost_messages = 0.2

[dagger]
rounds = 1
flights = 2
duration_s = 2.0
epochs = 1
expert_flights = 0.5

[select]
worlds = 2
set_ups = ["n3"]
duration_s = 1.0
mission_s = 2.0
every_epochs = 1

[export]
name = "small"
"""


def read(folder: Path, *changes: tuple[str, str]) -> ReadConfig:
    """The small configuration with changed text, from a file in the folder."""
    text = SMALL
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    tomllib.loads(text)
    path = folder / "small.toml"
    path.write_text(text)
    return read_config(path)


def here(do: Callable[[Task], Outcome], tasks: Sequence[Task]) -> Generator[Outcome, None, None]:
    """A pool of this process only, which runs the last task first."""
    for task in reversed(tasks):
        yield do(task)


def said(told: Mapping[str, Any]) -> dict[str, Any]:
    """Results of a training without durations and paths."""
    return {
        key: value
        for key, value in told.items()
        if key not in ("hours", "folder", "bundle", "checkpoint")
    }
