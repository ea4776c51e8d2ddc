"""Model card of a run, with its figures."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from edge.policy.bundle import Bundle
from lpac.analysis import style
from lpac.analysis.figures import snapshots_and_costs
from lpac.analysis.style import WIDTH_IN, tidy
from lpac.analysis.template import render
from lpac.sim.baselines import BaselineName
from lpac.study.flights import records_of
from lpac.study.study import Method
from lpac.train.config import TrainingConfig
from lpac.train.files import write_atomically
from lpac.train.fit import EpochLoss
from lpac.train.select import ClosedLoopCost, JudgedCandidate, MissionCost, flights_of, policy_of
from lpac.train.task import CLAIRVOYANT


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelCard:
    """Contents of the card. `shards` are the facts of each; hours are those of one machine.

    `over_mission` has the policy's own costs under the name "".
    """

    config: TrainingConfig
    expert: str
    digest: str
    bundle_id: str
    best: JudgedCandidate
    judged: Sequence[JudgedCandidate]
    losses: Sequence[EpochLoss]
    baselines: Mapping[BaselineName, ClosedLoopCost]
    int8: ClosedLoopCost
    over_mission: Mapping[str, MissionCost]
    shards: Mapping[str, Mapping[str, Any]]
    fit_hours: float
    select_hours: float
    device: str
    versions: Mapping[str, str]

    @property
    def generate_hours(self) -> float:
        """CPU hours of all processes."""
        return float(sum(facts["cpu_s"] for facts in self.shards.values())) / 3600.0


def write_card(card: ModelCard, folder: Path, bundle: Bundle, path: Path) -> None:
    """Write README.md and figures/ into the folder; `bundle`, at `path`, is the evaluated one.

    Raises ValueError, OSError.
    """
    figures = folder / "figures"
    style.save(_losses(card), figures / "losses")
    style.save(_costs(card), figures / "costs")
    if CLAIRVOYANT in card.baselines:
        _write_worlds(card, figures, bundle, path)
    text = render("lpac.train", "card.md", card=card, clairvoyant=CLAIRVOYANT)
    write_atomically(folder / "README.md", text.encode())


def _write_worlds(card: ModelCard, figures: Path, bundle: Bundle, path: Path) -> None:
    """Draw two worlds, the first and the worst, flown by the policy and by ClairvoyantCVT."""
    select = card.config.select
    flights = flights_of(select, policy_of(path, bundle), path)
    clairvoyant = flights_of(select, Method.of(CLAIRVOYANT), path)
    for name, index in (("first", 0), ("worst", card.best.cost.worst_flight)):
        flown = {
            "lpac": records_of((flights[index],))[0][1],
            CLAIRVOYANT: records_of((clairvoyant[index],))[0][1],
        }
        style.save(snapshots_and_costs(flown), figures / f"{name}-world")


def _losses(card: ModelCard) -> Figure:
    """The loss of each epoch; vertical lines where a round begins."""
    with style.figure(WIDTH_IN, 2.4) as figure:
        axes = figure.subplots()
        rounds = [loss.round for loss in card.losses]
        axes.plot(
            np.arange(1, len(rounds) + 1), [loss.loss for loss in card.losses], color=style.BLUE,
            marker=".", lw=1.2,
        )  # fmt: skip
        for place in np.flatnonzero(np.diff(rounds)) + 1.5:
            axes.axvline(place, color=style.FAINT, lw=0.8, zorder=0)
        axes.set(
            xlabel="epoch; vertical lines: start of a DAgger round",
            ylabel="loss / variance of actions",
            ylim=(0.0, None),
        )
        tidy(axes)
        return figure


def _costs(card: ModelCard) -> Figure:
    """The closed-loop cost of each candidate."""
    with style.figure(WIDTH_IN, 2.8) as figure:
        axes = figure.subplots()
        places = np.arange(len(card.judged))
        for name, colour, dashes in (
            ("mean", style.BLUE, "-"),
            ("p90", style.SKY, "--"),
            ("worst", style.VERMILLION, "-."),
        ):
            values = [getattr(each.cost, name) for each in card.judged]
            axes.plot(places, values, color=colour, ls=dashes, marker=".", lw=1.2, label=name)
        greys = (style.INK, style.GREY, style.FAINT)
        for baseline, grey in zip(card.baselines, greys, strict=False):
            axes.axhline(
                card.baselines[baseline].mean, color=grey, lw=0.8, ls=":", label=f"{baseline}, mean"
            )
        best = list(card.judged).index(card.best)
        axes.plot([best], [card.best.cost.mean], "o", mfc="none", color=style.BLACK, label="chosen")
        labels = [f"{each.candidate.round}.{each.candidate.epoch}" for each in card.judged]
        axes.set_xticks(places, labels, rotation=90 if len(labels) > 12 else 0)
        axes.set(
            xlabel="candidate: DAgger round . epoch", ylabel="cost at the end / at the start",
            ylim=(0.0, None),
        )  # fmt: skip
        tidy(axes)
        figure.legend(loc="outside right center", fontsize=7)
        return figure
