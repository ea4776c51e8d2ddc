"""A run's data on disk: shards that are added, never replaced, and their manifest.

A shard is written to a temporary file, moved into place, then added to the manifest. A shard that
was interrupted is flown again, with the same result.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from edge.core import F32, Bools
from lpac.sim.kept import KeptOutcomes
from lpac.train.rollout import States

_MANIFEST = "manifest.jsonl"
_INPUT = "input/"


class Shards:
    """The shards of one configuration in a folder."""

    def __init__(self, folder: Path, config: str) -> None:
        """`config` is a digest; shards of other configurations are ignored. Raises OSError."""
        self._folder = folder
        self._kept = KeptOutcomes(folder / _MANIFEST, {"config": config})

    @property
    def facts(self) -> dict[str, dict[str, Any]]:
        """Manifest entry of each shard with a file, by name."""
        lines = {line["shard"]: line for line in self._kept.lines}
        return {name: line for name, line in lines.items() if self._path(name).exists()}

    def add(self, name: str, states: States, facts: Mapping[str, Any]) -> None:
        """Write a shard, and `facts` to the manifest. Raises OSError."""
        arrays: dict[str, Any] = {f"{_INPUT}{key}": rows for key, rows in states.inputs.items()}
        new = self._folder / "new.npz"
        with new.open("wb") as file:
            np.savez_compressed(
                file, velocities=states.velocities, robots=states.robots,
                adjacency=states.adjacency, **arrays,
            )  # fmt: skip
        new.replace(self._path(name))
        self._kept.add(
            {
                "shard": name,
                "states": len(states.robots),
                "robots": int(states.robots.sum()),
                "largest_payload": states.largest_payload,
                **facts,
            }
        )

    def load(self, last_round: int) -> "Dataset":
        """Load all shards up to that round, in order of name. Raises OSError, ValueError."""
        columns: dict[str, list[npt.NDArray[Any]]] = {}
        for name in sorted(self.facts):
            if int(name.partition("-")[0]) > last_round:
                continue
            try:
                with np.load(self._path(name), allow_pickle=False) as shard:
                    for key in shard.files:
                        columns.setdefault(key, []).append(shard[key])
            except (ValueError, KeyError, EOFError) as error:
                raise ValueError(f"{self._path(name)}: unreadable shard: {error}") from None
        whole = {key: np.concatenate(columns.pop(key)) for key in list(columns)}
        inputs = {
            key.removeprefix(_INPUT): rows for key, rows in whole.items() if key.startswith(_INPUT)
        }
        return Dataset(inputs, whole["velocities"], whole["robots"], whole["adjacency"])

    def _path(self, name: str) -> Path:
        return self._folder / f"{name}.npz"


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """B swarms of at most N robots, R in total: `inputs` and `velocities` (R, ...).

    `present` (B, N) and `adjacency` (B, N, N) are as in `TrainableModule`.
    """

    inputs: dict[str, npt.NDArray[np.floating]]
    velocities: F32
    present: Bools
    adjacency: Bools


class Dataset:
    """All states in memory: see `States`."""

    def __init__(
        self,
        inputs: dict[str, npt.NDArray[np.floating]],
        velocities: F32,
        robots: npt.NDArray[np.int32],
        adjacency: Bools,
    ) -> None:
        self._inputs = inputs
        self.velocities = velocities
        self.robots = robots
        self._adjacency = adjacency
        self._first = np.cumsum([0, *robots])
        self._first_pair = np.cumsum([0, *robots.astype(np.int64) ** 2])

    def __len__(self) -> int:
        return len(self.robots)

    def batches(self, rng: np.random.Generator, robots: int) -> list[npt.NDArray[np.intp]]:
        """Shuffle all states into batches of at most `robots` robots, or of a single state."""
        order = rng.permutation(len(self))
        batches: list[npt.NDArray[np.intp]] = []
        start, full = 0, 0
        for place, size in enumerate(self.robots[order].tolist()):
            if place > start and full + size > robots:
                batches.append(order[start:place])
                start, full = place, 0
            full += size
        return [*batches, order[start:]]

    def batch(self, states: npt.NDArray[np.intp]) -> Batch:
        """Batch of the states with these indices."""
        sizes = self.robots[states]
        present = np.arange(sizes.max()) < sizes[:, None]
        adjacency = np.zeros((*present.shape, present.shape[1]), np.bool_)
        for swarm, (state, size) in enumerate(zip(states, sizes.tolist(), strict=True)):
            pairs = self._adjacency[self._first_pair[state] : self._first_pair[state + 1]]
            adjacency[swarm, :size, :size] = pairs.reshape(size, size)
        rows = np.concatenate(
            [np.arange(self._first[state], self._first[state + 1]) for state in states]
        )
        return Batch(
            {name: values[rows] for name, values in self._inputs.items()},
            self.velocities[rows],
            present,
            adjacency,
        )
