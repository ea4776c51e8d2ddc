"""`lpac study`: your own experiment from a TOML file."""

import json
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
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
    from lpac.study.run import Flown
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
            help="Folder for figures, data, README.md and flights; out/study and the file's name "
            "if none."
        ),
    ] = None,
) -> None:
    """Fly your own experiment from a TOML file: policies over worlds, or faults in flight."""
    from edge.core.toml import read_toml
    from lpac.study.file import read_study

    if "faults" in read_toml(file):
        from lpac.cli.drill import fly_faults
        from lpac.study.drills import read_drill

        fly_faults(read_drill(file), out or _OUT / file.stem, px4, ray, as_json=as_json)
        return
    read = read_study(file, px4)
    if px4 is not None and all(condition.engine != "px4" for condition in read.conditions):
        raise ValueError(f"--px4 does nothing: no condition of {file} has engine = 'px4'")
    task = StudyTask(name=file.stem, study=read, folder=out or _OUT / file.stem)
    fly_study(task, ray, as_json=as_json)


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyTask:
    """A study to fly, with its report in `folder` and `further` in the report's JSON.

    `command` is the command line in the report, the typed one if empty. With `compared` the report
    compares the first method with the second.
    """

    name: str
    study: "Study"
    folder: Path
    command: str = ""
    compared: bool = False
    further: Mapping[str, Any] = field(default_factory=dict)


def fly_study(task: StudyTask, ray: str | None, *, as_json: bool) -> None:
    """Fly a study, write its report, and print it."""
    [report] = fly_together([task], task.folder, ray)
    show_report(report, task.folder, as_json=as_json)
    if not as_json and (opened := report.data["test_set_opened"]) is not None:
        beside = "if you choose by this, it is no test set any more"
        typer.echo(f"the test set was opened, {opened['worlds']} worlds of it: {beside}")


def fly_together(tasks: Sequence[StudyTask], folder: Path, ray: str | None) -> "list[Report]":
    """Fly studies, each flight once, and write their reports; `folder` stores the flights."""
    from lpac.study.run import run_together

    # Only now: mistakes are reported by then, and workers are forked without matplotlib.
    cores = pool(ray)
    folder.mkdir(parents=True, exist_ok=True)
    by_name = {task.name: task for task in tasks}
    studies = {name: task.study for name, task in by_name.items()}
    flown, reports = {}, {}
    with folder_lock("the study", folder), telling("flights") as tell:
        for name, its in run_together(studies, cores, folder, tell):
            # Draw while the others fly.
            flown[name], reports[name] = its, _written(by_name[name], its)
    for name, task in by_name.items():
        if "worst" in task.study.figures:
            from lpac.study.summary import draw_worst

            with telling("pictures of the worst worlds") as tell:
                draw_worst(task.study, flown[name].results, task.folder, cores, tell)
    return [reports[name] for name in by_name]


def _written(task: StudyTask, flown: "Flown") -> "Report":
    """Write the report to its folder."""
    from lpac.study.provenance import made_by_study
    from lpac.study.summary import report_of

    study, folder = task.study, task.folder
    made_by = made_by_study(task.command or shlex.join(sys.argv[1:]), study)
    further = {"test_set_opened": _opened(study), **task.further}
    report = report_of(task.name, study, flown, folder, made_by, further, compared=task.compared)
    report.write(folder)
    return report


def show_report(report: "Report", folder: Path, *, as_json: bool = False) -> None:
    """Print a report: its tables, or its JSON."""
    if as_json:
        typer.echo(json.dumps(report.document, indent=2))
        return
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
    """Progress on stderr, from `tell(done, of)` or `tell(done, of, said)`."""
    with progress_of(what) as progress:
        task = progress.add_task("", total=None)

        def tell(done: int, of: int, said: str = "") -> None:
            progress.update(task, completed=done, total=of, description=said)

        yield tell


def _opened(study: "Study") -> dict[str, Any] | None:
    """Use of the test set: date, bundles and number of worlds; None for other sets."""
    if study.world_set != "test":
        return None
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "bundle_ids": [t.bundle_id for method in study.methods for t in method.trainings],
        "worlds": study.worlds,
    }
