"""Imitation learning: fits weights to the expert's velocities.

Random numbers of an epoch follow from seed, round and epoch; those of a batch also from its number.
A run that was killed continues to the same weights.
"""

import io
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from edge.core import F32
from lpac.train.config import DaggerConfig, FitConfig
from lpac.train.data import Dataset
from lpac.train.family import Learnable, StateDict, shift_operator
from lpac.train.files import write_atomically

_SAVE_PERIOD_S = 120.0
_MAX_GRADIENT_NORM = 1.0
_MIN_DEVIATION = 1e-3


class EpochLoss(NamedTuple):
    """Mean loss over an epoch, relative to that of the expert's mean action."""

    round: int
    epoch: int
    loss: float


@dataclass(slots=True)
class _Position:
    """Progress of the fit: batches done in an epoch of a round."""

    round: int = 0
    epoch: int = 0
    batch: int = 0


class Fit:
    """The weights and the progress of the fit, saved in a file."""

    def __init__(
        self,
        network: Learnable,
        fit: FitConfig,
        dagger: DaggerConfig,
        seed: int,
        path: Path,
        initial: StateDict | None = None,
    ) -> None:
        """Continue from the file at `path`; without it, begin with `initial` or random weights.

        Raises OSError, ValueError.
        """
        self._network = network
        self._config = fit
        self._dagger = dagger
        self._seed = seed
        self._path = path
        self._initial = initial
        self._device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self._bf16 = fit.bf16 and _computes_bf16(self._device)
        self._at = _Position()
        self.losses: list[EpochLoss] = []
        self.seconds = 0.0
        self._sum = 0.0
        self._saved: dict[str, Any] | None = None
        self._deviation = torch.ones(2)
        if path.exists():
            self._read()

    @property
    def device(self) -> str:
        """The device, and bf16 if used."""
        return f"{self._device.type}{', bf16' if self._bf16 else ''}"

    def epochs(self, round_: int) -> int:
        """Number of epochs of a round."""
        return self._config.epochs if round_ == 0 else self._dagger.epochs

    def done(self, round_: int) -> int:
        """Number of epochs of a round that are done."""
        at = self._at
        return at.epoch if at.round == round_ else self.epochs(round_) if at.round > round_ else 0

    def untrained(self) -> StateDict:
        """Initial weights, for a bundle that only defines the inputs."""
        zero, one = np.zeros(2, np.float32), np.ones(2, np.float32)
        return self._new_module(zero, one).state_dict()

    @property
    def weights(self) -> StateDict:
        """The present weights."""
        assert self._saved is not None
        weights: StateDict = self._saved["module"]
        return weights

    def run(
        self,
        data: Dataset,
        round_: int,
        until_epoch: int,
        report: Callable[[float, float], None],
    ) -> None:
        """Fit up to the end of an epoch of a round, on all data.

        Calls `report` with the share of the round's batches that are done and the mean loss of the
        present epoch. Raises ValueError if the loss is not finite, and OSError.
        """
        if self._at.round < round_:
            self._at = _Position(round_)
        if self.done(round_) >= until_epoch:
            return
        module, optimiser = self._restore(data)
        begun_s = kept_s = time.monotonic()
        before_s = self.seconds
        while self._at.epoch < until_epoch:
            at = self._at
            batches = data.batches(self._rng(0), self._config.batch_robots)
            total = len(batches) * self.epochs(round_)
            for number in range(at.batch, len(batches)):
                done = at.epoch * len(batches) + number
                for group in optimiser.param_groups:
                    group["lr"] = self._learning_rate(round_, done / total)
                loss = self._step(module, optimiser, data, batches[number], number)
                if not math.isfinite(loss):
                    raise ValueError(
                        f"loss = {loss} in epoch {at.epoch + 1} of round {round_}: must be finite: "
                        "choose a lower learning_rate"
                    )
                self._sum += loss
                at.batch = number + 1
                report((done + 1) / total, self._sum / at.batch)
                self.seconds = before_s + time.monotonic() - begun_s
                if at.batch < len(batches) and time.monotonic() - kept_s > _SAVE_PERIOD_S:
                    self._save(module, optimiser)
                    kept_s = time.monotonic()
            self.losses.append(EpochLoss(round_, at.epoch + 1, self._sum / len(batches)))
            self._at, self._sum = _Position(round_, at.epoch + 1), 0.0
            self._save(module, optimiser)

    def _step(
        self,
        module: torch.nn.Module,
        optimiser: torch.optim.Optimizer,
        data: Dataset,
        states: "np.ndarray[Any, np.dtype[np.intp]]",
        number: int,
    ) -> float:
        rng = self._rng(1, number)
        batch = data.batch(states)
        inputs, velocities = batch.inputs, batch.velocities
        if self._config.symmetries:
            inputs, velocities = self._network.symmetric(  # type: ignore[assignment]
                inputs, velocities, int(rng.integers(8))
            )
        received = rng.random(batch.adjacency.shape, np.float32) >= self._config.lost_messages
        shift = self._to_device(shift_operator(batch.adjacency, received))
        module.train(len(velocities) > 1)
        swarms = (
            {name: self._to_device(values) for name, values in inputs.items()},
            shift,
            torch.from_numpy(batch.present).to(self._device),
        )
        expert, deviation = self._to_device(velocities), self._deviation.to(self._device)
        with (
            torch.random.fork_rng(devices=[]),
            torch.autocast(self._device.type, torch.bfloat16, enabled=self._bf16),
        ):
            # What the module draws, such as dropout.
            torch.manual_seed(int(rng.integers(2**63)))
            own_loss = getattr(module, "loss", None)
            loss = (
                own_loss(*swarms, expert)
                if own_loss
                else ((module(*swarms) - expert) / deviation).square().mean()
            )
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(module.parameters(), _MAX_GRADIENT_NORM)
        optimiser.step()
        return float(loss.item())

    def _to_device(self, values: "np.ndarray[Any, np.dtype[np.floating[Any]]]") -> torch.Tensor:
        return torch.from_numpy(values).to(self._device, torch.float32)

    def _learning_rate(self, round_: int, done: float) -> float:
        first = self._config.learning_rate * (1.0 if round_ == 0 else self._dagger.learning_rate)
        return first * 0.5 * (1.0 + math.cos(math.pi * done))

    def _rng(self, *of: int) -> np.random.Generator:
        key = [self._seed, self._at.round, self._at.epoch, *of]
        return np.random.default_rng(np.random.SeedSequence(key))

    def _new_module(self, mean: F32, deviation: F32) -> torch.nn.Module:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self._seed)
            module = self._network.module(mean, deviation)
        if self._initial is not None:
            module.load_state_dict(self._initial)
        return module

    def _restore(self, data: Dataset) -> tuple[torch.nn.Module, torch.optim.Optimizer]:
        """The module and its optimiser, restored or new."""
        mean = data.velocities.mean(axis=0)
        deviation = np.maximum(data.velocities.std(axis=0), _MIN_DEVIATION)
        if self._saved is not None:
            # Keep the scale of the first data, so that the outputs keep their meaning.
            mean, deviation = (self._saved[name].numpy() for name in ("mean", "deviation"))
        module = self._new_module(mean, deviation).to(self._device)
        optimiser = torch.optim.AdamW(
            module.parameters(),
            lr=self._config.learning_rate,
            weight_decay=self._config.weight_decay,
        )
        self._mean, self._deviation = torch.from_numpy(mean), torch.from_numpy(deviation)
        if self._saved is not None:
            module.load_state_dict(self._saved["module"])
            optimiser.load_state_dict(self._saved["optimiser"])
        return module, optimiser

    def _save(self, module: torch.nn.Module, optimiser: torch.optim.Optimizer) -> None:
        at = self._at
        self._saved = {
            "module": {name: t.detach().cpu().clone() for name, t in module.state_dict().items()},
            "optimiser": optimiser.state_dict(),
            "mean": self._mean,
            "deviation": self._deviation,
            "at": [at.round, at.epoch, at.batch],
            "sum": self._sum,
            "losses": [list(loss) for loss in self.losses],
            "seconds": self.seconds,
        }
        buffer = io.BytesIO()
        torch.save(self._saved, buffer)
        write_atomically(self._path, buffer.getvalue())

    def _read(self) -> None:
        try:
            kept: dict[str, Any] = torch.load(self._path, "cpu", weights_only=True)
            self._at = _Position(*kept["at"])
            self._sum, self.seconds = kept["sum"], kept["seconds"]
            self.losses = [EpochLoss(*loss) for loss in kept["losses"]]
        except OSError:
            raise
        except Exception as error:  # torch raises many types for unreadable files
            raise ValueError(f"{self._path}: cannot continue from this file: {error}") from None
        self._saved = kept


def _computes_bf16(device: torch.device) -> bool:
    if device.type == "cuda":
        return bool(torch.cuda.is_bf16_supported())
    return bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())
