"""Results of the variants of an ablation, and whether they differ from the base."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from edge.core import F64
from lpac.ablate.config import BASE, Ablation, PlannedVariant
from lpac.analysis.statistics import LEAST_TRAININGS, Interval95, Verdict, bootstrap, compare
from lpac.study.results import MethodResult, scenario_json
from lpac.study.study import Condition, Method, Study, TrainedBundle


@dataclass(frozen=True, slots=True, eq=False)
class VariantResult:
    """Of S trainings over K worlds: `final` (S, K) are costs at the end over those at the start.

    `against_base` is None for the base itself; its A is the variant, its B the base.
    """

    variant: PlannedVariant
    bundles: tuple[TrainedBundle, ...]
    final: F64
    against_base: Verdict | None

    @property
    def mean(self) -> Interval95:
        """Over trainings and worlds."""
        return bootstrap(self.final)

    @property
    def deviation(self) -> float | None:
        """The standard deviation of the trainings' means; None of a single one."""
        means = self.final.mean(axis=1)
        return float(means.std(ddof=1)) if len(means) > 1 else None

    @property
    def verdict(self) -> Literal["better", "worse", "not distinguishable"] | None:
        """Of the variant, against the base."""
        if self.against_base is None:
            return None
        better = self.against_base.better
        return "not distinguishable" if better is None else "better" if better == "a" else "worse"


def study_of(ablation: Ablation, bundles: Mapping[str, TrainedBundle]) -> Study:
    """The flights by which variants are judged: a condition, and often a policy, for each of them.

    `bundles` are by the trainings' names.
    """
    return Study(
        methods=tuple(
            Method(name=v.name, trainings=tuple(bundles[training.name] for training in v.trainings))
            for v in ablation.variants
            if v.trained
        ),
        conditions=tuple(
            replace(v.condition, methods=(v.name if v.trained else BASE,))
            for v in ablation.variants
        ),
        world_set=ablation.config.world_set,
        first_world=ablation.worlds.start,
        worlds=len(ablation.worlds),
    )


def results_of(
    ablation: Ablation, flown: Mapping[Condition, Sequence[MethodResult]]
) -> list[VariantResult]:
    """Each variant's, the base's first; `flown` is what its study came to.

    Trainings of a variant and of the base are independent of each other, unless they are the same.
    """
    results: list[VariantResult] = []
    for variant, (its, *_) in zip(ablation.variants, flown.values(), strict=True):
        verdict = None
        if results:
            verdict = compare(its.final, results[0].final, same_trainings=not variant.trained)
        results.append(VariantResult(variant, its.method.trainings, its.final, verdict))
    return results


def is_claim(ablation: Ablation) -> bool:
    """Whether trainings are enough for a claim about the method, and not about these policies."""
    return len(ablation.config.seeds) >= LEAST_TRAININGS


def as_json(ablation: Ablation, results: Sequence[VariantResult]) -> dict[str, Any]:
    """All numbers, for scripts; intervals as [value, low, high]."""
    config = ablation.config
    return {
        "base": config.base,
        "seeds": list(config.seeds),
        "of_methods": is_claim(ablation),
        "world_set": config.world_set,
        "first_world": ablation.worlds.start,
        "worlds": config.worlds,
        "set_up": config.set_up,
        "duration_s": config.duration_s,
        "variants": [_result_json(result) for result in results],
    }


def _result_json(result: VariantResult) -> dict[str, Any]:
    variant, against = result.variant, result.against_base
    return {
        "name": variant.name,
        "why": variant.why,
        "trained": variant.trained,
        "scenario": scenario_json(variant.condition.scenario),
        "bundles": [
            {"path": f"{Path(path).parent.name}/{Path(path).name}", "bundle_id": bundle_id}
            for path, bundle_id in result.bundles
        ],
        "mean": list(result.mean),
        "deviation_over_seeds": result.deviation,
        "difference": list(against.difference) if against else None,
        "ratio": list(against.ratio) if against else None,
        "verdict": result.verdict,
        "by_seed_and_world": result.final.tolist(),
    }
