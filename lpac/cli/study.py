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
from lpac.cli.options import AsJson, Px4, Ray, existing, folder_lock, pool
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
        Path, typer.Argument(callback=existing, help="The study: see examples/study.toml.")
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
        from edge.core.counted import counted

        caveat = "if you select by these results, it is no longer a test set"
        typer.echo(f"the test set was used, {counted(opened['worlds'], 'world')}: {caveat}")


def fly_together(tasks: Sequence[StudyTask], folder: Path, ray: str | None) -> "list[Report]":
    """Fly studies, each flight once, and write their reports; `folder` stores the flights."""
    from lpac.study.run import run_together

    # Only now: invalid options are reported first, and workers are forked without matplotlib.
    cores = pool(ray)
    folder.mkdir(parents=True, exist_ok=True)
    by_name = {task.name: task for task in tasks}
    studies = {name: task.study for name, task in by_name.items()}
    flown, reports = {}, {}
    with folder_lock("the study", folder), progress_counter("flights") as on_progress:
        for name, done in run_together(studies, cores, folder, on_progress):
            # Draw while the others fly.
            flown[name], reports[name] = done, _write_report(by_name[name], done)
    for name, task in by_name.items():
        if "worst" in task.study.figures:
            from lpac.study.summary import draw_worst

            with progress_counter("pictures of the worst worlds") as on_progress:
                draw_worst(task.study, flown[name].results, task.folder, cores, on_progress)
    return [reports[name] for name in by_name]


def _write_report(task: StudyTask, flown: "Flown") -> "Report":
    """Write a study's report to its folder."""
    from lpac.study.provenance import made_by_study
    from lpac.study.summary import report_of

    study, folder = task.study, task.folder
    made_by = made_by_study(task.command or shlex.join(sys.argv[1:]), study)
    further = {"test_set_opened": _test_set_use(study), **task.further}
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
def progress_counter(what: str) -> "Iterator[Callable[..., None]]":
    """Progress on stderr, from calls with the numbers done and planned, and perhaps a remark."""
    with progress_of(what) as progress:
        task = progress.add_task("", total=None)

        def on_progress(done: int, planned: int, remark: str = "") -> None:
            progress.update(task, completed=done, total=planned, description=remark)

        yield on_progress


def _test_set_use(study: "Study") -> dict[str, Any] | None:
    """Use of the test set: date, bundles and number of worlds; None for other sets."""
    if study.world_set != "test":
        return None
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "bundle_ids": [t.bundle_id for method in study.methods for t in method.trainings],
        "worlds": study.worlds,
    }
