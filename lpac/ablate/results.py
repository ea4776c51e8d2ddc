"""Results of an ablation's variants, and their comparison with the base."""

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
    """S trainings over K worlds: `final` (S, K) is the final cost over the initial cost.

    `against_base` compares the variant (A) with the base (B); None for the base.
    """

    variant: PlannedVariant
    bundles: tuple[TrainedBundle, ...]
    final: F64
    against_base: Verdict | None

    @property
    def mean(self) -> Interval95:
        """Mean over trainings and worlds."""
        return bootstrap(self.final)

    @property
    def deviation(self) -> float | None:
        """Standard deviation of the trainings' means; None for a single training."""
        means = self.final.mean(axis=1)
        return float(means.std(ddof=1)) if len(means) > 1 else None

    @property
    def verdict(self) -> Literal["better", "worse", "not distinguishable"] | None:
        """The variant relative to the base; None for the base."""
        if self.against_base is None:
            return None
        better = self.against_base.better
        return "not distinguishable" if better is None else "better" if better == "a" else "worse"


def study_of(ablation: Ablation, bundles: Mapping[str, TrainedBundle]) -> Study:
    """The ablation's flights: one condition per variant, and one method per trained variant.

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
    """Results of all variants, the base first; `flown` are those of `study_of`.

    Trainings of a variant and of the base are independent, unless they are the same.
    """
    results: list[VariantResult] = []
    for variant, (result, *_) in zip(ablation.variants, flown.values(), strict=True):
        verdict = None
        if results:
            verdict = compare(result.final, results[0].final, same_trainings=not variant.trained)
        results.append(VariantResult(variant, result.method.trainings, result.final, verdict))
    return results


def is_claim(ablation: Ablation) -> bool:
    """Whether there are enough trainings for a claim about the method."""
    return len(ablation.config.seeds) >= LEAST_TRAININGS


def as_json(ablation: Ablation, results: Sequence[VariantResult]) -> dict[str, Any]:
    """All numbers for scripts; intervals as [value, low, high]."""
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
