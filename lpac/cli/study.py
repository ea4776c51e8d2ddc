"""`lpac study`: an experiment of one's own, as a TOML file."""

import json
import shlex
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lpac.cli.apps import new_app
from lpac.cli.options import AsJson, Px4, Ray, folder_lock, found, pool
from lpac.cli.printing import print_table, progress_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from lpac.study.report import Report
    from lpac.study.study import Study

app = new_app()

_OUT = Path("out/study")


@app.command()
def study(
    *,
    file: Annotated[
        Path, typer.Argument(callback=found, help="The study: see examples/study.toml.")
    ],
    px4: Px4 = None,
    ray: Ray = None,
    as_json: AsJson = False,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for figures, data, README.md, and what was flown; out/study and "
            "the file's name if none."
        ),
    ] = None,
) -> None:
    """Fly an experiment of yours, from a TOML file: policies over worlds, or faults in flight."""
    from lpac.study.file import read_study, read_toml

    if "faults" in read_toml(file):
        from lpac.cli.drill import fly_faults
        from lpac.study.drills import read_drill

        fly_faults(read_drill(file), out or _OUT / file.stem, px4, ray, as_json=as_json)
        return
    fly_study(read_study(file, px4), file.stem, out or _OUT / file.stem, ray, as_json=as_json)


def fly_study(
    study: "Study",
    name: str,
    folder: Path,
    ray: str | None,
    *,
    as_json: bool,
    command: str | None = None,
    compared: bool = False,
    further: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Fly a study, write its report, and print it; gives its JSON, which `further` is put into."""
    from lpac.study.provenance import made_by_study
    from lpac.study.run import run_with_records

    # A worker process that draws nothing does not load what draws, and a mistake is told by now.
    cores = pool(ray)
    folder.mkdir(parents=True, exist_ok=True)
    with folder_lock("the study", folder), telling("flights") as tell:
        flown = run_with_records(study, cores, folder, tell)
    from lpac.study.summary import draw_worst, report_of, sections_of

    sections = sections_of(study, flown, folder)
    made_by = made_by_study(command or shlex.join(sys.argv[1:]), study)
    report = report_of(name, study, flown.results, sections, folder, made_by, compared=compared)
    report = replace(
        report, told={**report.told, "test_set_opened": _opened(study), **(further or {})}
    )
    told = report.write(folder)
    if "worst" in study.figures:
        with telling("pictures of the worst worlds") as tell:
            draw_worst(study, flown.results, folder, cores, tell)
    if as_json:
        typer.echo(json.dumps(told, indent=2))
        return told
    show_report(report, folder)
    if (opened := told["test_set_opened"]) is not None:
        beside = "if you choose by this, it is no test set any more"
        typer.echo(f"the test set was opened, {opened['worlds']} worlds of it: {beside}")
    return told


def show_report(report: "Report", folder: Path) -> None:
    """The tables of a report on the terminal."""
    for table in report.tables:
        typer.echo(f"{table.title}\n" if table.title else "")
        print_table(table.headings, table.rows, right=table.headings[1:] if table.title else ())
        typer.echo(f"\n{table.note}\n" if table.note else "")
    if report.legend:
        typer.echo(f"{report.legend}\n")
    figures = ", and figures" if report.figures else ""
    typer.echo(f"see {folder}: README.md, {report.name}.json{figures}")


@contextmanager
def telling(what: str) -> "Iterator[Callable[..., None]]":
    """How far it is, as `tell(done, of)` or `tell(done, of, said)` says."""
    with progress_of(what) as progress:
        task = progress.add_task("", total=None)

        def tell(done: int, of: int, said: str = "") -> None:
            progress.update(task, completed=done, total=of, description=said)

        yield tell


def _opened(study: "Study") -> dict[str, Any] | None:
    """Of the test set: by whom, when, and how many worlds of it. None if another was looked at."""
    if study.world_set != "test":
        return None
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "bundle_ids": [t.bundle_id for method in study.methods for t in method.trainings],
        "worlds": study.worlds,
    }
