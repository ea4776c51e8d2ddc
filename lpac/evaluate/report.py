"""An evaluation as files: evaluation.json, its figures, and the worst worlds' pictures."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lpac.analysis import style
from lpac.analysis.figures import snapshots_and_costs
from lpac.evaluate import figures
from lpac.evaluate.evaluation import Condition, MethodResult
from lpac.sim.experiment import SimulatedFlight


def write_results(
    told: Mapping[str, Any],
    results: Mapping[Condition, Sequence[MethodResult]],
    folder: Path,
) -> None:
    """evaluation.json, and of each condition three figures. Raises OSError."""
    (folder / "evaluation.json").write_text(json.dumps(told, indent=2) + "\n")
    for condition, of_all in results.items():
        name = condition.name.replace(",", "").replace("%", "percent").replace(" ", "-")
        style.save(figures.cost_curves(condition, of_all), folder / name / "curves")
        style.save(figures.distributions(condition, of_all), folder / name / "distributions")
        style.save(figures.pairs(condition, of_all), folder / name / "pairs")
    if len(results) > 1:
        style.save(figures.over_conditions(results), folder / "conditions")


def write_world(flights: Mapping[str, SimulatedFlight], path: Path) -> None:
    """The first flight's density, seen area, paths and cells; and all costs, by name.

    Raises OSError.
    """
    style.save(snapshots_and_costs({name: f.record for name, f in flights.items()}), path)
