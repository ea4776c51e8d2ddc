"""What the variants of an ablation came to, and what the data tell of them."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from edge.core import F64
from lpac.ablate.config import Ablation, PlannedVariant
from lpac.analysis.statistics import LEAST_TRAININGS, Interval95, Verdict, bootstrap, compare
from lpac.evaluate.evaluation import TrainedBundle
from lpac.evaluate.flights import POLICY, EvaluationFlight, FlownCost


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


def flights_of(
    ablation: Ablation, variant: PlannedVariant, bundles: Mapping[str, TrainedBundle]
) -> list[list[EvaluationFlight]]:
    """Of each of its trainings one over each world; `bundles` are by the trainings' names."""
    config, flown_as = ablation.config, variant.flown_as
    return [
        [
            EvaluationFlight(
                flier=POLICY,
                bundle=bundles[training.name].path,
                flown_by=bundles[training.name].bundle_id,
                world_set=config.world_set,
                world=world,
                set_up=config.set_up,
                duration_s=config.duration_s,
                loss=flown_as.loss,
                delay_s=flown_as.delay_s,
                max_message_age_s=flown_as.max_message_age_s,
                payload=flown_as.payload,
                clocks=flown_as.clocks,
            )
            for world in ablation.worlds
        ]
        for training in variant.trainings
    ]


def results_of(
    ablation: Ablation,
    bundles: Mapping[str, TrainedBundle],
    costs: Mapping[EvaluationFlight, FlownCost],
) -> list[VariantResult]:
    """Of all flights that were flown: each variant's, the base's first.

    Trainings of a variant and of the base are independent of each other, unless they are the same.
    """
    results: list[VariantResult] = []
    for variant in ablation.variants:
        final = np.array(
            [
                [costs[flight].cost[-1] / costs[flight].cost[0] for flight in of_training]
                for of_training in flights_of(ablation, variant, bundles)
            ]
        )
        verdict = None
        if results:
            verdict = compare(final, results[0].final, same_trainings=not variant.trained)
        its_own = tuple(bundles[training.name] for training in variant.trainings)
        results.append(VariantResult(variant, its_own, final, verdict))
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
        "flown_as": asdict(variant.flown_as),
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
