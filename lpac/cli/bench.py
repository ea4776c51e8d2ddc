"""`lpac bench`: measurements on your own machines and networks."""

import json
import os
import platform
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from msgspec import Meta

from lpac.cli.apps import new_app
from lpac.cli.fields import options_of
from lpac.cli.options import AsJson
from lpac.cli.printing import print_table, progress_of

if TYPE_CHECKING:
    from lpac.middleware.measure import Plan
    from lpac.middleware.places import NetworkPlace
    from lpac.middleware.results import Experiment, Run, Spread, Summary

app = new_app(
    "bench", "Measure the bandwidth that the robots' programs leave on this machine's network."
)

_OUT = Path("out/bench/network")
# Robots, repetitions, and seconds: the paper's for restarts, our own for the curves.
_RESTARTS = (3, 10, 60.0)
_ROBOTS = (10, 3, 10.0)


@app.callback()
def bench() -> None:
    """Make typer keep `network` as a subcommand."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkOptions:
    """Options: experiments, repetitions, and places."""

    experiments: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[EXPERIMENT]...",
            help="restarts: throughput while programs restart; robots: throughput and age of "
            "messages over the number of robots; both if none is given.",
        ),
    ] = None
    middlewares: Annotated[
        list[str] | None,
        typer.Option(
            "--middleware",
            metavar="NAME",
            help="zenoh, cyclonedds, and fastdds where it is installed, if not given; may be "
            "repeated. The stream without any programs is always measured, too.",
        ),
    ] = None
    robots: Annotated[
        int | None,
        typer.Option(
            "--robots", "-n",
            help="Number of robots that restart (3 if not given), and maximum for the curves (10).",
        ),
    ] = None  # fmt: skip
    repetitions: Annotated[
        Annotated[int, Meta(ge=1)] | None,
        "If not given, 10 with restarts, 3 per point of a curve.",
    ] = None
    seconds: Annotated[
        Annotated[float, Meta(ge=1.0)] | None,
        "Length of a run: 60 with restarts, else 10, by default.",
    ] = None
    namespaces: Annotated[
        str | None,
        typer.Option(
            metavar="NAME,NAME...",
            help="Network namespaces, one for each robot, two at least; else this machine's "
            "loopback, which has no radio.",
        ),
    ] = None
    as_json: AsJson = False
    out: Annotated[Path, "Folder for network.json and figures."] = _OUT


@app.command()
@options_of(NetworkOptions)
def network(options: NetworkOptions) -> None:
    """Run the paper's network experiments: a bulk stream's throughput beside the programs."""
    from lpac.middleware.results import as_json as to_json
    from lpac.train.files import write_atomically

    chosen = _checked(options.middlewares)
    plans = [_plan(experiment, chosen, options) for experiment in _experiments(options.experiments)]
    places = _places(options.namespaces, max(plan.places for plan in plans))
    where = _measured_on(places, plans[0])
    runs: list[Run] = []
    with closing(_measure(plans, places)) as measured:
        for run in measured:
            runs.append(run)
            # An interrupted measurement keeps its results.
            text = json.dumps(to_json(where, runs), indent=2)
            write_atomically(options.out / "network.json", f"{text}\n".encode())
    _draw(runs, options.out)
    if options.as_json:
        typer.echo(json.dumps(to_json(where, runs), indent=2))
    else:
        _show(where, runs, options.out)


def _experiments(given: Sequence[str] | None) -> list["Experiment"]:
    from lpac.middleware.results import EXPERIMENTS

    for name in given or ():
        if name not in EXPERIMENTS:
            raise ValueError(f"{name}: an experiment is one of {', '.join(EXPERIMENTS)}")
    return [known for known in EXPERIMENTS if not given or known in given]


def _checked(given: Sequence[str] | None) -> tuple[str, ...]:
    """The chosen middlewares, and "nothing". Raises ValueError if one is not installed."""
    from lpac.middleware.kinds import MIDDLEWARES, NOTHING

    for name in given or ():
        if name not in MIDDLEWARES:
            raise ValueError(f"--middleware {name}: must be one of {', '.join(MIDDLEWARES)}")
    chosen = []
    for name, middleware in MIDDLEWARES.items():
        asked = name in given if given else not middleware.is_optional
        if asked and middleware.version() is None:
            raise ValueError(
                f"{middleware.title} is not installed here: `{middleware.install}`, or measure "
                "without it: --middleware zenoh"
            )
        if asked or (not given and middleware.version() is not None):
            chosen.append(name)
    return (*chosen, NOTHING)


def _plan(
    experiment: "Experiment", middlewares: tuple[str, ...], options: NetworkOptions
) -> "Plan":
    from lpac.middleware.measure import Plan

    robots, repetitions, seconds = _RESTARTS if experiment == "restarts" else _ROBOTS
    fleet = robots if options.robots is None else options.robots
    least = 2 if experiment == "restarts" else 1
    if fleet < least:
        raise ValueError(f"--robots {fleet}: {experiment} needs at least {least}")
    return Plan(
        experiment=experiment,
        middlewares=middlewares,
        robots=(fleet,) if experiment == "restarts" else tuple(range(1, fleet + 1)),
        repetitions=options.repetitions or repetitions,
        seconds=options.seconds or seconds,
    )


def require_namespaces(namespaces: str | None, robots: int | None) -> None:
    """Raise ValueError or OSError if the experiments with `robots` cannot run there."""
    plans = [_plan(each, (), NetworkOptions(robots=robots)) for each in _experiments(None)]
    _places(namespaces, max(plan.places for plan in plans))


def _places(namespaces: str | None, needed: int) -> list["NetworkPlace"]:
    from lpac.middleware.places import LOOPBACK, place_in

    if namespaces is None:
        return [LOOPBACK] * needed
    names = namespaces.split(",")
    if len(names) < needed:
        fewer = (
            f", or measure fewer: `lpac bench network -n {len(names)}`" if len(names) > 1 else ""
        )
        raise ValueError(
            f"--namespaces: {len(names)} given, and {needed} robots need one each: name more{fewer}"
        )
    if len(set(names)) < len(names):
        raise ValueError("--namespaces: one is given twice; each robot needs its own")
    return [place_in(name) for name in names[:needed]]


def _measured_on(places: Sequence["NetworkPlace"], plan: "Plan") -> dict[str, Any]:
    from lpac.middleware.kinds import MIDDLEWARES
    from lpac.middleware.robot import SIZE_BYTES

    names = [place.namespace for place in places]
    return {
        "where": "loopback" if names[0] is None else "namespaces",
        "namespaces": None if names[0] is None else names,
        "message_bytes": SIZE_BYTES,
        "cores": len(os.sched_getaffinity(0)),
        "kernel": platform.release(),
        "python": platform.python_version(),
        "versions": {
            name: middleware.version()
            for name, middleware in MIDDLEWARES.items()
            if name in plan.middlewares
        },
    }


def _measure(
    plans: Sequence["Plan"], places: Sequence["NetworkPlace"]
) -> "Generator[Run, None, None]":
    """Yield each run, with progress on stderr."""
    from lpac.middleware.figures import title_of
    from lpac.middleware.measure import measure

    with progress_of("runs") as progress:
        task = progress.add_task("", total=sum(1 for plan in plans for _ in plan.runs()))

        def on_progress(repetition: int, robots: int, middleware: str) -> None:
            doing = f"robots: {robots}, {title_of(middleware)}, repetition {repetition}"
            progress.update(task, description=doing)

        for plan in plans:
            with closing(measure(plan, places, on_progress)) as runs:
                for run in runs:
                    progress.update(task, advance=1)
                    yield run


def _draw(runs: Sequence["Run"], out: Path) -> None:
    from lpac.analysis import style
    from lpac.middleware.figures import of_restarts, over_robots

    for experiment, drawn in (("restarts", of_restarts), ("robots", over_robots)):
        own = [run for run in runs if run.experiment == experiment]
        if own:
            style.save(drawn(own), out / experiment)


def _show(where: dict[str, Any], runs: Sequence["Run"], out: Path) -> None:
    from lpac.middleware.results import left_out, summaries

    of_each = summaries(runs)
    restarts = [summary for summary in of_each if summary.experiment == "restarts"]
    if restarts:
        seconds = next(run.seconds for run in runs if run.experiment == "restarts")
        typer.echo(
            f"throughput between two of {restarts[0].robots} robots whose programs all restart, "
            f"{seconds:.0f} s; mean and standard deviation\n"
        )
        _print_summaries(_RESTART_COLUMNS, restarts)
    curves = [summary for summary in of_each if summary.experiment == "robots"]
    if curves:
        typer.echo(
            f"{chr(10) if restarts else ''}throughput between two places while the robots' "
            "programs run, and the age of their messages on arrival\n"
        )
        _print_summaries(_CURVE_COLUMNS, curves)
    if where["where"] == "loopback":
        typer.echo(
            "\nmeasured on this machine's loopback, which has no radio: the processors limit the "
            "stream, which takes them from the robots; see --namespaces"
        )
    if left := left_out(runs):
        typer.echo(f"\n{left}")
    typer.echo(_LEGEND)
    names = ", ".join(f"{name} {version}" for name, version in where["versions"].items())
    typer.echo(f"\n{names}; see {out}: network.json and figures")


_LEGEND = (
    "\ndelivered: share of the robots' messages, with restarts in the 10 s after each; heard "
    "after: time from a restart until half of all pairs, and the last, hear each other again; "
    "never: pairs that did not before the next restart; busy: this machine's processors"
)
_DELIVERED = ("delivered, %", lambda each: _number(each.measures.get("delivered"), 100.0))
_THROUGHPUT = ("Mbit/s", lambda each: _number(each.measures["throughput_mbit_s"]))
_BUSY = ("busy, %", lambda each: f"{100.0 * each.measures['processor'].mean:.0f}")
_Columns = tuple[tuple[str, Callable[["Summary"], str]], ...]
_RESTART_COLUMNS: _Columns = (
    _THROUGHPUT, _DELIVERED,
    ("heard after, s", lambda each: _number(each.measures.get("heard_again_p50_s"), digits=2)),
    ("the last, s", lambda each: _number(each.measures.get("heard_again_max_s"), digits=2)),
    ("never, %", lambda each: _number(each.measures.get("never_heard"), 100.0)),
    _BUSY, ("runs", lambda each: str(each.measures["throughput_mbit_s"].runs)),
)  # fmt: skip
_CURVE_COLUMNS: _Columns = (
    ("robots", lambda each: str(each.robots)), _THROUGHPUT,
    ("age p50, ms", lambda each: _number(each.measures.get("age_p50_ms"))),
    ("p99, ms", lambda each: _number(each.measures.get("age_p99_ms"))), _DELIVERED, _BUSY,
)  # fmt: skip


def _print_summaries(columns: _Columns, summaries: "Sequence[Summary]") -> None:
    from lpac.middleware.figures import title_of

    names = [name for name, _ in columns]
    rows = [[title_of(each.middleware), *(cell(each) for _, cell in columns)] for each in summaries]
    print_table(("", *names), rows, names)


def _number(spread: "Spread | None", factor: float = 1.0, digits: int = 1) -> str:
    """Mean, and deviation if there is one."""
    if spread is None:
        return ""
    mean = f"{factor * spread.mean:.{digits}f}"
    if spread.deviation is None:
        return mean
    return f"{mean} ± {factor * spread.deviation:.{digits}f}"
