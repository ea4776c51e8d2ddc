"""Figures of the measurements, one per experiment."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lpac.analysis import style
from lpac.middleware.kinds import MIDDLEWARES
from lpac.middleware.results import Run, Summary, left_out, summaries

_JITTER = 0.12


def title_of(middleware: str) -> str:
    """Display name of a middleware."""
    known = MIDDLEWARES.get(middleware)
    return middleware if known is None else known.title


def of_restarts(runs: Sequence[Run]) -> Figure:
    """Plot each run as a dot, and each middleware's mean and standard deviation."""
    with style.figure(style.WIDTH_IN, 2.4) as figure:
        panels = figure.subplots(1, 3)
        measures = (
            ("throughput_mbit_s", "throughput (Mbit/s)", 1.0),
            ("delivered", "delivered after a restart (%)", 100.0),
            ("heard_again_p50_s", "heard again after (s)", 1.0),
        )
        of_each = summaries(runs)
        for axes, (measure, label, factor) in zip(panels, measures, strict=True):
            shown = [summary for summary in of_each if measure in summary.measures]
            for place, summary in enumerate(shown):
                colour = _colour(of_each, summary.middleware)
                values = [
                    factor * value
                    for run in runs
                    if run.met
                    and run.middleware == summary.middleware
                    and (value := getattr(run, measure)) is not None
                ]
                spread = summary.measures[measure]
                axes.plot(
                    [place - _JITTER] * len(values), values, ls="", marker="o", ms=2.5,
                    color=colour, alpha=0.6, mew=0,
                )  # fmt: skip
                axes.errorbar(
                    place + _JITTER, factor * spread.mean, factor * (spread.deviation or 0.0),
                    fmt="s", ms=4, color=colour, lw=1.0, capsize=2,
                )  # fmt: skip
            axes.set(ylabel=label, xlim=(-0.6, len(shown) - 0.4))
            _from_zero(axes)
            names = [title_of(summary.middleware).replace(" ", "\n") for summary in shown]
            axes.set_xticks(range(len(shown)), names)
            style.tidy(axes)
        figure.supxlabel(left_out(runs), fontsize=7)
        return figure


def over_robots(runs: Sequence[Run]) -> Figure:
    """Plot throughput and the age of messages over the number of robots."""
    with style.figure(style.WIDTH_IN, 2.9) as figure:
        left, right = figure.subplots(1, 2)
        of_each = summaries(runs)
        for middleware in dict.fromkeys(summary.middleware for summary in of_each):
            own = [summary for summary in of_each if summary.middleware == middleware]
            colour = _colour(of_each, middleware)
            _curve(left, own, "throughput_mbit_s", colour, "-", title_of(middleware))
            if any("age_p50_ms" in summary.measures for summary in own):
                name = title_of(middleware)
                _curve(right, own, "age_p50_ms", colour, "-", f"{name}, median")
                _curve(right, own, "age_p99_ms", colour, style.DASHED, f"{name}, 99 %")
        robots = sorted({summary.robots for summary in of_each})
        for axes, label in ((left, "throughput (Mbit/s)"), (right, "age of messages (ms)")):
            axes.set(xlabel="robots", ylabel=label, xlim=(robots[0] - 0.5, robots[-1] + 0.5))
            axes.set_xticks(robots)
            _from_zero(axes)
            style.tidy(axes)
            if axes.get_legend_handles_labels()[0]:
                axes.legend(
                    loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2, fontsize=7,
                    handlelength=2.8,
                )  # fmt: skip
        figure.supxlabel(left_out(runs), fontsize=7)
        return figure


def _curve(
    axes: Axes, own: Sequence[Summary], measure: str, colour: str, dashes: object, name: str
) -> None:
    points = [(summary.robots, summary.measures[measure]) for summary in own
            if measure in summary.measures]  # fmt: skip
    axes.errorbar(
        [robots for robots, _ in points], [spread.mean for _, spread in points],
        [spread.deviation or 0.0 for _, spread in points],
        color=colour, ls=dashes, lw=1.2, marker="o", ms=2.5, capsize=1.5, label=name,
    )  # fmt: skip


def _from_zero(axes: Axes) -> None:
    axes.set_ylim(0.0, 1.1 * axes.get_ylim()[1])


def _colour(of_each: Sequence[Summary], middleware: str) -> str:
    names = list(dict.fromkeys(summary.middleware for summary in of_each))
    return style.CURVES[names.index(middleware)][0]
