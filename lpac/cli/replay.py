"""`lpac replay`: recompute a flight's decisions from its log."""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from lpac.cli.apps import new_app
from lpac.cli.options import AsJson
from lpac.cli.printing import working

if TYPE_CHECKING:
    from edge.drivers.flight_log import FlightMetadata
    from edge.drivers.log_reader import LogGap
    from edge.policy.bundle import Bundle
    from lpac.analysis.flight_replay import FlightReplay
    from lpac.analysis.policy_replay import Comparison

app = new_app()

# Per log; `--json` has all.
_MOST_ROWS = 20
_ROUNDS = "the last digits may differ on another kind of processor, but not on the same one"


class _Replay(NamedTuple):
    """Results for the policy, if it ran, and for the flight decisions, by segment of the logs."""

    metadata: "Mapping[Path, FlightMetadata]"
    bundle: "Bundle | None"
    comparisons: "tuple[Comparison, ...]"
    flights: "Mapping[Path, FlightReplay]"
    missing: "Sequence[LogGap]"

    @property
    def has_flight(self) -> bool:
        return any(flight.ticks for flight in self.flights.values())


@app.command()
def replay(
    logs: Annotated[
        list[Path], typer.Argument(metavar="LOG...", help="Flight logs, or directories of them.")
    ],
    bundle: Annotated[
        Path | None, typer.Option(help="The policy's bundle; where the robot had it, if not given.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Recompute policy and flight decisions from flight logs, and print differences."""
    with working("replaying the logs"):
        result = _replay(logs, bundle)
    for gap in result.missing:
        typer.echo(f"lpac: {gap}", err=True)
    if as_json:
        typer.echo(json.dumps(_described(result), indent=2))
    else:
        for c in result.comparisons:
            typer.echo(
                f"{c.name:12} {c.ticks:7,} ticks, {c.differing:,} differ, "
                f"largest difference {c.largest_difference:g}"
            )
        _print_flights(result.flights, result.metadata)
    problems = _problems(result)
    if problems:
        raise ValueError("; ".join(problems))
    if not as_json:
        _print_equal(result)


def _replay(logs: list[Path], bundle: Path | None) -> _Replay:
    from edge.drivers.log_reader import LogGap

    metadata = _metadata(logs)
    missing = list[LogGap]()
    result = _Replay(metadata, None, (), _flights(metadata, missing), missing)
    if _has_policy_ticks(metadata):
        policy_bundle, comparisons = _policy(metadata, bundle)
        return result._replace(bundle=policy_bundle, comparisons=comparisons)
    if not result.has_flight:
        raise ValueError(f"{', '.join(map(str, logs))}: no policy ticks: the policy never ran")
    return result


def _print_equal(result: _Replay) -> None:
    """Print the result of a replay without differences."""
    if result.bundle is not None:
        found = "computes what it computed in flight"
        if not result.comparisons:
            found = "was not replayed: only policies of the family lpac are"
        typer.echo(f"{result.bundle.manifest.name} {result.bundle.id[:12]}: {found}")
    if result.has_flight:
        skipped = sum(flight.passed_over for flight in result.flights.values())
        but = f", except {skipped:,} ticks that were skipped" if skipped else ""
        typer.echo(f"flight: decides what it decided in flight{but}")


def _problems(result: _Replay) -> list[str]:
    """Differences from the flight, and damaged logs."""
    problems = []
    differing = [c for c in result.comparisons if c.differing]
    if differing:
        offs = ", ".join(f"{c.name} by up to {c.largest_difference:g}" for c in differing)
        problems.append(f"not what was computed in flight: {offs}: {_ROUNDS}")
    if ticks := sum(flight.differing for flight in result.flights.values()):
        rounds = all(
            d.differing.is_rounding for f in result.flights.values() for d in f.differences
        )
        problems.append(
            f"not what was decided in flight: {ticks:,} ticks differ"
            + (f" in the last digits alone: {_ROUNDS}" if rounds else "")
        )
    damaged = sorted({gap.path.name for gap in result.missing if gap.damaged})
    if damaged:
        problems.append(f"not all could be replayed: {', '.join(damaged)}: damaged")
    return problems


def _metadata(logs: Iterable[Path]) -> "dict[Path, FlightMetadata]":
    """Metadata by segment. In a folder, files that are no flight logs are skipped."""
    from edge.drivers.log_reader import FlightLogError, read_metadata

    metadata = {}
    for path in _segments(logs):
        try:
            metadata[path] = read_metadata(path)
        except FlightLogError as error:
            if path in logs:
                raise
            # Power may have failed before the first byte was on the disk.
            typer.echo(f"lpac: {error}: left out", err=True)
    return metadata


def _policy(
    metadata: "Mapping[Path, FlightMetadata]", given: Path | None
) -> "tuple[Bundle, tuple[Comparison, ...]]":
    """The bundle, and comparisons of all its ticks with the log."""
    from itertools import chain

    from edge.drivers.log_reader import read
    from edge.drivers.registry import load_policy
    from edge.policy.bundle import BundleError, load_bundle
    from lpac.analysis.policy_replay import replay as run_again

    bundle_path = given or Path(next(iter(metadata.values())).bundle_path)
    try:
        bundle = load_bundle(bundle_path)
    except BundleError as error:
        if given:
            raise
        raise ValueError(f"{error} (where the robot had its bundle: give --bundle)") from None
    for path, flown in metadata.items():
        if flown.bundle_id != bundle.id:
            raise ValueError(
                f"{path}: flew with bundle {flown.bundle_id[:12]}, "
                f"and {bundle_path} is {bundle.id[:12]}"
            )
    messages = chain.from_iterable(
        read(path, "perception", "policy", on_gap=_reported_already) for path in metadata
    )
    return bundle, run_again(load_policy(bundle), messages)


def _has_policy_ticks(paths: Iterable[Path]) -> bool:
    from edge.drivers.log_reader import read

    return any(True for path in paths for _ in read(path, "policy", on_gap=_reported_already))


def _reported_already(_: "LogGap") -> None:
    """Ignore a gap: `_flights`, which reads all logs, reports it."""


def _flights(
    metadata: "Mapping[Path, FlightMetadata]", missing: "list[LogGap]"
) -> "dict[Path, FlightReplay]":
    """Recompute the programs' flight decisions. A program's segments must be in order."""
    from edge.drivers.log_reader import read
    from edge.flight.record import TickError, TickReader
    from lpac.analysis.flight_replay import FlightReplay

    readers: dict[FlightMetadata, TickReader] = {}
    flights = {}
    for path, program in metadata.items():
        flights[path] = flight = FlightReplay(readers.setdefault(program, TickReader()))
        for _, unix_time_s, message in read(path, "flight", on_gap=missing.append):
            try:
                flight.run(unix_time_s, message)
            except TickError as error:
                raise ValueError(
                    f"{path}: flight at {unix_time_s:.3f} s: {error} "
                    f"(written by lpac-edge {program.version})"
                ) from None
    return flights


def _print_flights(
    flights: "Mapping[Path, FlightReplay]", metadata: "Mapping[Path, FlightMetadata]"
) -> None:
    from lpac.cli.printing import print_table

    rows = []
    width = max(12, *(len(path.stem) for path in flights))
    for path, flight in flights.items():
        name, robot = f"{path.stem:{width}}", str(metadata[path].robot_id)
        if not flight.ticks:
            typer.echo(
                f"{name} has no inputs of flight decisions "
                f"(written by lpac-edge {metadata[path].version})"
            )
            continue
        skipped = f", {flight.passed_over:,} skipped" if flight.passed_over else ""
        typer.echo(f"{name} {flight.ticks:7,} ticks, {flight.differing:,} differ{skipped}")
        for difference in flight.differences[:_MOST_ROWS]:
            what, then, now, _ = difference.differing
            at_s = difference.since_unix_s - flight.began_unix_s
            rows.append(
                (path.stem, robot, f"{at_s:.1f} s", f"{difference.ticks:,}", what, then, now)
            )
        left = len(flight.differences) - _MOST_ROWS
        if left > 0:
            rows.append((path.stem, robot, "", "", f"{left:,} more: --json", "", ""))
    if rows:
        print_table(
            ("log", "robot", "time", "ticks", "what", "decided then", "decides now"),
            rows,
            right=("time", "ticks"),
        )


def _described(result: _Replay) -> dict[str, Any]:
    return {
        "bundle": result.bundle and result.bundle.id,
        "robots": sorted({each.robot_id for each in result.metadata.values()}),
        "logs": [str(path) for path in result.metadata],
        "outputs": {
            c.name: {
                "ticks": c.ticks,
                "differing": c.differing,
                "largest_difference": _or_none(c.largest_difference),
            }
            for c in result.comparisons
        },
        "missing": [{**gap._asdict(), "path": str(gap.path)} for gap in result.missing],
        "flights": [
            _flight(path, result.metadata[path], flight) for path, flight in result.flights.items()
        ],
    }


def _flight(path: Path, program: "FlightMetadata", flight: "FlightReplay") -> dict[str, Any]:
    return {
        "log": str(path),
        "robot": program.robot_id,
        "boot_nonce": program.boot_nonce,
        "version": program.version,
        "ticks": flight.ticks,
        "passed_over": flight.passed_over,
        "differing": flight.differing,
        "differences": [
            {
                **d.differing._asdict(),
                "ticks": d.ticks,
                "since_unix_s": d.since_unix_s,
                "until_unix_s": d.until_unix_s,
            }
            for d in flight.differences
        ],
    }


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
