"""`lpac replay`: run the policy again on what a flight log holds."""

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import typer

from lpac.cli.apps import new_app

app = new_app()


@app.command()
def replay(
    logs: Annotated[
        list[Path], typer.Argument(metavar="LOG...", help="Flight logs, or directories of them.")
    ],
    bundle: Annotated[
        Path | None, typer.Option(help="The policy's bundle; where the robot had it, if not given.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Run the policy again on what flight logs hold, and compare with what it computed."""
    from itertools import chain

    from edge.drivers.flight_log import read, read_metadata
    from edge.policy.bundle import BundleError, load_bundle
    from edge.policy.lpac.policy import LpacPolicy
    from edge.policy.lpac.replay import replay as run_again

    paths = list(_segments(logs))
    metadata = {path: read_metadata(path) for path in paths}
    bundle_path = bundle or Path(metadata[paths[0]].bundle_path)
    try:
        policy_bundle = load_bundle(bundle_path)
    except BundleError as error:
        if bundle:
            raise
        raise ValueError(f"{error} (where the robot had its bundle: give --bundle)") from None
    for path, flown in metadata.items():
        if flown.bundle_id != policy_bundle.id:
            raise ValueError(
                f"{path}: flew with bundle {flown.bundle_id[:12]}, "
                f"and {bundle_path} is {policy_bundle.id[:12]}"
            )
    comparisons = run_again(
        LpacPolicy(policy_bundle), chain.from_iterable(read(path) for path in paths)
    )
    _, velocity, _ = comparisons
    if not velocity.ticks:
        raise ValueError(f"{', '.join(map(str, logs))}: no policy ticks: the policy never ran")
    differing = [c for c in comparisons if c.differing]
    if as_json:
        report = {
            "bundle": policy_bundle.id,
            "robots": sorted({flown.robot_id for flown in metadata.values()}),
            "logs": [str(path) for path in paths],
            "outputs": {
                c.name: {
                    "ticks": c.ticks,
                    "differing": c.differing,
                    "largest_difference": _or_none(c.largest_difference),
                }
                for c in comparisons
            },
        }
        typer.echo(json.dumps(report, indent=2))
    else:
        for c in comparisons:
            typer.echo(
                f"{c.name:12} {c.ticks:7,} ticks, {c.differing:,} differ, "
                f"largest difference {c.largest_difference:g}"
            )
    if differing:
        offs = ", ".join(f"{c.name} by up to {c.largest_difference:g}" for c in differing)
        raise ValueError(
            f"not what was computed in flight: {offs}: another kind of processor rounds otherwise "
            "in the last digits, the same one does not"
        )
    if not as_json:
        typer.echo(
            f"{policy_bundle.manifest.name} {policy_bundle.id[:12]}: "
            "computes what it computed in flight"
        )


def _segments(logs: Iterable[Path]) -> Iterable[Path]:
    for log in logs:
        if log.is_dir():
            found = sorted(log.rglob("*.mcap"))
            if not found:
                raise ValueError(f"{log}: holds no flight log (*.mcap)")
            yield from found
        else:
            yield log


def _or_none(number: float) -> float | None:
    """JSON has no NaN."""
    return number if math.isfinite(number) else None
