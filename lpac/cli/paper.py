"""`lpac paper`: the paper's experiments, repeated."""

import json
import platform
from contextlib import closing
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lpac.cli.apps import new_app
from lpac.cli.options import DEFAULT_BUNDLE, AsJson, Ray, folder_lock, pool
from lpac.cli.printing import print_table, progress_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lpac.paper.asynchrony import TimingResult

app = new_app()

_OUT = Path("out/paper")
_WORLDS, _QUICK_WORLDS = 50, 4
# Enough to see whether slower or faster is better.
_QUICK_HZ = {"perception_hz": (1.0, 5.0), "policy_hz": (0.5, 2.5, 10.0)}
_QUICK_DELAYS_S = (0.0, 0.8)


@app.callback()
def paper() -> None:
    """Repeat the paper's experiments, and make those that it argues for."""


@app.command("async")
def asynchrony(
    *,
    bundle: Annotated[Path, typer.Option(help="Policy bundle.")] = DEFAULT_BUNDLE,
    worlds: Annotated[
        int | None,
        typer.Option(
            "--worlds",
            "-k",
            help=f"The first so many of the validation set; {_WORLDS} if not "
            f"given, {_QUICK_WORLDS} with --quick.",
        ),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Few rates over few worlds: a minute or two.")
    ] = False,
    ray: Ray = None,
    as_json: AsJson = False,
    out: Annotated[
        Path | None,
        typer.Option(help=f"Folder for figures, data and README.md; {_OUT / 'async'} if none."),
    ] = None,
) -> None:
    """Rates of perception and of messages, in step or not, and late messages: what they cost."""
    from edge.policy.bundle import load_bundle
    from lpac.evaluate.evaluation import TrainedBundle
    from lpac.evaluate.flights import KeptFlights
    from lpac.paper.asynchrony import AsynchronyPlan, results_of
    from lpac.paper.asynchrony import as_json as to_json
    from lpac.paper.asynchrony_report import write_report

    count = worlds if worlds is not None else _QUICK_WORLDS if quick else _WORLDS
    plan = AsynchronyPlan(
        bundle=TrainedBundle(str(bundle.resolve()), load_bundle(bundle).id),
        world_set="validation",
        worlds=count,
        **({**_QUICK_HZ, "delays_s": _QUICK_DELAYS_S} if quick else {}),
    )
    folder = out or _OUT / "async"
    with folder_lock("the experiment", folder):
        flights, flown = plan.flights(), {}
        with (
            progress_of("flights") as progress,
            closing(KeptFlights(folder).fly(flights, pool(ray))) as told,
        ):
            task = progress.add_task("", total=len(flights))
            for flight, cost in told:
                flown[flight] = cost
                progress.update(task, advance=1)
        results = results_of(plan, flown)
        command = f"lpac paper async --bundle {bundle} -k {count}{' --quick' if quick else ''}"
        made_by = {
            "command": command,
            "lpac-edge": version("lpac-edge"),
            "python": platform.python_version(),
        }
        write_report(plan, results, folder, made_by)
    if as_json:
        typer.echo(json.dumps(to_json(plan, results), indent=2))
        return
    _show(results)
    typer.echo(f"\nsee {folder}: README.md, rates.png, staleness.png, async.csv, async.json")


def _show(results: "Sequence[TimingResult]") -> None:
    from lpac.paper.asynchrony import TIMES_S

    columns = (
        "perception, Hz", "policy, Hz", "moments", "delay, s",
        *(f"at {time_s:g} s" for time_s in TIMES_S),
    )  # fmt: skip
    rows = []
    for result in results:
        timing = result.timing
        rows.append(
            [f"{timing.perception_hz:g}", f"{timing.policy_hz:g}",
             "the same" if timing.synchronous else "own", f"{timing.delay_s:g}",
             *(f"{mean:.3f}" for mean, _, _ in result.means)]
        )  # fmt: skip
    print_table(columns, rows, right=[*columns[:2], *columns[3:]])
