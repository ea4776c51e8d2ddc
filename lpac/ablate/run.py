"""Runs an ablation in a folder from which it can continue: all trainings, then the flights."""

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

# Results of a training, written when it is finished.
_RESULT = "result.json"


class AblationProgress(NamedTuple):
    """Progress of an ablation.

    `done` is the share of all work, with the flights counted as one more training. `training` is
    the progress of the present training. `left_s` is None while it is unknown.
    """

    doing: str
    done: float
    training: RunProgress | None
    left_s: float | None


class AblationRun:
    """The ablation in one folder."""

    def __init__(
        self, ablation: Ablation, folder: Path, report: Callable[[AblationProgress], None]
    ) -> None:
        """Begin or continue. Raises ConfigError if a configuration has changed; OSError."""
        self._ablation = ablation
        self._folder = folder
        self._report = report
        # Checked before hours of other trainings.
        for training in ablation.trainings:
            require_same_run(training.read, folder / training.name)

    def run(self, pool: Pool) -> list[VariantResult]:
        """Train, then fly; the base's result is the first. Raises ValueError, OSError.

        Trainings run one after another: each uses all cores.
        """
        trainings = self._ablation.trainings
        missing = [training for training in trainings if not self._is_done(training)]
        for number, training in enumerate(missing):
            self._train(training, len(trainings) - len(missing) + number, pool)
        return self._judge(pool)

    def _is_done(self, training: PlannedTraining) -> bool:
        result = self._folder / training.name / _RESULT
        # The configuration may have more rounds now.
        return result.exists() and json.loads(result.read_text())["config"] == training.read.text

    def _train(self, training: PlannedTraining, done: int, pool: Pool) -> None:
        total = len(self._ablation.trainings)
        begun_s = time.monotonic()

        def report(now: RunProgress) -> None:
            left_s = None
            if now.left_s is not None:
                # Assume that the following trainings take as long.
                whole_s = time.monotonic() - begun_s + now.left_s
                left_s = now.left_s + (total - done - 1) * whole_s
            doing = f"{training.name}, {done + 1} of {total} trainings"
            share = (done + now.done) / (total + 1)
            self._report(AblationProgress(doing, share, now, left_s))

        folder = self._folder / training.name
        results = TrainingRun(training.read, folder, report).run(pool)
        result = {"config": training.read.text, **results}
        write_atomically(folder / _RESULT, json.dumps(result, indent=2).encode())

    def _judge(self, pool: Pool) -> list[VariantResult]:
        trainings = self._ablation.trainings
        study = study_of(self._ablation, {each.name: self._bundle(each) for each in trainings})

        def report(done: int, of: int) -> None:
            share = (len(trainings) + done / of) / (len(trainings) + 1)
            self._report(AblationProgress(f"flight {done} of {of}", share, None, None))

        return results_of(self._ablation, run(study, pool, folder=self._folder, on_progress=report))

    def _bundle(self, training: PlannedTraining) -> TrainedBundle:
        path = self._folder / training.name / training.name
        return TrainedBundle(str(path.resolve()), load_bundle(path).id)
