"""A study's report: figures, NAME.json, NAME.csv, and README.md."""

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from lpac.analysis.template import render


class Table(NamedTuple):
    """A table with a row of headings; `title` is above it, `note` below."""

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str = ""
    note: str = ""


class Picture(NamedTuple):
    """A figure in the report's folder, and its caption."""

    file: str
    caption: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Report:
    """Content of a report.

    `legend` explains all tables. `data` is for the JSON, `rows` for the CSV, with its heading
    first. `flown` describes the engine, `made_by` the provenance: command, policies, versions.
    `beside` describes, in Markdown, other files in the folder.
    """

    name: str
    title: str
    text: str
    data: Mapping[str, Any]
    rows: Sequence[Sequence[object]]
    tables: Sequence[Table]
    figures: Sequence[Picture]
    flown: str
    legend: str = ""
    beside: str = ""
    made_by: Mapping[str, str]

    @property
    def document(self) -> dict[str, Any]:
        """Content of the JSON file."""
        return {**self.data, "flown": self.flown, "made_by": dict(self.made_by)}

    def write(self, folder: Path) -> dict[str, Any]:
        """Write NAME.json, NAME.csv and README.md; returns the JSON. Raises OSError."""
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{self.name}.json").write_text(json.dumps(self.document, indent=2) + "\n")
        write_csv(self.rows, folder / f"{self.name}.csv")
        fields = {name: getattr(self, name) for name in self.__slots__}
        (folder / "README.md").write_text(render("lpac.study", "report.md", **fields))
        return self.document


def write_csv(rows: Sequence[Sequence[object]], path: Path) -> None:
    """Write a CSV file. Raises OSError."""
    with path.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)
