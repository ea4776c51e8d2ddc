"""A whole training in seconds: stopped at any point, it continues to the same result."""

import json
from collections.abc import Callable, Generator, Sequence
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from edge.core.schema import ConfigError
from edge.core.wire import FLOAT_PAYLOADS
from edge.drivers.registry import load_policy
from edge.policy.bundle import load_bundle
from edge.policy.images import EXPLORED, MAP_CHANNELS
from edge.policy.lpac.manifest import LpacManifest
from lpac.sim.cores import Outcome, Task
from lpac.study.worlds import FIELD, draw_world
from lpac.train.progress import RunProgress
from lpac.train.run import TrainingRun
from tests.training import here, read, said

pytestmark = pytest.mark.slow


class StoppedError(Exception):
    """Stops a training."""


def quiet(now: RunProgress) -> None:
    pass


def weights(folder: Path) -> dict[str, torch.Tensor]:
    state: dict[str, torch.Tensor] = torch.load(folder / "small.pt", weights_only=True)
    return state


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Results of an uninterrupted training."""
    folder = tmp_path_factory.mktemp("trained")
    return folder / "run", TrainingRun(read(folder), folder / "run", quiet).run(here)


def test_what_comes_of_it(trained: tuple[Path, dict[str, Any]]) -> None:
    folder, told = trained
    bundle = load_bundle(folder / "small")
    assert bundle.id == told["bundle_id"]
    assert all(check.passed for check in load_policy(bundle).verify())
    assert bundle.manifest.payload_limit is not None and bundle.manifest.payload_limit > 0.0
    assert set(FLOAT_PAYLOADS) <= set(bundle.manifest.payload_types)
    assert told["states"] == 12  # 2 + 2 flights, 3 of each
    assert [(one["round"], one["epoch"]) for one in told["candidates"]] == [(0, 1), (0, 2), (1, 1)]
    assert told["selected"] == min(told["candidates"], key=lambda one: one["mean"])
    assert told["below_decentralized_cvt"] == (
        told["selected"]["mean"] < told["baselines"]["decentralized-cvt"]["mean"]
    )
    json.dumps(told)


def test_its_candidates_flew_over_validation_worlds_only(
    trained: tuple[Path, dict[str, Any]],
) -> None:
    flown = [
        json.loads(line)["seed"]
        for line in (trained[0] / "flights.jsonl").read_text().splitlines()[1:]
    ]
    # Three candidates, the best one with int8 payloads, and three baselines, over two worlds; then
    # the best one and the baselines for a battery's time.
    seeds = {draw_world("validation", world, FIELD).seed for world in range(2)}
    assert len(flown) == 22 and set(flown) == seeds


def test_the_card_tells_of_it(trained: tuple[Path, dict[str, Any]]) -> None:
    folder, told = trained
    card = (folder / "README.md").read_text()
    for text in (told["bundle_id"], "12 states of swarms", "Licence: MIT", "| decentralized-cvt |"):
        assert text in card
    over = told["over_mission"]
    assert set(over) == {"policy", *told["baselines"]}
    assert over["policy"]["times_s"] == [2.0] and over["policy"]["worst_rise"] >= 0.0
    assert f"| **small** | {over['policy']['mean'][0]:.3f} |" in card
    for figure in ("losses", "costs", "first-world", "worst-world"):
        assert (folder / "figures" / f"{figure}.png").stat().st_size > 5_000


@pytest.mark.usefixtures("sketched")
def test_a_network_that_sees_what_was_explored_is_trained_alike(tmp_path: Path) -> None:
    channels = MAP_CHANNELS[5]
    config = read(tmp_path, ("[network]\n", f"[network]\nchannels = {list(channels)}\n"))
    TrainingRun(config, tmp_path / "run", quiet).run(here)
    bundle = load_bundle(tmp_path / "run" / "small")
    images = LpacManifest.of(bundle.manifest).images
    assert images is not None and images.channels == channels
    assert all(check.passed for check in load_policy(bundle).verify())
    data = [np.load(shard)["input/images"] for shard in (tmp_path / "run" / "data").glob("*.npz")]
    explored = np.concatenate(data)[:, channels.index(EXPLORED)]
    assert explored.min() == 0.0 and explored.max() == 1.0


@pytest.mark.usefixtures("sketched")
def test_stopped_anywhere_it_goes_on_and_comes_to_the_same(
    trained: tuple[Path, dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stop between shards, batches and flights, each time a little later."""
    monkeypatch.setattr("lpac.train.fit._SAVE_PERIOD_S", 0.0)
    config, folder = read(tmp_path), tmp_path / "run"
    for stops in count():
        told = 0

        def stop(now: RunProgress, stops: int = stops) -> None:
            nonlocal told
            told += 1
            if told == 4:
                raise StoppedError

        try:
            came_of_it = TrainingRun(config, folder, stop).run(here)
            break
        except StoppedError:
            assert stops < 20
    assert stops > 4
    assert said(came_of_it) == said(trained[1])
    for name, tensor in weights(trained[0]).items():
        assert torch.equal(tensor, weights(folder)[name]), name


@pytest.mark.usefixtures("sketched")
def test_a_killed_worker_costs_one_shard(tmp_path: Path) -> None:
    # In worlds of their own shards.
    config = read(tmp_path, ("[2, 3]", "[30, 31]"), ("[0, 1]", "[0, 0]"))
    folder, done = tmp_path / "run", 0

    def killed(
        do: Callable[[Task], Outcome], tasks: Sequence[Task]
    ) -> Generator[Outcome, None, None]:
        yield do(tasks[0])
        raise ChildProcessError("a worker process was killed")

    with pytest.raises(ChildProcessError, match="a worker process was killed"):
        TrainingRun(config, folder, quiet).run(killed)
    [shard] = (folder / "data").glob("*.npz")
    before = shard.read_bytes()

    def counted(
        do: Callable[[Task], Outcome], tasks: Sequence[Task]
    ) -> Generator[Outcome, None, None]:
        nonlocal done
        done += len(tasks)
        for task in tasks:
            yield do(task)
        raise StoppedError

    with pytest.raises(StoppedError):
        TrainingRun(config, folder, quiet).run(counted)
    assert done == 1 and shard.read_bytes() == before


def test_another_configuration_is_another_run(
    trained: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=r"has a run of another configuration .*config\.toml"):
        TrainingRun(read(tmp_path, ("states = 3", "states = 4")), trained[0], quiet)


def test_more_rounds_go_on(trained: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    config = read(tmp_path, ("rounds = 1", "rounds = 2"))
    told: list[RunProgress] = []

    def stop(now: RunProgress) -> None:
        told.append(now)
        raise StoppedError

    before = (trained[0] / "config.toml").read_text()
    try:
        with pytest.raises(StoppedError):
            TrainingRun(config, trained[0], stop).run(here)
    finally:
        (trained[0] / "config.toml").write_text(before)
    assert (told[0].stage, told[0].round) == ("generate", 2)
