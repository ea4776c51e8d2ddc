"""Results of an ablation's flights."""

from pathlib import Path

import pytest

from lpac.ablate.config import Ablation, read_ablation
from lpac.ablate.results import VariantResult, results_of, study_of
from lpac.ablate.summary import no_claim
from lpac.study.flights import CostCurve
from lpac.study.results import results_of as results_of_study
from lpac.study.study import TrainedBundle
from tests.conftest import SHIPPED
from tests.unit.ablate.test_config import written

SEEDS = ("[0, 4]", "[0, 1, 2]")


def results(ablation: Ablation, ends: dict[str, list[float]]) -> list[VariantResult]:
    """Results of trainings with these final costs (initially 200); worlds differ more than they."""
    bundles = {each.name: TrainedBundle(str(SHIPPED), each.name) for each in ablation.trainings}
    study = study_of(ablation, bundles)
    curves = {flight: CostCurve((0.0, 1.0), (200.0, 0.0), 0.0) for flight in study.flights()}
    for variant, condition in zip(ablation.variants, study.conditions, strict=True):
        policy, _ = study.methods_of(condition)
        for draw in study.draws:
            flights = study.flights_of(policy, condition, draw)
            for flight, end in zip(flights, ends[variant.name], strict=True):
                curves[flight] = CostCurve((0.0, 1.0), (200.0, end + 20.0 * draw.world))
    return results_of(ablation, results_of_study(study, curves))


def test_who_is_better_and_by_how_much(tmp_path: Path) -> None:
    ablation = read_ablation(written(tmp_path, SEEDS))
    base, features, slow = results(
        ablation, {"base": [20, 22, 24], "no-features": [40, 41, 42], "slow": [19, 21, 23]}
    )
    assert base.verdict is None and base.deviation == pytest.approx(0.01)
    assert features.verdict == "worse" and features.against_base is not None
    assert features.against_base.difference.value == pytest.approx(19.0 / 200.0)
    assert features.against_base.of_methods
    # Each policy improves, though policies differ by more.
    assert slow.verdict == "better"


def test_trainings_that_differ_more_than_the_variants_tell_nothing(tmp_path: Path) -> None:
    ablation = read_ablation(written(tmp_path, SEEDS))
    _, features, slow = results(
        ablation, {"base": [20, 30, 50], "no-features": [18, 29, 48], "slow": [10, 31, 52]}
    )
    assert features.verdict == slow.verdict == "not distinguishable"


def test_few_seeds_are_no_claim(tmp_path: Path) -> None:
    for seeds, text in (("[7]", "1 training seed: "), ("[0, 1]", "2 training seeds: ")):
        said = no_claim(read_ablation(written(tmp_path, ("[0, 4]", seeds))))
        assert said is not None and said.startswith(f"{text}the results hold for these policies")
    assert no_claim(read_ablation(written(tmp_path, SEEDS))) is None
    one = read_ablation(written(tmp_path, ("[0, 4]", "[7]")))
    base, *_ = results(one, {"base": [20], "no-features": [40], "slow": [30]})
    assert base.deviation is None
