"""Imitation learns from the inputs, and reports why it cannot continue."""

from pathlib import Path

import numpy as np
import pytest

from lpac.train.config import DaggerConfig, FitConfig
from lpac.train.data import Dataset
from lpac.train.family import StateDict
from lpac.train.fit import Fit
from lpac.train.lpac import LpacNetwork

NETWORK = LpacNetwork(
    image_size=8, cnn_channels=(4,), features=4, layers=1, hops=1, width=16, mlp_width=16
)


def states(count: int, robots: int = 3) -> Dataset:
    """States in which the expert goes to the world's centre: the position tells its action."""
    rng = np.random.default_rng(0)
    rows = count * robots
    position = rng.uniform(0.5, 1.5, (rows, 2)).astype(np.float32)
    return Dataset(
        {
            "images": rng.random((rows, 4, 8, 8)).astype(np.float16),
            "position_feature": position,
        },
        4.0 * (1.0 - position),
        np.full(count, robots, np.int32),
        np.ones(count * robots**2, np.bool_),
    )


def fit(path: Path, epochs: int, initial: StateDict | None = None) -> Fit:
    config = FitConfig(epochs=epochs, batch_robots=30, learning_rate=1e-2, bf16=False)
    return Fit(NETWORK, config, DaggerConfig(), 0, path, initial)


def test_it_learns(tmp_path: Path) -> None:
    of = fit(tmp_path / "fit.pt", 8)
    of.run(states(200), 0, 8, lambda share, loss: None)
    losses = [each.loss for each in of.losses]
    assert len(losses) == 8 and losses[-1] < 0.1 and losses[0] > 2.0 * losses[-1]
    again = fit(tmp_path / "fit.pt", 8)
    assert again.losses == of.losses and again.done(0) == 8 and again.done(1) == 0


def test_it_begins_with_what_was_learnt_before(tmp_path: Path) -> None:
    before = fit(tmp_path / "before.pt", 8)
    before.run(states(200), 0, 8, lambda share, loss: None)
    of = fit(tmp_path / "fit.pt", 8, before.weights)
    assert all(of.untrained()[name].equal(tensor) for name, tensor in before.weights.items())
    of.run(states(200), 0, 1, lambda share, loss: None)
    assert of.losses[0].loss < 0.5 * before.losses[0].loss


def test_a_loss_that_is_not_finite_is_one_line(tmp_path: Path) -> None:
    data = states(20)
    data.velocities[0] = np.nan
    with pytest.raises(
        ValueError, match="loss = nan in epoch 1 of round 0: must be finite: choose"
    ):
        fit(tmp_path / "fit.pt", 1).run(data, 0, 1, lambda share, loss: None)


def test_a_broken_file_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "fit.pt").write_bytes(b"PK")
    with pytest.raises(ValueError, match=r"fit\.pt: cannot continue from this file"):
        fit(tmp_path / "fit.pt", 1)


def test_what_cannot_be_written_leaves_what_was(tmp_path: Path) -> None:
    """A folder in place of the new file stands for a full disk."""
    data = states(20)
    fit(tmp_path / "fit.pt", 2).run(data, 0, 1, lambda share, loss: None)
    before = (tmp_path / "fit.pt").read_bytes()
    (tmp_path / "fit.pt.new").mkdir()
    with pytest.raises(OSError):
        fit(tmp_path / "fit.pt", 2).run(data, 0, 2, lambda share, loss: None)
    assert (tmp_path / "fit.pt").read_bytes() == before
