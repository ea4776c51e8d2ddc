"""Writes an ablation's ablation.json, figure, and README.md with the table."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from edge.core.counted import counted
from lpac.ablate.config import Ablation
from lpac.ablate.results import VariantResult, as_json, is_claim
from lpac.analysis import style
from lpac.analysis.statistics import LEAST_TRAININGS
from lpac.analysis.style import WIDTH_IN, tidy
from lpac.study.provenance import made_by
from lpac.study.report import Picture, Report, Table
from lpac.study.study import Condition

_COLOURS = {"better": style.GREEN, "worse": style.VERMILLION, "not distinguishable": style.GREY}


def write_report(
    ablation: Ablation, results: Sequence[VariantResult], folder: Path
) -> dict[str, Any]:
    """Write all files; returns the JSON. Raises OSError."""
    style.save(_differences(results), folder / "differences")
    bundle_ids = dict.fromkeys(each.bundle_id for result in results for each in result.bundles)
    return Report(
        name="ablation",
        title="What each part is worth",
        text=_text(ablation, results[0].variant.condition),
        data=as_json(ablation, results),
        rows=[["variant", "training", "world", "cost_over_first"], *_rows(ablation, results)],
        tables=[Table(_COLUMNS, [_row(result) for result in results], note=_NOTE)],
        figures=[Picture("differences.png", "differences to the base")],
        flown=_FLOWN,
        made_by=made_by("ablate", list(bundle_ids)),
    ).write(folder)


def no_claim(ablation: Ablation) -> str | None:
    """A caveat for the report if there are too few trainings."""
    if is_claim(ablation):
        return None
    seeds = len(ablation.config.seeds)
    return (
        f"{counted(seeds, 'training seed')}: the results hold for these policies, and do not "
        f"support a claim about the method, which needs {LEAST_TRAININGS}"
    )


def _differences(results: Sequence[VariantResult]) -> Figure:
    """Difference of each variant's mean cost from the base's, with its interval."""
    base, *variants = results
    with style.figure(WIDTH_IN, 1.0 + 0.24 * len(variants)) as figure:
        axes = figure.subplots()
        axes.axvline(0.0, color=style.INK, lw=0.8, zorder=0)
        for row, result in enumerate(variants):
            assert result.against_base is not None and result.verdict is not None
            value, low, high = result.against_base.difference
            colour = _COLOURS[result.verdict]
            by_seed = result.final.mean(axis=1) - base.final.mean(
                axis=None if result.variant.trained else 1
            )
            axes.plot(
                by_seed, [row] * len(by_seed), ls="", marker="|", ms=7, color=style.FAINT, zorder=1
            )
            axes.plot((low, high), (row, row), color=colour, lw=1.2)
            axes.plot(value, row, ls="", marker="o", ms=4, color=colour)
        for verdict, colour in _COLOURS.items():
            axes.plot([], [], ls="", marker="o", ms=4, color=colour, label=verdict)
        axes.plot([], [], ls="", marker="|", ms=7, color=style.FAINT, label="one seed")
        axes.set_yticks(range(len(variants)), [result.variant.name for result in variants])
        axes.set(
            xlabel="final / initial cost, mean, minus the base's; 95 % intervals",
            ylim=(len(variants) - 0.5, -0.5),
        )
        tidy(axes)
        figure.legend(loc="outside upper center", ncols=4, fontsize=7)
        return figure


def _text(ablation: Ablation, base: Condition) -> str:
    config, worlds, scenario = ablation.config, ablation.worlds, base.scenario
    chosen = (
        "of the validation set, none of which selected weights"
        if config.world_set == "validation"
        else "of the test set: if you select by these results, it is no longer a test set"
    )
    claim = no_claim(ablation)
    caveat = f"\n\n**{claim[0].upper()}{claim[1:]}.**" if claim else ""
    return (
        "Each variant is the base, except for its difference. Trained variants have the base's "
        f"seeds ({', '.join(map(str, config.seeds))}) and as many flights, states, epochs, rounds "
        "and candidates; the others fly the base's policies. All fly over "
        f"the {len(worlds)} worlds {worlds.start} to {worlds.stop - 1} {chosen} ({config.set_up}, "
        f"{config.duration_s:g} s), the base with {100.0 * scenario.loss:g} % of messages lost, a "
        f"delay of {scenario.delay_s:g} s, and payloads in {scenario.payload}. {_FLOWN}{caveat}"
    )


_FLOWN = "The robots were points."
_COLUMNS = ("variant", "", "trained", "mean", "over seeds", "difference from base", "95 %", "")
_NOTE = (
    'Final cost over initial cost; less is better. "Over seeds" is the standard deviation of the '
    "trainings' means. The intervals are from a bootstrap that draws worlds in pairs, and "
    "trainings: those of a variant and of the base separately, unless they are the same. With few "
    "trainings the intervals tend to be too narrow. Of twenty intervals, one is expected to miss "
    "the true value. Each training's folder has its model card."
)


def _row(result: VariantResult) -> list[str]:
    variant = result.variant
    return [variant.name, variant.why, "yes" if variant.trained else "no", *numbers_of(result)]


def _rows(ablation: Ablation, results: Sequence[VariantResult]) -> Iterator[list[object]]:
    for result in results:
        for training, costs in zip(result.bundles, result.final.tolist(), strict=True):
            for world, cost in zip(ablation.worlds, costs, strict=True):
                yield [result.variant.name, training.bundle_id, world, cost]


def numbers_of(result: VariantResult) -> tuple[str, str, str, str, str]:
    """Mean, deviation over seeds, difference from the base, its interval, and the verdict."""
    mean, _, _ = result.mean
    deviation = "" if result.deviation is None else f"{result.deviation:.3f}"
    if result.against_base is None:
        return f"{mean:.3f}", deviation, "", "", ""
    difference, low, high = result.against_base.difference
    return (
        f"{mean:.3f}", deviation, f"{difference:+.3f}", f"{low:+.3f} to {high:+.3f}",
        result.verdict or "",
    )  # fmt: skip
