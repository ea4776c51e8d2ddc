"""What the paper's experiments show, where no figure of a flight shows it."""

from collections.abc import Mapping
from itertools import cycle

import numpy as np
from matplotlib.figure import Figure

from lpac.analysis import style
from lpac.analysis.flight import FlightRecord
from lpac.analysis.style import MANY_CURVES, WIDTH_IN, tidy
from lpac.paper.experiments import PerturbedFlight


def costs_by_world(records: Mapping[str, Mapping[str, FlightRecord]]) -> Figure:
    """A panel for each world, a curve for each who flew; thin where vehicles truly were."""
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
                        label=f"{name}, in truth",
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
    """Cost, thin in truth, neighbours and speeds over time; shaded while a robot is away."""
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
            ("a robot that is taken once", style.VERMILLION, 1.5),
            ("another robot", style.FAINT, 1.5),
        ]
        if record.truth:
            legend.insert(1, ("cost, in truth", style.BLACK, 0.5))
        handles = [cost.plot([], [], color=colour, lw=lw)[0] for _, colour, lw in legend]
        figure.legend(
            handles, [label for label, _, _ in legend], loc="outside upper center",
            ncols=len(legend),
        )  # fmt: skip
        return figure
