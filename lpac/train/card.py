"""What came of a run, for people: a model card, with its figures."""

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
from lpac.sim.baselines import BaselineName
from lpac.study.flights import records_of
from lpac.study.study import Method
from lpac.train.config import TrainingConfig
from lpac.train.files import write_atomically
from lpac.train.fit import EpochLoss
from lpac.train.select import ClosedLoopCost, JudgedCandidate, flights_of, policy_of
from lpac.train.task import CLAIRVOYANT


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelCard:
    """All that the card tells; `shards` are the data's facts by name, hours of one machine."""

    config: TrainingConfig
    expert: str
    digest: str
    bundle_id: str
    best: JudgedCandidate
    judged: Sequence[JudgedCandidate]
    losses: Sequence[EpochLoss]
    baselines: Mapping[BaselineName, ClosedLoopCost]
    int8: ClosedLoopCost
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
    """README.md and figures/ in the folder; `bundle`, at `path`, is what was judged.

    Raises ValueError, OSError.
    """
    figures = folder / "figures"
    style.save(_losses(card), figures / "losses")
    style.save(_costs(card), figures / "costs")
    if CLAIRVOYANT in card.baselines:
        _write_worlds(card, figures, bundle, path)
    write_atomically(folder / "README.md", _text(card).encode())


def _write_worlds(card: ModelCard, figures: Path, bundle: Bundle, path: Path) -> None:
    """How the policy covered two of them, beside who knows all."""
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
    """The loss of each epoch, one after another; lines where a round begins."""
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
            xlabel="epoch; a line where a DAgger round begins",
            ylabel="loss / variance of actions",
            ylim=(0.0, None),
        )
        tidy(axes)
        return figure


def _costs(card: ModelCard) -> Figure:
    """How each candidate flew."""
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


def _text(card: ModelCard) -> str:
    config, best = card.config, card.best
    data, select, dagger = config.data, config.select, config.dagger
    name = config.export.name
    flown = sum(facts["flights"] for facts in card.shards.values())
    states = sum(facts["states"] for facts in card.shards.values())
    robots = sum(facts["robots"] for facts in card.shards.values())
    shown = """
The first validation world, and the worst:

![first](figures/first-world.png)
![worst](figures/worst-world.png)
"""
    rows = [f"| **{name}** | {_row(best.cost)} |"]
    rows += [f"| {name}, with int8 payloads | {_row(card.int8)} |"]
    rows += [f"| {each} | {_row(cost)} |" for each, cost in card.baselines.items()]
    trained = ", ".join(
        f"{_least_most(worlds.robots)} robots in {_least_most(worlds.world_size)} units, range "
        f"{_least_most(worlds.communication_range)}"
        for worlds in data.worlds
    )
    begun = config.fit.begin_with
    begins = f"It began with `{begun}`'s weights." if begun else "It began with random weights."
    judged = (
        f"`lpac evaluate {name}` on others shows"
        if CLAIRVOYANT in card.baselines
        else ("only others show")
    )
    return f"""# {name}

A policy of the family `{config.network.get("family", "lpac")}`, bundle `{card.bundle_id}`.
Licence: {config.export.licence}. `{name}.pt` is the checkpoint, `{name}/` the bundle,
`config.toml` what both were made of (digest `{card.digest}`).

## Data

{states} states of swarms, {robots} of robots, from {flown} flights over worlds of the training set,
seed {config.seed}; the expert is {card.expert}. In round 0 it flew, then the policy
in {dagger.rounds} DAgger rounds. Worlds: {trained}. Flown at
{data.scale.env_scale * data.scale.velocity_scale:g} times the policy's velocities.

## Training

{begins} {len(card.losses)} epochs in all, on {card.device}; the loss came to
{card.losses[-1].loss:.3f} of the variance of round 0's actions. Hours:
{card.generate_hours:.2f} of CPU to make the data, {card.fit_hours:.2f} to fit,
{card.select_hours:.2f} to select. Versions:
{", ".join(f"{each} {number}" for each, number in card.versions.items())}.

![losses](figures/losses.png)

## Results

Chosen among {len(card.judged)} candidates by the mean cost over {select.worlds} validation worlds
({", ".join(select.set_ups)}; {select.duration_s:g} s; {100.0 * select.loss:g} % of messages lost):
round {best.candidate.round}, epoch {best.candidate.epoch}. Cost at the end over that at the start:

| | mean | p90 | worst |
| --- | --- | --- | --- |
{chr(10).join(rows)}

![costs](figures/costs.png)
{shown if CLAIRVOYANT in card.baselines else ""}
## Limits

It was chosen by these worlds, so they flatter it: {judged} how good
it is. One training seed says nothing about a method. Point robots flew: none of this was measured
on vehicles. Numbers of robots, ranges and worlds other than those above are untried.
"""


def _row(cost: ClosedLoopCost) -> str:
    return f"{cost.mean:.3f} | {cost.p90:.3f} | {cost.worst:.3f}"


def _least_most(values: Sequence[float]) -> str:
    least, most = values
    return f"{least:g}" if least == most else f"{least:g} to {most:g}"
