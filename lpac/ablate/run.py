"""An ablation in a folder that it can go on in: all trainings, and then the flights that judge."""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from edge.policy.bundle import load_bundle
from lpac.ablate.config import Ablation, PlannedTraining
from lpac.ablate.results import VariantResult, results_of, study_of
from lpac.sim.cores import Pool
from lpac.study.run import run
from lpac.study.study import TrainedBundle
from lpac.train.files import write_atomically
from lpac.train.progress import RunProgress
from lpac.train.run import TrainingRun, require_same_run

# What a training came to; it is there once all of the training is done.
_RESULT = "result.json"


class AblationProgress(NamedTuple):
    """What an ablation does now.

    `done` is the share of all its work, the flights counting as one more training; `training` is
    how far the training is that runs. `left_s` is None as long as nobody knows.
    """

    doing: str
    done: float
    training: RunProgress | None
    left_s: float | None


class AblationRun:
    """One folder's ablation."""

    def __init__(
        self, ablation: Ablation, folder: Path, tell: Callable[[AblationProgress], None]
    ) -> None:
        """Begins, or goes on. Raises ConfigError if a training was begun otherwise; OSError."""
        self._ablation = ablation
        self._folder = folder
        self._tell = tell
        # Before hours of others.
        for training in ablation.trainings:
            require_same_run(training.read, folder / training.name)

    def run(self, pool: Pool) -> list[VariantResult]:
        """Train what is not trained, and fly; the base's is the first. Raises ValueError, OSError.

        Trainings run one after another: each of them uses all cores.
        """
        trainings = self._ablation.trainings
        missing = [training for training in trainings if not self._is_done(training)]
        for number, training in enumerate(missing):
            self._train(training, len(trainings) - len(missing) + number, pool)
        return self._judge(pool)

    def _is_done(self, training: PlannedTraining) -> bool:
        result = self._folder / training.name / _RESULT
        # More rounds may be wanted than it had.
        return result.exists() and json.loads(result.read_text())["config"] == training.read.text

    def _train(self, training: PlannedTraining, done: int, pool: Pool) -> None:
        of_all = len(self._ablation.trainings)
        begun_s = time.monotonic()

        def tell(now: RunProgress) -> None:
            left_s = None
            if now.left_s is not None:
                # As if those that follow took as long.
                whole_s = time.monotonic() - begun_s + now.left_s
                left_s = now.left_s + (of_all - done - 1) * whole_s
            doing = f"{training.name}, {done + 1} of {of_all} trainings"
            share = (done + now.done) / (of_all + 1)
            self._tell(AblationProgress(doing, share, now, left_s))

        folder = self._folder / training.name
        told = TrainingRun(training.read, folder, tell).run(pool)
        result = {"config": training.read.text, **told}
        write_atomically(folder / _RESULT, json.dumps(result, indent=2).encode())

    def _judge(self, pool: Pool) -> list[VariantResult]:
        trainings = self._ablation.trainings
        study = study_of(self._ablation, {each.name: self._bundle(each) for each in trainings})

        def tell(done: int, of: int) -> None:
            share = (len(trainings) + done / of) / (len(trainings) + 1)
            self._tell(AblationProgress(f"flight {done} of {of}", share, None, None))

        return results_of(self._ablation, run(study, pool, folder=self._folder, tell=tell))

    def _bundle(self, training: PlannedTraining) -> TrainedBundle:
        path = self._folder / training.name / training.name
        return TrainedBundle(str(path.resolve()), load_bundle(path).id)
