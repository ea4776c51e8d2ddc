"""What every experiment leaves beside its figures: data as JSON and CSV, and README.md."""

import csv
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

MADE_FOR_ALL = "made_by.json"


def write_experiment(
    name: str,
    told: Mapping[str, Any],
    rows: Sequence[Sequence[object]],
    text: str,
    folder: Path,
    flown: str,
    made_by: Mapping[str, str],
) -> dict[str, Any]:
    """NAME.json, NAME.csv and README.md; gives the JSON.

    `rows` are the CSV's, its heading first. `flown` says how it was flown, `made_by` what made it:
    command, policy, versions. Raises OSError.
    """
    document = {**told, "flown": flown, "made_by": dict(made_by)}
    folder.mkdir(parents=True, exist_ok=True)
    # `lpac paper all` knows by this what it made itself, and need not make again.
    (folder / MADE_FOR_ALL).unlink(missing_ok=True)
    (folder / f"{name}.json").write_text(json.dumps(document, indent=2) + "\n")
    write_csv(rows, folder / f"{name}.csv")
    made = "; ".join(f"{what}: `{value}`" for what, value in made_by.items())
    (folder / "README.md").write_text(
        f"{text}\n`{name}.csv` and `{name}.json` hold all the data. {made}.\n"
    )
    return document


def write_csv(rows: Sequence[Sequence[object]], path: Path) -> None:
    """Raises OSError."""
    written = io.StringIO()
    csv.writer(written, lineterminator="\n").writerows(rows)
    path.write_text(written.getvalue())


def table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of README.md."""
    lines = [headings, ["---"] * len(headings), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
