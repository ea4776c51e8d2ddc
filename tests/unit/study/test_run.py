"""From a study to its results."""

import itertools
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from edge.policy.bundle import BundleError
from lpac.analysis.figures import snapshots_and_costs
from lpac.analysis.flight import FlightRecord
from lpac.sim.cores import Outcome, Task, in_this_process
from lpac.study import summary
from lpac.study.flights import PlannedFlight
from lpac.study.provenance import made_by_study
from lpac.study.run import run, run_together
from lpac.study.study import Condition, Method, Study
from lpac.study.summary import report_of
from lpac.study.worlds import SET_UPS
from tests.conftest import ROOT, SHIPPED

CONDITION = Condition(scenario=SET_UPS["n1"].scenario(duration_s=1.0))
STUDY = Study(
    methods=(Method.of("ours", SHIPPED), Method.of("shared-cvt")),
    conditions=(CONDITION,),
    worlds=2,
)


def test_the_clairvoyant_is_always_there() -> None:
    assert [m.name for m in STUDY.all_methods] == ["ours", "shared-cvt", "clairvoyant-cvt"]
    alone = Study(methods=(), sizes_from=str(SHIPPED))
    assert [m.name for m in alone.all_methods] == ["clairvoyant-cvt"]


def test_a_folder_keeps_what_was_flown(tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    [results] = run(STUDY, on_progress=lambda *done: told.append(done)).values()
    flights = len(STUDY.flights())
    assert told == [(number, flights) for number in range(1, flights + 1)]
    assert results[0].curves.shape == (1, 2, 2)
    for _ in range(2):
        again = run(STUDY, folder=tmp_path)[CONDITION]
        for one, other in zip(results, again, strict=True):
            np.testing.assert_array_equal(one.curves, other.curves)
    lines = (tmp_path / "flights.jsonl").read_text().splitlines()
    assert len(lines) == 1 + flights  # the first line has the code's digest


def test_what_studies_share_is_flown_once_and_those_that_need_records_have_them(
    tmp_path: Path,
) -> None:
    part = replace(STUDY, worlds=1, figures=("snapshots",))
    groups: list[Any] = []

    def pool(
        do: Callable[[Task], Outcome], tasks: Sequence[Task]
    ) -> Generator[Outcome, None, None]:
        groups.extend(tasks)
        return in_this_process(do, tasks)

    def flown() -> set[PlannedFlight]:
        return set(itertools.chain.from_iterable(groups))

    told: list[tuple[int, int]] = []
    studies = {"all": STUDY, "part": part}
    of_each = dict(run_together(studies, pool, tmp_path, lambda *done: told.append(done)))
    assert flown() == {*STUDY.flights()} and told[-1] == (6, 6)
    assert sum(map(len, groups)) == 6
    for name, study in studies.items():
        for one, other in zip(of_each[name].results[CONDITION], run(study)[CONDITION], strict=True):
            np.testing.assert_array_equal(one.curves, other.curves)
    assert not of_each["all"].records and {*of_each["part"].records} == {*part.flights()}
    # Costs are stored, records are not.
    groups.clear()
    assert of_each.keys() == dict(run_together(studies, pool, tmp_path, lambda *_: None)).keys()
    assert flown() == {*part.flights()}


@pytest.mark.usefixtures("sketched")
def test_each_trial_in_each_world_is_told(tmp_path: Path) -> None:
    study = replace(STUDY, trials=2, figures=("snapshots",))
    [(name, flown)] = run_together({"it": study}, in_this_process, tmp_path, lambda *_: None)
    told = report_of(name, study, flown, tmp_path, {}, {}).data
    assert [*told["flights"]] == [f"world {w}, trial {t}" for w in (0, 1) for t in (1, 2)]


@pytest.mark.usefixtures("sketched")
def test_a_report_says_what_flew_and_pictures_of_the_same_flights_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    study = replace(STUDY, figures=("worst",))
    [(name, flown)] = run_together({"it": study}, in_this_process, tmp_path, lambda *_: None)
    report_of(name, study, flown, tmp_path, made_by_study("study it", study), {}).write(tmp_path)
    text = (tmp_path / "README.md").read_text()
    for said in (
        "1 robot in 162 x 162 units, 1 feature, range 256, 1 s, engine point",
        f"ours: {SHIPPED.relative_to(ROOT)}, {study.methods[0].trainings[0].bundle_id[:12]}",
        "[`worst`](worst) has pictures of the worst worlds, at most 10, of ours under the first",
    ):
        assert said in text
    drawn: list[list[str]] = []

    def draw(flights: Mapping[str, FlightRecord]) -> Figure:
        drawn.append([*flights])
        return snapshots_and_costs(flights)

    monkeypatch.setattr(summary, "snapshots_and_costs", draw)
    told: list[tuple[int, int]] = []
    for _ in range(2):
        summary.draw_worst(
            study, flown.results, tmp_path, in_this_process, lambda *done: told.append(done)
        )
    # Each is flown and drawn once.
    assert drawn == [["ours", "clairvoyant-cvt"]] * 2 and len(told) == 4 + 2
    assert told[-1] == (6, 6) and len([*tmp_path.glob("worst/ours/*.png")]) == 2


def test_a_method_needs_its_bundles() -> None:
    with pytest.raises(ValueError, match="baseline 'none': must be one of decentralized-cvt, "):
        Method.of("none")
    with pytest.raises(ValueError, match="name = 'clairvoyant-cvt': is a baseline's"):
        Method.of("clairvoyant-cvt", SHIPPED)
    with pytest.raises(BundleError, match="nowhere"):
        Method.of("gone", Path("nowhere"))
