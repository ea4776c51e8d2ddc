"""The paper's experiments as studies: the files in `studies`, modified by options of commands."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from lpac.sim.engines import IN_REAL_TIME, EngineName
from lpac.sim.fleet.layout import MAX_ROBOTS
from lpac.study.file import condition_of, read_study
from lpac.study.study import Condition, Method, Study

_STUDIES = Path(__file__).with_name("studies")
# Whole robots take longer: these experiments fly fewer worlds with them, by these factors.
_FEWER = {"async": 5, "transfer": 5}


def experiment(
    name: str, bundles: Sequence[Path], *, engine: EngineName = "point",
    px4_build: Path | None = None, quick: bool = False, set_ups: Sequence[str] = (),
) -> Study:  # fmt: skip
    """Make the experiment of a name, flown by these bundles, as points or whole robots.

    `set_ups` replace its conditions. Raises BundleError, ValueError, OSError.
    """
    path = _STUDIES / (f"{name}-quick.toml" if quick else f"{name}.toml")
    study = read_study(path, px4_build, bundles[0])
    if len(bundles) > 1:
        methods = tuple(Method.of(bundle.name, bundle) for bundle in bundles)
        study = replace(study, methods=methods)
    if set_ups:
        conditions = (condition_of({"set_up": each, "title": each}, "--set-up") for each in set_ups)
        study = replace(study, conditions=tuple(dict.fromkeys(conditions)))
    return study if engine == "point" else _whole(name, study, engine)


def _whole(name: str, study: Study, engine: EngineName) -> Study:
    """The study with whole robots, without conditions that they cannot fly.

    E1 and transfer add points from the same pads.
    """
    conditions: list[Condition] = []
    for condition in study.conditions:
        scenario = condition.scenario
        if scenario.robots > MAX_ROBOTS or scenario.clocks.synchronous:
            continue
        if engine in IN_REAL_TIME and scenario.delay_s:
            continue
        conditions.append(replace(condition, engine=engine))
        if name in ("e1", "transfer"):
            title = condition.title and f"{condition.title}, points from pads"
            conditions.append(replace(condition, from_pads=True, title=title))
    worlds = study.worlds
    if name in _FEWER:
        worlds = 1 if engine in IN_REAL_TIME else max(1, study.worlds // _FEWER[name])
    return replace(study, conditions=tuple(conditions), worlds=worlds)
