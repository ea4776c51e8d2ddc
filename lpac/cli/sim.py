"""`lpac sim`: a swarm of points in this process, or a whole fleet on this machine."""

import gc
import json
import shlex
import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from msgspec import Meta

from lpac.cli.apps import new_app
from lpac.cli.fields import chosen, flag_of, options_of
from lpac.cli.options import (
    DEFAULT_BUNDLE,
    DEFAULT_ROBOTS,
    IN_REAL_TIME,
    AsJson,
    Px4,
    VehicleKind,
    check_px4,
)
from lpac.cli.printing import periodic_lines, progress_of
from lpac.cli.programs import choose_robot_count, report_capacity, serve
from lpac.cli.transport import Transport, WifiFile, calibration, wifi_lines

if TYPE_CHECKING:
    from rich.progress import TaskID

    from edge.core.world import Feature
    from lpac.analysis.flight import FlightRecord
    from lpac.sim.failure import Failure
    from lpac.sim.scenario import Scenario

app = new_app()

DEFAULT_OUT = Path("out/sim")
_Hz = Annotated[float, Meta(ge=0.1, le=100.0)]


class Scale(StrEnum):
    """Size of the model's world in the air."""

    FIELD = "field"
    MODEL = "model"


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOptions:
    """Options of the engine and its output."""

    vehicle: Annotated[
        VehicleKind,
        "point: points in simulated time; simulated: whole robots with simulated PX4s on one "
        "simulated clock; mavlink: the same as one process per robot in real time; px4: with real "
        "PX4s.",
    ] = VehicleKind.POINT
    bundle: Annotated[Path, "Policy bundle."] = DEFAULT_BUNDLE
    recorded: Annotated[
        Path | None,
        "simulated: the --out of an earlier flight, whose policy steps are used again: the same "
        "flight on any type of CPU.",
    ] = None
    px4: Px4 = None
    script: Annotated[
        bool, "mavlink, px4: take off, cover and land; else wait for `lpac ground`."
    ] = True
    as_json: AsJson = False
    out: Annotated[
        Path | None,
        "Folder for the flight, its world, figure and flight logs; with --no-script "
        f"{DEFAULT_OUT} if not given.",
    ] = None


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightOptions:
    """Options that are not simply fields of a scenario."""

    robots: Annotated[
        str | None,
        typer.Option(
            "--robots", "-n", metavar="N|auto",
            help=f"Number of robots; else {DEFAULT_ROBOTS}, and with mavlink and px4 auto: as "
            f"many, up to {DEFAULT_ROBOTS}, as this machine can handle.",
        ),
    ] = None  # fmt: skip
    world: Annotated[Path | None, "CoverageControl world file (.env) instead of a random one."] = (
        None
    )
    starts: Annotated[
        Path | None,
        "File of starts, a line 'x y' for each robot, m in the mission frame; by default drawn "
        "from the seed.",
    ] = None
    scale: Annotated[Scale, "Points: field: 16 units per m, velocity x 0.25; model: 1 and 1."] = (
        Scale.FIELD
    )
    perception_hz: Annotated[_Hz, "How often a robot perceives."] = 5.0
    policy_hz: Annotated[
        _Hz,
        "How often its policy decides and it sends; over --perception-hz, the exchanges per "
        "perception.",
    ] = 2.5
    control_hz: Annotated[_Hz, "How often it steers."] = 10.0
    synchronous: Annotated[bool, "Points: all robots perceive and decide at the same moments."] = (
        False
    )
    lost: Annotated[
        str | None,
        typer.Option(
            metavar="ROBOTS@S", help="Points: robots lost in flight, such as 2@20: two at 20 s."
        ),
    ] = None
    away: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ROBOT@FROM-UNTIL",
            help="A robot that is away for a while, such as 3@60-80; a pilot flies it if it is a "
            "whole robot; may be repeated.",
        ),
    ] = None
    transport: Annotated[
        Transport | None,
        "point: a team's radio, by a model of one Wi-Fi channel; mavlink, px4: robots send "
        "messages to each other one by one (mesh, the default), or to all at once (multicast).",
    ] = None
    wifi: WifiFile = None


# Options of a scenario's fields that are not named after the field.
_NAMED = {"random_feature_count": "--features", "communication_range": "--range"}
_FLAGS = {**_NAMED, "failures": "--lost", "radio": "--transport", "clocks": "--policy-hz"}


def _scenario_options() -> type[Any]:
    """Options that are a scenario's own fields."""
    from lpac.sim.scenario import Scenario

    return chosen(
        Scenario, "controller", "seed", "duration_s", "world_size", "lag_s", "position_error_m",
        "payload", "loss", "delay_s", "max_message_age_s", "errors", "wind_m_s", "sensor", "secure",
        **_NAMED,
    )  # fmt: skip


@app.command()
@options_of(RunOptions, FlightOptions, _scenario_options())
def sim(run: RunOptions, flight: FlightOptions, scenario_options: Any) -> None:
    """Fly a swarm over an unknown world and print how well it covers it."""
    if run.vehicle is not VehicleKind.SIMULATED and run.recorded is not None:
        raise ValueError(f"--recorded does nothing with --vehicle {run.vehicle.value}")
    if run.vehicle not in IN_REAL_TIME and not run.script:
        raise ValueError(f"--no-script does nothing with --vehicle {run.vehicle.value}")
    check_px4(run.vehicle, run.px4)
    count = _robot_count(flight.robots, run.vehicle)
    scenario = _scenario(run, flight, scenario_options, count)
    _require_able(scenario, run)
    if run.out:
        run.out.mkdir(parents=True, exist_ok=True)
    if run.vehicle is VehicleKind.POINT:
        _warn_of_features_outside(flight.world, scenario.features, run.bundle, scenario.world_size)
        [record] = fly_showing([(scenario.controller, scenario)], run.bundle)
    elif run.vehicle is VehicleKind.SIMULATED:
        record = _fly_on_clock(scenario, run)
    else:
        if count is None:
            scenario = replace(scenario, robots=choose_robot_count(run.bundle, _programs(run)))
        if not run.script:
            _serve(scenario, run, count)
            return
        record = _fly_programs(scenario, run, count)
    _show(scenario, record, run, flight)
    if record.script.vehicle and (record.script.problem or not record.all_landed):
        raise typer.Exit(1)


@contextmanager
def _told_as_option(beside: str) -> Iterator[None]:
    """Convert an UnableError to a ValueError that names the option without effect."""
    from lpac.sim.scenario import UnableError

    try:
        yield
    except UnableError as error:
        flag = _FLAGS.get(error.name, flag_of(error.name))
        raise ValueError(f"{flag} does nothing with {beside}") from None


def _require_able(scenario: "Scenario", run: RunOptions) -> None:
    """Raise ValueError that names an option without effect."""
    from lpac.sim.engines import engine_of

    if scenario.controller != "lpac":
        # Baselines have no separate loops and send nothing.
        with _told_as_option(f"--controller {scenario.controller}"):
            scenario.require_default(
                "baselines", "clocks", "payload", "loss", "delay_s", "max_message_age_s"
            )
    with _told_as_option(f"--vehicle {run.vehicle.value}"):
        engine_of(run.vehicle.value, run.px4).require_able(scenario)


def _scenario(
    run: RunOptions, flight: FlightOptions, scenario_options: Any, count: int | None
) -> "Scenario":
    """Build the options' scenario, with one robot if `count` is None (auto).

    Raises ValueError for impossible options, or options without effect.
    """
    from edge.core.frames import ModelScale
    from edge.core.world import parse_world
    from lpac.radio.modelled import ModelledRadio
    from lpac.sim.description import FIELD_SCALE
    from lpac.sim.scenario import Scenario

    is_point, world = run.vehicle is VehicleKind.POINT, flight.world
    robots = 1 if count is None else count
    feature_count = scenario_options.random_feature_count
    if world is not None and feature_count != Scenario().random_feature_count:
        raise ValueError(f"--features does nothing with --world {world}")
    features = parse_world(_text(world), str(world)) if world else None
    require_something_to_cover(world, features, feature_count)
    scale = FIELD_SCALE if flight.scale is Scale.FIELD else ModelScale(1.0, 1.0)
    transport = flight.transport if is_point else None
    found = calibration(flight.wifi, transport=transport is not None)
    radio = None if transport is None else ModelledRadio(transport, found.wifi)
    scenario = Scenario(
        robots=robots,
        features=features,
        scale=scale,
        radio=radio,
        failures=_failures(flight, robots, scenario_options.duration_s),
        clocks=_clocks(flight),
        transport=flight.transport if flight.transport and not is_point else "mesh",
        **{name: getattr(scenario_options, name) for name in scenario_options.__dataclass_fields__},
    )
    if flight.starts is None:
        return scenario
    return replace(scenario, starts_m=_starts(flight.starts, count, run.bundle, scenario))


def _failures(flight: FlightOptions, robots: int, duration_s: float) -> tuple["Failure", ...]:
    """Parse --lost and --away. Raises ValueError, also for times after the flight."""
    from lpac.sim.failure import Failure, LostRobots

    failures = [Failure.parse(each) for each in flight.away or ()]
    if flight.lost is not None:
        failures += LostRobots.parse(flight.lost).failures(robots)
    for failure in failures:
        if failure.from_s >= duration_s:
            raise ValueError(
                f"robot {failure.robot} is away from {failure.from_s:g} s on: must be within the "
                f"flight, --duration {duration_s:g}"
            )
    return tuple(failures)


def _clocks(flight: FlightOptions) -> Any:
    from lpac.sim.ticks import Clocks

    return Clocks(
        perception_s=1.0 / flight.perception_hz,
        policy_s=1.0 / flight.policy_hz,
        control_s=1.0 / flight.control_hz,
        synchronous=flight.synchronous,
    )


def _robot_count(text: str | None, vehicle: VehicleKind) -> int | None:
    """Parse --robots; None for auto."""
    if text is None:
        return None if vehicle in IN_REAL_TIME else DEFAULT_ROBOTS
    if text == "auto":
        if vehicle not in IN_REAL_TIME:
            raise ValueError(f"--robots auto does nothing with --vehicle {vehicle}")
        return None
    try:
        count = int(text)
    except ValueError:
        raise ValueError(f"--robots {text!r}: must be a number, or auto") from None
    if count < 1:
        raise ValueError(f"--robots {count}: must be at least 1")
    return count


def fly_showing(scenarios: list[tuple[str, "Scenario"]], bundle: Path) -> list["FlightRecord"]:
    """Simulate the named scenarios, with progress on stderr."""
    from edge.drivers.registry import load_policy
    from edge.policy.family import verified
    from lpac.sim.engines import Points, loaded_bundle
    from lpac.sim.points import FlightMoment

    if any(scenario.controller == "lpac" for _, scenario in scenarios):
        problem = verified(load_policy(loaded_bundle(str(bundle)))).problem
        if problem:
            typer.echo(f"warning: {bundle}: {problem}: no robot takes off with it", err=True)
    gc.freeze()  # keep the collector off loaded modules during the flight
    records = []
    with progress_of("s flown:") as progress:
        for name, scenario in scenarios:
            task = progress.add_task(name, total=scenario.duration_s)

            def show(moment: FlightMoment, task: "TaskID" = task) -> None:
                progress.update(task, completed=moment.time_s)

            records += Points().fly([scenario], bundle, watch=show)
    return records


def _fly_on_clock(scenario: "Scenario", run: RunOptions) -> "FlightRecord":
    from lpac.sim.engines import ClockedRobots

    steps = ["the fleet is made"]

    def say(text: str) -> None:
        steps.append(text)
        typer.echo(text, err=True)

    with periodic_lines(lambda: f"{steps[-1]}: still running"):
        [record] = ClockedRobots(say, run.recorded).fly([scenario], run.bundle, run.out)
    return record


def _fly_programs(scenario: "Scenario", run: RunOptions, count: int | None) -> "FlightRecord":
    from lpac.cli.live import FleetDisplay
    from lpac.sim.engines import Programs
    from lpac.sim.fleet.flight import FleetMoment

    def show(moment: FleetMoment) -> None:
        display.show_or_say(moment.step, moment.statuses)

    # SIGTERM must end the fleet as Ctrl-C does.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    carries = partial(report_capacity, count, run.bundle, _programs(run))
    with FleetDisplay(scenario.robots) as display:
        engine = Programs(run.px4, display.say, carries)
        [record] = engine.fly([scenario], run.bundle, run.out, show)
    return record


def _serve(scenario: "Scenario", run: RunOptions, count: int | None) -> None:
    from lpac.cli.live import FleetDisplay
    from lpac.sim.fleet.processes import Fleet

    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with FleetDisplay(scenario.robots) as display:
            out = run.out or DEFAULT_OUT
            fleet = Fleet(scenario, out, run.bundle, px4_build=run.px4, report=display.say)
            fleet.carried = report_capacity(count, run.bundle, _programs(run))
            serve(fleet, out / fleet.fleet_toml.name, display)
    except KeyboardInterrupt:
        typer.echo("ended")


def _programs(run: RunOptions) -> Literal["mavlink", "px4"]:
    return "px4" if run.px4 else "mavlink"


def _show(
    scenario: "Scenario", record: "FlightRecord", run: RunOptions, flight: FlightOptions
) -> None:
    from lpac.sim.flight_summary import summary, summary_lines

    if run.out:
        from lpac.sim.flight_files import write_flight

        write_flight(scenario, record, run.out)
    if run.as_json:
        typer.echo(json.dumps(summary(scenario, record), indent=2))
        return
    if record.script.vehicle:
        typer.echo("\n".join(summary_lines(scenario, record)))
    else:
        _show_points(scenario, record, run.bundle, flight)
    if not run.out:
        return
    logged = any(program.logs for program in record.script.programs)
    logs = f"; the flight logs are in {run.out / 'robots'}" if logged else ""
    typer.echo(f"see {run.out / 'flight.png'}{logs}")
    if logged:
        typer.echo(
            f"next: `lpac report {shlex.quote(str(run.out))}` makes all figures and a page; "
            "with `lpac sim --vehicle mavlink --no-script` you command (docs/ground.md)"
        )


def _show_points(
    scenario: "Scenario", record: "FlightRecord", bundle: Path, flight: FlightOptions
) -> None:
    from edge.core.counted import counted
    from lpac.sim.engines import loaded_bundle

    is_policy = scenario.controller == "lpac"
    flier = loaded_bundle(str(bundle)).manifest.name if is_policy else scenario.controller
    result = "all features lie outside of the world, so there was nothing to cover"
    if len(record.normalized):
        result = (
            f"after {record.duration_s:g} s the coverage cost is {record.normalized[-1]:.3f} of "
            "the initial cost"
        )
    typer.echo(f"{flier}, {counted(scenario.robots, 'robot')}, seed {scenario.seed}: {result}")
    if scenario.radio is not None:
        found = calibration(flight.wifi, transport=True)
        typer.echo(f"{scenario.radio.transport}: {scenario.link.in_words}; it assumes")
        typer.echo("\n".join(wifi_lines(found)))


def require_something_to_cover(
    world: Path | None, of_file: "Sequence[Feature] | None", random_features: int
) -> None:
    from edge.core.world import has_importance

    empty = random_features == 0 if of_file is None else not has_importance(of_file)
    if empty:
        what = "--features 0" if world is None else str(world)
        raise ValueError(f"{what}: the world would have nothing in it to cover")


def _warn_of_features_outside(
    world: Path | None,
    features: "Sequence[Feature] | None",
    bundle: Path,
    world_size: int | None,
) -> None:
    """Warn about features outside of the world, for example after --world-size."""
    from edge.core.world import GaussianFeature
    from edge.policy.bundle import load_bundle

    perception = load_bundle(bundle).manifest.perception
    if features is None or perception is None:
        return
    side = world_size or perception.world_size
    places = [
        (each.mean,) if isinstance(each, GaussianFeature) else each.vertices for each in features
    ]
    outside = sum(
        not any(0.0 <= x <= side and 0.0 <= y <= side for x, y in place) for place in places
    )
    if outside:
        typer.echo(
            f"{world}: {outside} of {len(features)} features lie outside of the world, whose side "
            f"is {side} model units",
            err=True,
        )


def _starts(
    path: Path, robots: int | None, bundle: Path, scenario: "Scenario"
) -> tuple[tuple[float, float], ...]:
    """Read start positions, m. Raises ValueError that names the line; BundleError."""
    from edge.policy.bundle import load_bundle

    side_m = scenario.perception_of(load_bundle(bundle)).world_size / scenario.scale.env_scale
    starts_m = []
    for number, line in enumerate(_text(path).splitlines(), start=1):
        if not line.strip():
            continue
        try:
            x_m, y_m = map(float, line.replace(",", " ").split())
        except ValueError:
            raise ValueError(f"{path}: line {number}: must be 'x y', in m") from None
        if not (0.0 <= x_m <= side_m and 0.0 <= y_m <= side_m):
            raise ValueError(
                f"{path}: line {number}: {line.strip()}: is outside of the world: must be from 0 "
                f"to {side_m:g} m"
            )
        starts_m.append((x_m, y_m))
    if robots is None:
        raise ValueError(f"{path}: has {len(starts_m)} starts: add --robots {len(starts_m)}")
    if len(starts_m) != robots:
        raise ValueError(f"{path}: has {len(starts_m)} starts, and there are {robots} robots")
    return tuple(starts_m)


def _text(path: Path) -> str:
    try:
        return path.read_text("utf-8-sig")
    except UnicodeDecodeError:
        raise ValueError(f"{path}: is not a text file") from None
