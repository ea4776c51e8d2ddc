"""`python -m handbook.scaling_cost FOLDER...`: coverage cost over team size, by transport.

Prints a table of docs/network.md from evaluations with `--transport`.
"""

import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

IDEAL = "nothing lost or late"


@dataclass(frozen=True, slots=True)
class FlownTeam:
    """Result of a team: the first method's cost over the clairvoyant's.

    `loss` and `delay_s` are those of its messages, by the model.
    """

    robots: int
    radio: str
    worlds: int
    cost: float
    loss: float
    delay_s: float


def teams_of(evaluation: Mapping[str, Any]) -> list[FlownTeam]:
    """Teams in an evaluation.json; conditions differ only in their radio."""
    teams = []
    for condition in evaluation["conditions"]:
        scenario, [result, *_] = condition["scenario"], condition["results"]
        radio, link = scenario["radio"], scenario["link"]
        cost, *_ = result["over_clairvoyant"]["ratio_of_means"]
        teams.append(
            FlownTeam(
                robots=scenario["robots"],
                radio=radio["transport"] if radio else IDEAL,
                worlds=evaluation["worlds"],
                cost=cost,
                loss=link["loss"],
                delay_s=link["delay_s"],
            )
        )
    return teams


def table(teams: Sequence[FlownTeam]) -> str:
    """The costs over the clairvoyant's, losses and mean delays, as Markdown."""
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


def _by_radio(teams: Iterable[FlownTeam]) -> dict[str, list[FlownTeam]]:
    """Teams by radio, sorted by size."""
    found: dict[str, list[FlownTeam]] = {}
    for team in sorted(teams, key=lambda team: team.robots):
        found.setdefault(team.radio, []).append(team)
    return found


def _cell(team: FlownTeam) -> str:
    if team.radio == IDEAL:
        return f"{team.cost:.2f}"
    return f"{team.cost:.2f} ({100.0 * team.loss:.0f} %, {1e3 * team.delay_s:.0f} ms)"


def main(folders: Sequence[str]) -> None:
    """Print the table of the evaluations in these folders."""
    if not folders:
        sys.exit("which folders? python -m handbook.scaling_cost FOLDER...")
    try:
        evaluation = [json.loads((Path(f) / "evaluation.json").read_text()) for f in folders]
    except FileNotFoundError as error:
        sys.exit(f"{error.filename}: no such file; `lpac evaluate --transport --out` writes it")
    sys.stdout.write(table([team for one in evaluation for team in teams_of(one)]) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
