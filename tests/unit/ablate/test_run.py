"""A whole ablation in seconds: stopped, it continues to the same result."""

import json
from collections.abc import Callable, Generator, Iterator, Sequence
from pathlib import Path

import pytest

from edge.core.schema import ConfigError
from lpac.ablate.config import Ablation, read_ablation
from lpac.ablate.run import AblationProgress, AblationRun
from lpac.ablate.summary import write_report
from lpac.sim.cores import Outcome, Task
from tests.training import here
from tests.unit.ablate.test_config import written

pytestmark = pytest.mark.slow


class StoppedError(Exception):
    """Stops an ablation."""


def quiet(now: AblationProgress) -> None:
    pass


def ablate(ablation: Ablation, folder: Path, tell: Callable[[AblationProgress], None]) -> None:
    write_report(ablation, AblationRun(ablation, folder, tell).run(here), folder)


@pytest.fixture(scope="module", autouse=True)
def no_cards() -> Iterator[None]:
    """Skip the model cards, which take four fifths of the time; tests/unit/train draws them."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("lpac.train.run.write_card", lambda *_: None)
        yield


@pytest.fixture(scope="module")
def ablated(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[AblationProgress]]:
    """Results of an uninterrupted ablation."""
    folder, told = tmp_path_factory.mktemp("ablated"), list[AblationProgress]()
    ablate(read_ablation(written(folder)), folder / "run", told.append)
    return folder / "run", told


def test_what_comes_of_it(ablated: tuple[Path, list[AblationProgress]]) -> None:
    folder, _ = ablated
    told = json.loads((folder / "ablation.json").read_text())
    base, features, slow = told["variants"]
    assert [each["name"] for each in told["variants"]] == ["base", "no-features", "slow"]
    assert slow["bundles"] == base["bundles"] != features["bundles"]
    assert len({each["bundle_id"] for each in (*base["bundles"], *features["bundles"])}) == 4
    for variant in told["variants"]:
        final = variant["by_seed_and_world"]
        assert [len(of_seed) for of_seed in final] == [6, 6]
        assert variant["mean"][0] == pytest.approx(sum(map(sum, final)) / 12)
        assert variant["deviation_over_seeds"] >= 0.0
        for bundle in variant["bundles"]:
            assert (folder / bundle["path"] / "manifest.json").exists()
    assert base["difference"] is base["verdict"] is None
    for variant in (features, slow):
        value, low, high = variant["difference"]
        assert value == pytest.approx(variant["mean"][0] - base["mean"][0])
        assert low <= value <= high
    assert slow["by_seed_and_world"] != base["by_seed_and_world"]
    assert not told["of_methods"]
    assert (folder / "differences.png").stat().st_size > 5_000
    report = (folder / "README.md").read_text()
    assert "\n**2 training seeds: the results hold for these policies, and do not" in report
    assert f"| slow | Perception and policy are slow. | no | {slow['mean'][0]:.3f} | " in report


def test_how_far_it_is(ablated: tuple[Path, list[AblationProgress]]) -> None:
    _, told = ablated
    assert told[0].doing == "base-0, 1 of 4 trainings" and told[-1].doing == "flight 42 of 42"
    shares = [now.done for now in told]
    assert shares == sorted(shares) and shares[-1] == 1.0
    left_s = [now.left_s for now in told if now.left_s is not None]
    assert left_s and all(seconds >= 0.0 for seconds in left_s)


def test_stopped_it_goes_on_and_comes_to_the_same(
    ablated: tuple[Path, list[AblationProgress]], tmp_path: Path
) -> None:
    """Stop in the second training, in the last, and among the flights."""
    ablation, folder = read_ablation(written(tmp_path)), tmp_path / "run"
    for doing in ("base-4, 2", "no-features-4, 4", "flight 7 of 42"):

        def stop(now: AblationProgress, doing: str = doing) -> None:
            if now.doing.startswith(doing):
                raise StoppedError

        with pytest.raises(StoppedError):
            ablate(ablation, folder, stop)
    done = {path: path.stat().st_mtime_ns for path in folder.glob("*/*/bundle.id")}
    assert len(done) == 4
    told: list[AblationProgress] = []
    ablate(ablation, folder, told.append)
    # Finished work is not repeated.
    assert told[0].doing == "flight 1 of 42"
    assert done == {path: path.stat().st_mtime_ns for path in folder.glob("*/*/bundle.id")}
    flown = (folder / "flights.jsonl").read_text().splitlines()[1:]
    assert len({json.loads(line)["flight"] for line in flown}) == len(flown) == 42
    for name in ("ablation.json", "README.md"):
        assert (folder / name).read_bytes() == (ablated[0] / name).read_bytes()


def test_another_configuration_is_another_ablation(
    ablated: tuple[Path, list[AblationProgress]], tmp_path: Path
) -> None:
    """The error comes before any training."""
    other = read_ablation(written(tmp_path, ("hops = 0", "hops = 2")))
    with pytest.raises(ConfigError, match=r"no-features-0: has a run of another configuration"):
        AblationRun(other, ablated[0], quiet)


def test_what_is_added_is_all_that_is_trained(
    ablated: tuple[Path, list[AblationProgress]], tmp_path: Path
) -> None:
    more = read_ablation(written(tmp_path, ("[0, 4]", "[0, 4, 5]")))

    def refuse(
        do: Callable[[Task], Outcome], tasks: Sequence[Task]
    ) -> Generator[Outcome, None, None]:
        raise StoppedError
        yield

    told: list[AblationProgress] = []
    with pytest.raises(StoppedError):
        AblationRun(more, ablated[0], told.append).run(refuse)
    assert {now.doing for now in told} == {"base-5, 5 of 6 trainings"}
