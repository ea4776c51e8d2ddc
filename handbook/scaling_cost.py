"""`python -m handbook.scaling_cost FOLDER...`: coverage cost over team size, by transport.

Of evaluations with `--transport`: docs/scaling-cost.png, and the table of docs/scaling.md to print.
"""

import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lpac.analysis import style

IDEAL = "nothing lost or late"


@dataclass(frozen=True, slots=True)
class FlownTeam:
    """Result of a team: the first method's cost over the clairvoyant's, and its 95 % interval.

    `loss` and `delay_s` are what its messages suffered, by the model.
    """

    robots: int
    radio: str
    worlds: int
    cost: float
    low: float
    high: float
    loss: float
    delay_s: float


def teams_of(told: Mapping[str, Any]) -> list[FlownTeam]:
    """Of an evaluation.json: one of each condition that is no other than by its radio."""
    teams = []
    for condition in told["conditions"]:
        scenario, [result, *_] = condition["scenario"], condition["results"]
        radio, link = scenario["radio"], scenario["link"]
        cost, low, high = result["over_clairvoyant"]["ratio_of_means"]
        teams.append(
            FlownTeam(
                robots=scenario["robots"],
                radio=radio["transport"] if radio else IDEAL,
                worlds=told["worlds"],
                cost=cost,
                low=low,
                high=high,
                loss=link["loss"],
                delay_s=link["delay_s"],
            )
        )
    return teams


def table(teams: Sequence[FlownTeam]) -> str:
    """As Markdown: times the clairvoyant; and what was lost, and the mean delay."""
    sizes = sorted({team.robots for team in teams})
    worlds = {team.robots: str(team.worlds) for team in teams}
    lines = [
        ["times the clairvoyant", *(f"{robots} robots" for robots in sizes)],
        ["---"] * (len(sizes) + 1),
        ["worlds", *(worlds[robots] for robots in sizes)],
    ]
    for radio, of_radio in _by_radio(teams).items():
        flown = {team.robots: _cell(team) for team in of_radio}
        lines.append([radio, *(flown.get(robots, "") for robots in sizes)])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def draw(teams: Sequence[FlownTeam], path: Path) -> None:
    """Raises OSError."""
    with style.figure(style.WIDTH_IN / 2.0, 2.6) as figure:
        axes = figure.subplots()
        for (radio, of_radio), (colour, dashes) in zip(
            _by_radio(teams).items(), style.CURVES, strict=False
        ):
            robots = [team.robots for team in of_radio]
            cost = np.array([team.cost for team in of_radio])
            reach = [
                cost - [team.low for team in of_radio], [team.high for team in of_radio] - cost
            ]  # fmt: skip
            axes.errorbar(
                robots, cost, reach, color=colour, ls=dashes, lw=1.3, marker="o", ms=3,
                elinewidth=0.8, label=radio,
            )  # fmt: skip
        axes.axhline(1.0, color=style.FAINT, lw=0.8, zorder=0)
        sizes = sorted({team.robots for team in teams})
        axes.set(xscale="log", xlabel="robots", ylabel="cost at the end over the clairvoyant's")
        axes.set_xticks(sizes, [str(robots) for robots in sizes])
        axes.minorticks_off()
        style.tidy(axes)
        axes.legend(fontsize=7, handlelength=2.8)
        figure.savefig(path)


def _by_radio(teams: Iterable[FlownTeam]) -> dict[str, list[FlownTeam]]:
    """Each by team size."""
    found: dict[str, list[FlownTeam]] = {}
    for team in sorted(teams, key=lambda team: team.robots):
        found.setdefault(team.radio, []).append(team)
    return found


def _cell(team: FlownTeam) -> str:
    if team.radio == IDEAL:
        return f"{team.cost:.2f}"
    return f"{team.cost:.2f} ({100.0 * team.loss:.0f} %, {1e3 * team.delay_s:.0f} ms)"


def main(folders: Sequence[str]) -> None:
    """Draw, and print the table, of the evaluations in these folders."""
    if not folders:
        sys.exit("which folders? python -m handbook.scaling_cost FOLDER...")
    try:
        told = [json.loads((Path(f) / "evaluation.json").read_text()) for f in folders]
    except FileNotFoundError as error:
        sys.exit(f"{error.filename}: there is none; `lpac evaluate --transport --out` writes it")
    flown = [team for one in told for team in teams_of(one)]
    draw(flown, Path("docs/scaling-cost.png"))
    sys.stdout.write(table(flown) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
