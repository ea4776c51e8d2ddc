"""What a study leaves in its folder: figures, NAME.json, NAME.csv, and README.md."""

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from lpac.analysis.template import render


class Table(NamedTuple):
    """A table with a row of headings; `title` stands above it, `note` below."""

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str = ""
    note: str = ""


class Picture(NamedTuple):
    """A figure in the report's folder, and what it shows."""

    file: str
    caption: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Report:
    """What is told of an experiment.

    The `legend` explains all tables. `told` is for scripts, `rows` are the CSV's, its heading
    first. `flown` says how it was flown, `made_by` what made it: command, policies, versions.
    `beside` says, in Markdown, what else is in the folder.
    """

    name: str
    title: str
    text: str
    told: Mapping[str, Any]
    rows: Sequence[Sequence[object]]
    tables: Sequence[Table]
    figures: Sequence[Picture]
    flown: str
    legend: str = ""
    beside: str = ""
    made_by: Mapping[str, str]

    @property
    def document(self) -> dict[str, Any]:
        """The JSON."""
        return {**self.told, "flown": self.flown, "made_by": dict(self.made_by)}

    def write(self, folder: Path) -> dict[str, Any]:
        """NAME.json, NAME.csv and README.md; gives the JSON. Raises OSError."""
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{self.name}.json").write_text(json.dumps(self.document, indent=2) + "\n")
        write_csv(self.rows, folder / f"{self.name}.csv")
        told = {name: getattr(self, name) for name in self.__slots__}
        (folder / "README.md").write_text(render("lpac.study", "report.md", **told))
        return self.document


def write_csv(rows: Sequence[Sequence[object]], path: Path) -> None:
    """Raises OSError."""
    with path.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)
