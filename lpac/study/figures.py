"""Figures of a study."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, NullLocator

from lpac.analysis import style
from lpac.analysis.flight import FlightRecord
from lpac.analysis.statistics import paired_bootstrap, performance_profile, ratio_of_means
from lpac.analysis.style import MANY_CURVES, WIDTH_IN, tidy
from lpac.study.perturbation import PerturbedFlight
from lpac.study.results import FAILS_ABOVE, MethodResult
from lpac.study.study import Condition

_BAND = (0.1, 0.9)
_MOST_RIVALS = 4


def cost_curves(condition: Condition, results: Sequence[MethodResult]) -> Figure:
    """Each method's median cost over time; for policies with the band from 10 % to 90 %."""
    with style.figure(WIDTH_IN, 3.0) as figure:
        axes = figure.subplots()
        for result, (colour, dashes) in _looks(results):
            low, median, high = np.quantile(result.curves, (_BAND[0], 0.5, _BAND[1]), axis=(0, 1))
            if result.method.trained:
                axes.fill_between(result.time_s, low, high, color=colour, alpha=0.12, lw=0)
            axes.plot(
                result.time_s, median, color=colour, ls=dashes, lw=1.3,
                label=f"{median[-1]:.2f}  {result.method.name}",
            )  # fmt: skip
        axes.set(
            xlabel="time (s)", ylabel=r"coverage cost $J(t)\,/\,J(0)$", ylim=(0.0, None),
            xlim=(0.0, results[0].time_s[-1]), title=f"{condition.name}: median over worlds",
        )  # fmt: skip
        tidy(axes)
        handles, labels = axes.get_legend_handles_labels()
        if any(result.method.trained for result in results):
            handles.append(Patch(color=style.FAINT, label="policies: 10 % to 90 % of the worlds"))
            labels.append("policies: 10 % to 90 %")
        figure.legend(
            handles, labels, loc="outside right center", title="$J$ at the end / $J(0)$",
            alignment="left", handlelength=2.8, fontsize=7,
        )  # fmt: skip
        return figure


def distributions(condition: Condition, results: Sequence[MethodResult]) -> Figure:
    """Performance profiles: the share of worlds that end below a cost, in two measures."""
    with style.figure(WIDTH_IN, 3.0) as figure:
        left, right = figure.subplots(1, 2, sharey=True)
        for axes, measure, label in (
            (left, "final", "coverage cost at the end $/\\,J(0)$"),
            (right, "over_clairvoyant", "coverage cost at the end over clairvoyant's"),
        ):
            drawn = [(getattr(result, measure), looks) for result, looks in _looks(results)]
            highest = 1.02 * max(float(np.quantile(values, 0.98)) for values, _ in drawn)
            lowest = 0.98 * min(float(values.min()) for values, _ in drawn)
            thresholds = np.linspace(lowest, highest, 400)
            for values, (colour, dashes) in drawn:
                axes.plot(
                    thresholds, performance_profile(values, thresholds), color=colour, ls=dashes,
                    lw=1.3, drawstyle="steps-post",
                )  # fmt: skip
            axes.set(xlabel=label, xlim=(lowest, highest), ylim=(0.0, 1.02))
            tidy(axes)
        right.axvline(FAILS_ABOVE, color=style.FAINT, lw=0.8, zorder=0)
        left.set_ylabel("share of the worlds below")
        for result, (colour, dashes) in _looks(results):
            left.plot([], [], color=colour, ls=dashes, lw=1.3, label=result.method.name)
        figure.legend(loc="outside lower center", ncols=4, fontsize=7, handlelength=2.8)
        figure.suptitle(condition.name, fontsize=8)
        return figure


def pairs(condition: Condition, results: Sequence[MethodResult]) -> Figure:
    """Final costs of policies against those of the best other methods, world by world."""
    policies = [result for result in results if result.method.trained] or [results[0]]
    others = [result for result in results if not any(result is policy for policy in policies)]
    rivals = sorted(others, key=lambda result: float(result.final.mean()))[:_MOST_RIVALS]
    looks = {id(result): colour for result, (colour, _) in _looks(results)}
    with style.figure(WIDTH_IN, 2.4) as figure:
        panels = figure.subplots(1, max(len(rivals), 1), sharex=True, sharey=True, squeeze=False)[0]
        shown = [*policies, *rivals]
        low = 0.95 * min(float(result.final.min()) for result in shown)
        high = 1.05 * max(float(result.final.max()) for result in shown)
        for axes, rival in zip(panels, rivals, strict=False):
            axes.plot((low, high), (low, high), color=style.FAINT, lw=0.8, zorder=0)
            for policy in policies:
                for number, training in enumerate(policy.final):
                    axes.plot(
                        rival.final.mean(axis=0), training, ls="", marker="o", ms=2.5,
                        color=looks[id(policy)], alpha=0.7, mew=0,
                        label=policy.method.name if number == 0 else None,
                    )  # fmt: skip
            axes.set(xlabel=rival.method.name, xscale="log", yscale="log")
            axes.set(xlim=(low, high), ylim=(low, high), aspect="equal")
            _plain_ticks(axes)
        panels[0].set_ylabel("policy" if len(policies) == 1 else "policies", fontsize=7)
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=7)
        figure.suptitle(
            f"{condition.name}: $J$ at the end $/\\,J(0)$, a dot per world; below the line, the "
            "policy is better", fontsize=8,
        )  # fmt: skip
        return figure


def over_conditions(results: Mapping[Condition, Sequence[MethodResult]]) -> Figure:
    """Mean final cost over clairvoyant's under each condition, with 95 % intervals."""
    with style.figure(WIDTH_IN, 3.2) as figure:
        axes = figure.subplots()
        methods = next(iter(results.values()))
        for place, (first, (colour, _)) in enumerate(_looks(methods)):
            shift = 0.6 * ((place + 0.5) / len(methods) - 0.5)
            for row, of_all in enumerate(results.values()):
                [result] = [one for one in of_all if one.method == first.method]
                value, low, high = paired_bootstrap(
                    result.final, result.clairvoyant, ratio_of_means
                )
                axes.errorbar(
                    row + shift, value, [[value - low], [high - value]], fmt="o", ms=3,
                    color=colour, lw=1.0, label=first.method.name if row == 0 else None,
                )  # fmt: skip
        axes.axhline(1.0, color=style.FAINT, lw=0.8, zorder=0)
        axes.set(ylabel="mean cost at the end\nover clairvoyant's", yscale="log")
        _plain_ticks(axes)
        axes.set_xticks(
            range(len(results)), [condition.name for condition in results], rotation=30, ha="right"
        )
        tidy(axes)
        figure.legend(loc="outside upper center", ncols=4, fontsize=7)
        return figure


def costs_by_world(records: Mapping[str, Mapping[str, FlightRecord]]) -> Figure:
    """A panel for each world, a curve for each method; thin curves are true costs."""
    with style.figure(WIDTH_IN, 2.6) as figure:
        panels = figure.subplots(1, len(records), squeeze=False, sharey=True)[0]
        for axes, (world, of_world) in zip(panels, records.items(), strict=True):
            looks = zip(of_world.items(), cycle(MANY_CURVES), strict=False)
            for (name, record), (colour, dashes) in looks:
                axes.plot(
                    record.curve_time_s, record.normalized, color=colour, ls=dashes, lw=1.2,
                    label=name,
                )  # fmt: skip
                if record.truth:
                    axes.plot(
                        record.curve_time_s, record.normalized_true, color=colour, lw=0.5,
                        label=f"{name}, true",
                    )  # fmt: skip
            axes.set(title=world, xlabel="time (s)")
            tidy(axes)
        panels[0].set(ylabel=r"coverage cost $J(t)\,/\,J(0)$", ylim=(0.0, None))
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(
            handles, labels, loc="outside upper center", ncols=min(len(labels), 5), fontsize=6.5
        )
        return figure


def perturbation(perturbed: PerturbedFlight) -> Figure:
    """Cost (thin: true cost), neighbours and speeds over time; shaded while a robot is away."""
    record, absences = perturbed.record, perturbed.absences
    away = {absence.robot for absence in absences}
    with style.figure(WIDTH_IN, 4.6) as figure:
        cost, neighbours, speed = figure.subplots(3, 1, sharex=True)
        cost.plot(record.curve_time_s, record.normalized, color=style.BLACK, lw=1.3)
        if record.truth:
            cost.plot(record.curve_time_s, record.normalized_true, color=style.BLACK, lw=0.5)
        cost.set(ylabel=r"cost $J\,/\,J(0)$", ylim=(0.0, None))
        for axes, values in ((neighbours, perturbed.neighbours), (speed, perturbed.speed_m_s)):
            for robot, of_robot in zip(record.robots, values.T, strict=True):
                colour = style.VERMILLION if robot.name in away else style.FAINT
                axes.plot(perturbed.time_s, of_robot, color=colour, lw=0.5)
            mean = np.ma.masked_invalid(values).mean(axis=1).filled(np.nan)
            axes.plot(perturbed.time_s, mean, color=style.BLACK, lw=1.3)
        neighbours.set(ylabel="neighbours in range")
        speed.set(ylabel="speed (m/s)", ylim=(0.0, None), xlabel="time (s)",
                  xlim=(0.0, record.duration_s))  # fmt: skip
        for axes in (cost, neighbours, speed):
            for _, from_s, until_s in absences:
                axes.axvspan(from_s, until_s, color=style.NOTHING, zorder=0)
            tidy(axes)
        for robot_name, from_s, until_s in absences:
            middle_s = (from_s + until_s) / 2.0
            cost.annotate(
                f"{robot_name} away", (middle_s, 1.0), xycoords=("data", "axes fraction"),
                ha="center", va="bottom", fontsize=7,
            )  # fmt: skip
        legend = [
            ("cost, or the robots' mean", style.BLACK, 1.5),
            ("a robot that is taken away", style.VERMILLION, 1.5),
            ("another robot", style.FAINT, 1.5),
        ]
        if record.truth:
            legend.insert(1, ("true cost", style.BLACK, 0.5))
        handles = [cost.plot([], [], color=colour, lw=lw)[0] for _, colour, lw in legend]
        figure.legend(
            handles, [label for label, _, _ in legend], loc="outside upper center",
            ncols=len(legend),
        )  # fmt: skip
        return figure


def _plain_ticks(axes: Axes) -> None:
    """Label logarithmic axes with 0.2 instead of 2 x 10^-1."""
    for axis in (axes.xaxis, axes.yaxis):
        if axis.get_scale() == "log":
            axis.set_major_locator(LogLocator(subs=(1.0, 1.5, 2.0, 3.0, 5.0, 7.0)))
            axis.set_major_formatter("{x:g}")
            axis.set_minor_locator(NullLocator())


def _looks(results: Sequence[MethodResult]) -> list[tuple[MethodResult, tuple[str, Any]]]:
    return list(zip(results, cycle(MANY_CURVES), strict=False))
