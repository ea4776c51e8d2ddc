"""From policies to results: which methods fly over which worlds, and the flights of all of them."""

from collections.abc import Callable, Sequence
from contextlib import closing
from itertools import chain
from pathlib import Path

from edge.policy.bundle import load_bundle
from lpac.evaluate.evaluation import (
    CLAIRVOYANT,
    Condition,
    Evaluation,
    Method,
    MethodResult,
    TrainedBundle,
    results_of,
)
from lpac.evaluate.flights import (
    BASELINES,
    POLICY,
    EvaluationFlight,
    FlownCost,
    KeptFlights,
    costs_of,
    groups_of,
    sizes_of,
    task_of,
)
from lpac.evaluate.worlds import SET_UPS, WORLD_SETS, WorldSet
from lpac.sim.baselines import BaselineName
from lpac.sim.cores import Pool, in_this_process


def policy_method(name: str, *bundles: Path | str) -> Method:
    """A policy, by the bundles of its trainings, which differ in their seed alone.

    Raises BundleError, ValueError without any.
    """
    if not bundles:
        raise ValueError(f"method {name!r} has no bundle")
    trainings = tuple(
        TrainedBundle(str(Path(path).resolve()), load_bundle(path).id) for path in bundles
    )
    return Method(name=name, flier=POLICY, trainings=trainings)


def make_evaluation(
    methods: Sequence[Method],
    *,
    baselines: Sequence[BaselineName] = BASELINES,
    conditions: Sequence[Condition] = (Condition("field"),),
    world_set: WorldSet = "validation",
    worlds: int = 20,
    duration_s: float = 60.0,
    sizes_from: Path | None = None,
    px4_build: Path | None = None,
) -> Evaluation:
    """`methods`, and behind them the baselines that are not among them.

    ClairvoyantCVT is always one, since all are held against it. Baselines take the sizes of sensor
    and local map from the first bundle, or from the one at `sizes_from` if no policy flies.
    `px4_build` is needed where a condition's robots are "px4".

    Raises BundleError; ValueError for bundles of different tasks, and names what is not known.
    """
    for key, name, known in (
        ("world_set", world_set, WORLD_SETS),
        *(("baseline", name, BASELINES) for name in baselines),
        *(("set_up", condition.set_up, tuple(SET_UPS)) for condition in conditions),
    ):
        if name not in known:
            raise ValueError(f"{key} = {name!r}: must be one of {', '.join(known)}")
    paths = [Path(training.path) for method in methods for training in method.trainings]
    if not paths and sizes_from is None:
        raise ValueError("no policy flies: sizes_from must name the bundle whose sizes to take")
    bundles = {path: load_bundle(path) for path in paths or filter(None, [sizes_from])}
    tasks = {task_of(bundle): path for path, bundle in bundles.items()}
    if len(tasks) > 1:
        different = "; ".join(f"{path}: {task}" for task, path in tasks.items())
        raise ValueError(f"bundles of different tasks: {different}")
    path, first = next(iter(bundles.items()))
    named = {method.name for method in methods}
    wanted = (*baselines, CLAIRVOYANT)
    others = [Method(name=b, flier=b) for b in BASELINES if b in wanted and b not in named]
    return Evaluation(
        methods=(*methods, *others),
        conditions=tuple(conditions),
        world_set=world_set,
        worlds=worlds,
        duration_s=duration_s,
        sizes_from=str(path),
        sizes=sizes_of(first),
        px4_build="" if px4_build is None else str(px4_build.resolve()),
    )


def evaluate(
    evaluation: Evaluation,
    pool: Pool = in_this_process,
    *,
    folder: Path | None = None,
    tell: Callable[[int, int], object] = lambda *_: None,
) -> dict[Condition, list[MethodResult]]:
    """Fly all of it: under each condition each method's results, in the evaluation's order.

    With `over_cores` as `pool` all cores fly; a script must then begin what it does below
    `if __name__ == "__main__":`. A `folder` keeps what was flown: whoever asks again, of this code,
    waits for the rest only. `tell` gets how many flights are done, and of how many.

    Raises BundleError, ValueError, and OSError if the folder cannot be written.
    """
    flights = evaluation.flights()
    costs: dict[EvaluationFlight, FlownCost] = {}
    if folder is None:
        with closing(pool(costs_of, groups_of(flights))) as groups:
            for flight, cost in chain.from_iterable(groups):
                costs[flight] = cost
                tell(len(costs), len(flights))
    else:
        with closing(KeptFlights(folder).fly(flights, pool)) as flown:
            for flight, cost in flown:
                costs[flight] = cost
                tell(len(costs), len(flights))
    return results_of(evaluation, costs)
