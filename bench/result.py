"""Results of benches: printing and files."""

import json
import os
import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import typer

from lpac.cli.printing import print_table

_PACKAGES = ("numpy", "onnxruntime", "torch", "torch-geometric")


@dataclass(frozen=True, slots=True)
class Target:
    """A goal for a figure."""

    what: str
    measured: float
    limit: float
    at_least: bool

    @property
    def met(self) -> bool:
        """Whether the figure reaches the goal."""
        return self.measured >= self.limit if self.at_least else self.measured <= self.limit


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of text below their column headings."""

    title: str
    columns: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]


@dataclass(frozen=True, slots=True)
class Result:
    """Result of a bench: `figures` for the file, `tables` for people, `targets` for both."""

    name: str
    figures: dict[str, Any]
    tables: list[Table]
    targets: list[Target]
    notes: list[str] = field(default_factory=list)

    def as_json(self) -> dict[str, Any]:
        """The content of the file."""
        return {
            "bench": self.name,
            "machine": _machine(),
            "figures": self.figures,
            "targets": [asdict(target) | {"met": target.met} for target in self.targets],
            "notes": self.notes,
        }

    def show(self) -> None:
        """Print tables and targets."""
        targets = [
            (
                target.what,
                f"{target.measured:.3g}",
                f"{'at least' if target.at_least else 'at most'} {target.limit:.3g}",
                "met" if target.met else "MISSED",
            )
            for target in self.targets
        ]
        columns = (f"{self.name}: targets", "measured", "wanted", "")
        for table in (*self.tables, *([Table("", columns, targets)] if targets else [])):
            typer.echo(table.title)
            print_table(table.columns, table.rows, table.columns[1:])
            typer.echo()
        for note in self.notes:
            typer.echo(note)

    def write(self, folder: Path) -> None:
        """Write `folder`/<name>.json."""
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{self.name}.json").write_text(json.dumps(self.as_json(), indent=2) + "\n")


def progress(text: str) -> None:
    """Print a progress message."""
    typer.echo(text, err=True)


def _machine() -> dict[str, Any]:
    models = [
        line.partition(":")[2].strip()
        for line in Path("/proc/cpuinfo").read_text().splitlines()
        if line.startswith("model name")
    ]
    return {
        "processor": models[0] if models else platform.machine(),
        "cores": os.cpu_count(),
        "load_average": os.getloadavg()[0],
        "python": platform.python_version(),
        "packages": {package: version(package) for package in _PACKAGES},
    }
