"""`lpac sim` and `lpac demo`: a swarm in this process, or a whole fleet on this machine."""

import gc
import json
import math
import re
import shlex
import signal
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from enum import StrEnum
from functools import partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from lpac.cli.apps import new_app
from lpac.cli.options import (
    DEFAULT_BUNDLE,
    DEFAULT_SENSOR,
    IN_REAL_TIME,
    Px4,
    Sensor,
    VehicleKind,
    check_px4,
)
from lpac.cli.printing import lines_of, progress_of
from lpac.cli.transport import WifiFile, calibration, link_line, wifi_lines

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from edge.core.frames import ModelScale
    from edge.core.world import Feature
    from lpac.cli.live import FleetDisplay
    from lpac.sim.experiment import FlightMoment, SimulatedFlight
    from lpac.sim.failure import Failure
    from lpac.sim.fleet.flight import FleetFlight
    from lpac.sim.fleet.processes import Fleet
    from lpac.sim.scenario import Scenario
    from lpac.sim.ticks import Clocks

app = new_app()

DEFAULT_OUT = Path("out/sim")
DEFAULT_ROBOTS = 10


class Controller(StrEnum):
    """Who flies the swarm."""

    LPAC = "lpac"
    DECENTRALIZED_CVT = "decentralized-cvt"
    DECENTRALIZED_CVT_PRIOR = "decentralized-cvt-prior"
    SHARED_CVT = "shared-cvt"
    SHARED_CVT_PRIOR = "shared-cvt-prior"
    FRONTIER_CVT = "frontier-cvt"
    CENTRALIZED_CVT = "centralized-cvt"
    CLAIRVOYANT_CVT = "clairvoyant-cvt"


class RadioTransport(StrEnum):
    """How messages travel."""

    MESH = "mesh"
    ROUTER = "router"
    MULTICAST = "multicast"


class PayloadName(StrEnum):
    """What a message's numbers are."""

    FLOAT32 = "float32"
    FLOAT16 = "float16"
    INT8 = "int8"


class Scale(StrEnum):
    """How large the model's world is in the air."""

    FIELD = "field"
    MODEL = "model"


# What an error may call an option's value.
_OPTIONS = {
    "communication_range": "--range", "control_hz": "--control-hz", "delay_s": "--delay",
    "duration": "--duration", "features": "--features", "lag_s": "--lag", "loss": "--loss",
    "max_message_age_s": "--max-message-age", "position_error_m": "--position-error",
    "robots": "--robots", "seed": "--seed",
    "world_size": "--world-size",
}  # fmt: skip
_OPTION_OF = re.compile(rf"\b({'|'.join(_OPTIONS)}) = ")
_NOWHERE = re.compile(r"\S*/lpac-sim-\w+/")


def _naming_options(command: Callable[..., None]) -> Callable[..., None]:
    """What is wrong with an option's value is said of the option, not of what it becomes."""

    @wraps(command)
    def named(**given: object) -> None:
        try:
            command(**given)
        except ValueError as error:
            text = _OPTION_OF.sub(
                lambda found: f"{_OPTIONS[found[1]]} ", _NOWHERE.sub("", str(error))
            )
            raise ValueError(text) from error

    return named


@app.command()
@_naming_options
def sim(
    *,
    context: typer.Context,
    vehicle: Annotated[
        VehicleKind,
        typer.Option(
            help="point: points in simulated time; simulated: whole robots with simulated PX4s on "
            "one simulated clock; mavlink: the same as one process per robot in real time; px4: "
            "with real PX4s."
        ),
    ] = VehicleKind.POINT,
    bundle: Annotated[Path, typer.Option(help="Policy bundle.")] = DEFAULT_BUNDLE,
    controller: Annotated[
        Controller,
        typer.Option(help="What decides where robots fly; lpac: the bundle's policy."),
    ] = Controller.LPAC,
    robots: Annotated[
        str | None,
        typer.Option(
            "--robots",
            "-n",
            metavar="N|auto",
            help=f"Number of robots; else {DEFAULT_ROBOTS}, and with mavlink and px4 auto: as "
            f"many, up to {DEFAULT_ROBOTS}, as this machine can handle.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="World, starts, clocks and losses follow from it.")] = 0,
    world: Annotated[
        Path | None, typer.Option(help="CoverageControl world file (.env) instead of a random one.")
    ] = None,
    features: Annotated[int, typer.Option(help="Features of a random world.")] = 10,
    duration: Annotated[
        float, typer.Option(help="Flight time, s; of whole robots, the time of the mission.")
    ] = 60.0,
    scale: Annotated[
        Scale, typer.Option(help="field: 16 units per m, velocity x 0.25; model: 1 and 1.")
    ] = Scale.FIELD,
    starts: Annotated[
        Path | None,
        typer.Option(
            help="File with a line 'x y' for each robot, where it starts, m of the mission frame; "
            "else that follows from the seed."
        ),
    ] = None,
    world_size: Annotated[
        int | None,
        typer.Option(help="Side of the world, in model units; else the bundle's."),
    ] = None,
    communication_range: Annotated[
        float | None,
        typer.Option(
            "--range", help="How far robots are heard, in model units; else the bundle's."
        ),
    ] = None,
    perception_hz: Annotated[float, typer.Option(help="How often a robot perceives.")] = 5.0,
    policy_hz: Annotated[
        float,
        typer.Option(
            help="How often its policy decides, and it speaks: against --perception-hz, the "
            "exchanges per perception."
        ),
    ] = 2.5,
    control_hz: Annotated[float, typer.Option(help="How often it steers.")] = 10.0,
    synchronous: Annotated[
        bool,
        typer.Option(
            "--synchronous", help="point: all robots perceive and decide at the same moments."
        ),
    ] = False,
    lag: Annotated[
        float, typer.Option(help="point: time constant by which robots follow a velocity, s.")
    ] = 0.0,
    position_error: Annotated[
        float,
        typer.Option(
            help="point: how wrong robots are about where they are: standard deviation, m."
        ),
    ] = 0.0,
    lost: Annotated[
        str | None,
        typer.Option(
            metavar="ROBOTS@S", help="point: robots lost in flight, such as 2@20: two at 20 s."
        ),
    ] = None,
    away: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ROBOT@FROM-UNTIL",
            help="point: a robot that is gone for a while, such as 3@60-80; may be repeated.",
        ),
    ] = None,
    payload: Annotated[
        PayloadName, typer.Option(help="point: number type in messages.")
    ] = PayloadName.FLOAT16,
    loss: Annotated[
        float,
        typer.Option(
            help="point, simulated: probability that a message is lost; for whole robots this, and "
            "--delay, apply from the mission's start on."
        ),
    ] = 0.0,
    delay: Annotated[
        float, typer.Option(help="point, simulated: mean delay of a message, s.")
    ] = 0.0,
    max_message_age: Annotated[
        float, typer.Option(help="Older messages are not used, s; 0: each is used once.")
    ] = 0.8,
    errors: Annotated[
        bool,
        typer.Option(
            help="simulated, mavlink: with errors of positions, heights, compasses and batteries, "
            "and gusts."
        ),
    ] = True,
    sensor: Sensor = DEFAULT_SENSOR,
    recorded: Annotated[
        Path | None,
        typer.Option(
            help="simulated: the --out of an earlier flight, whose policy steps are used again: "
            "the same flight on any type of CPU."
        ),
    ] = None,
    px4: Px4 = None,
    secure: Annotated[
        bool,
        typer.Option(
            help="Not point: robots and ground are members of a fleet, with keys that are made for "
            "it: what they say is signed, and nobody else is heard."
        ),
    ] = False,
    transport: Annotated[
        RadioTransport | None,
        typer.Option(
            help="point: the radio that such a team would have, by a model of one Wi-Fi channel; "
            "mavlink, px4: whether robots send their messages to each other (mesh, the default), "
            "through a router, or to all at once."
        ),
    ] = None,
    wifi: WifiFile = None,
    script: Annotated[
        bool,
        typer.Option(help="mavlink, px4: take off, cover and land; else wait for `lpac ground`."),
    ] = True,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for the flight, its world, figure and flight logs; with --no-script "
            f"{DEFAULT_OUT} if not given."
        ),
    ] = None,
) -> None:
    """Fly a swarm over an unknown world and print how well it covers it."""
    from edge.core.counted import counted
    from edge.core.frames import ModelScale
    from edge.core.world import parse_world
    from lpac.sim.description import FIELD_SCALE

    _require_options_of(context, vehicle, controller, world)
    count = _robot_count(robots, vehicle)
    world_features = parse_world(_text(world), str(world)) if world else None
    _require_something_to_cover(world, world_features, features)
    clocks = _clocks(perception_hz, policy_hz, control_hz, synchronous=synchronous)
    model = FIELD_SCALE if scale is Scale.FIELD else ModelScale(1.0, 1.0)
    starts_m = None if starts is None else _starts(starts, count, bundle, world_size, model)
    from lpac.radio.modelled import ModelledRadio
    from lpac.sim.scenario import Scenario

    is_point, team = vehicle is VehicleKind.POINT, 1 if count is None else count
    found = calibration(wifi, transport=is_point and transport is not None)
    if transport and (loss or delay):
        raise ValueError(
            f"--{'loss' if loss else 'delay'} and --transport: the model itself says what is lost, "
            "and how late messages are"
        )
    scenario = Scenario(
        controller=controller.value,
        robots=team,
        seed=seed,
        duration_s=duration,
        features=world_features,
        random_feature_count=features,
        starts_m=starts_m,
        scale=model,
        loss=loss,
        delay_s=delay,
        radio=ModelledRadio(transport.value, found.wifi) if transport and is_point else None,
        max_message_age_s=max_message_age,
        payload=payload.value,
        world_size=world_size,
        communication_range=communication_range,
        lag_s=lag,
        failures=_failures(lost, away or (), team, duration),
        position_error_m=position_error,
        clocks=clocks,
        errors=errors,
        sensor=sensor,
        secure=secure,
        transport=transport.value if transport and not is_point else "mesh",
    )
    if vehicle is VehicleKind.SIMULATED:
        _fly_on_clock(scenario, bundle, as_json, out, recorded)
        return
    if not is_point:
        check_px4(vehicle, px4)
        flown: Literal["mavlink", "px4"] = "px4" if vehicle is VehicleKind.PX4 else "mavlink"
        scenario = _sized(scenario, count, bundle, flown)
        # What is wrong with the flight itself has been said before this is.
        prepared = partial(_say_if_carried, count, bundle, flown)
        if not script:
            _serve(scenario, bundle, px4, out or DEFAULT_OUT, prepared)
            return
        _launch(scenario, bundle, px4, as_json, out, prepared)
        return
    assert count is not None
    if out:
        out.mkdir(parents=True, exist_ok=True)
    _tell_of_features_outside(world, world_features, bundle, world_size)
    [flight] = fly_points([(controller.value, scenario)], bundle)
    if out:
        from lpac.sim.report import write_flight

        write_flight(flight, out)
    if as_json:
        typer.echo(json.dumps(flight.summary(), indent=2))
        return
    typer.echo(
        f"{_flier(controller, bundle)}, {counted(count, 'robot')}, seed {seed}: "
        f"{_result(flight, duration)}"
    )
    if transport:
        typer.echo(f"{transport.value}: {link_line(*scenario.link)}; it assumes")
        typer.echo("\n".join(wifi_lines(found)))
    if out:
        typer.echo(f"see {out / 'flight.png'}")


_ONLY_FOR = {
    "controller": (VehicleKind.POINT,),
    "scale": (VehicleKind.POINT,),
    "synchronous": (VehicleKind.POINT,),
    "lag": (VehicleKind.POINT,),
    "position_error": (VehicleKind.POINT,),
    "lost": (VehicleKind.POINT,),
    "away": (VehicleKind.POINT,),
    "payload": (VehicleKind.POINT,),
    "loss": (VehicleKind.POINT, VehicleKind.SIMULATED),
    "delay": (VehicleKind.POINT, VehicleKind.SIMULATED),
    "errors": (VehicleKind.SIMULATED, VehicleKind.MAVLINK),
    "sensor": (VehicleKind.SIMULATED, VehicleKind.MAVLINK, VehicleKind.PX4),
    "recorded": (VehicleKind.SIMULATED,),
    "px4": (VehicleKind.PX4,),
    "secure": (VehicleKind.SIMULATED, VehicleKind.MAVLINK, VehicleKind.PX4),
    "transport": (VehicleKind.POINT, VehicleKind.MAVLINK, VehicleKind.PX4),
    "wifi": (VehicleKind.POINT,),
    "script": (VehicleKind.MAVLINK, VehicleKind.PX4),
}


# A baseline sees what it is to see, and decides at once; nothing is sent.
_OF_POLICIES = (
    "perception_hz", "policy_hz", "control_hz", "synchronous", "payload", "loss", "delay",
    "max_message_age",
)  # fmt: skip


def _require_options_of(
    context: typer.Context, vehicle: VehicleKind, controller: Controller, world: Path | None
) -> None:
    """An option that would do nothing is a mistake."""
    nothing = {
        name: f"--vehicle {vehicle.value}" for name in _ONLY_FOR if vehicle not in _ONLY_FOR[name]
    }
    if controller is not Controller.LPAC:
        nothing |= dict.fromkeys(_OF_POLICIES, f"--controller {controller.value}")
    if world is not None:
        nothing["features"] = f"--world {world}"
    for name, beside in nothing.items():
        source = context.get_parameter_source(name)
        if source is not None and source.name == "COMMANDLINE":
            no = "no-" if context.params[name] is False else ""
            raise ValueError(f"--{no}{name.replace('_', '-')} does nothing with {beside}")


def _failures(
    lost: str | None, away: Sequence[str], robots: int, duration_s: float
) -> tuple["Failure", ...]:
    """What --lost and --away say. Raises ValueError, also for what would come after the flight."""
    from lpac.sim.failure import Failure, LostRobots

    failures = [Failure.parse(each) for each in away]
    if lost is not None:
        failures += LostRobots.parse(lost).failures(robots)
    for failure in failures:
        if failure.from_s >= duration_s:
            raise ValueError(
                f"robot {failure.robot} is gone from {failure.from_s:g} s on: must be within the "
                f"flight, --duration {duration_s:g}"
            )
    return tuple(failures)


def _tell_of_features_outside(
    world: Path | None,
    features: "Sequence[Feature] | None",
    bundle: Path,
    world_size: int | None,
) -> None:
    """Whoever makes the world smaller may not think of them."""
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


def _robot_count(text: str | None, vehicle: VehicleKind) -> int | None:
    """None for auto."""
    if text is None:
        return None if vehicle in IN_REAL_TIME else DEFAULT_ROBOTS
    if text == "auto":
        if vehicle not in IN_REAL_TIME:
            raise ValueError(f"--robots auto does nothing with --vehicle {vehicle}")
        return None
    try:
        return int(text)
    except ValueError:
        raise ValueError(f"--robots {text!r}: must be a number, or auto") from None


def _sized(
    scenario: "Scenario", count: int | None, bundle: Path, vehicle: Literal["mavlink", "px4"]
) -> "Scenario":
    """With as many robots as this machine carries, unless their number was given.

    What is wrong with a flight is said before the machine is measured.
    """
    if count is not None:
        return scenario
    return replace(scenario, robots=_as_many_as_carried(bundle, vehicle))


def _as_many_as_carried(bundle: Path, vehicle: Literal["mavlink", "px4"]) -> int:
    """As many robots as this machine carries, from 1 to 10; says how many."""
    from lpac.sim.fleet.load import robots_carried

    carried = int(robots_carried(bundle, vehicle))
    robots = max(1, min(DEFAULT_ROBOTS, carried))
    typer.echo(f"{_carries(carried)}: flying {robots}", err=True)
    return robots


def _say_if_carried(
    robots: int | None, bundle: Path, vehicle: Literal["mavlink", "px4"]
) -> int | None:
    """How many robots this machine carries; says so, and what to do if they are too few.

    None, and nothing, if they were chosen by that.
    """
    from lpac.sim.fleet.load import robots_carried

    if robots is None:
        return None
    carried = int(robots_carried(bundle, vehicle))
    if carried >= robots:
        typer.echo(_carries(carried), err=True)
        return carried
    advice = f"; fewer: -n {max(1, carried)}" if robots > 1 else ""
    typer.echo(f"{_carries(carried)}, not {robots}: it may not keep up{advice}", err=True)
    return carried


def _carries(robots: int) -> str:
    count = f"about {robots}" if robots else "less than one"
    return f"this machine, as busy as it is now, carries {count} of these robots and vehicles"


def _launch(
    scenario: "Scenario",
    bundle: Path,
    px4: Path | None,
    as_json: bool,
    out: Path | None,
    prepared: Callable[[], int | None],
) -> None:
    """Run a fleet of processes; exit code 1 if its flight did not end as it should.

    `prepared` is called before anything starts; it tells how many robots this machine carries.
    """
    from lpac.cli.live import FleetDisplay
    from lpac.sim.fleet.flight import fly
    from lpac.sim.fleet.processes import Fleet

    # Whoever stops this program means the fleet too.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with (
        tempfile.TemporaryDirectory(prefix="lpac-sim-") as nowhere,
        FleetDisplay(scenario.robots) as display,
    ):
        folder = out or Path(nowhere)
        fleet = Fleet(scenario, folder, bundle, px4_build=px4, say=display.say)
        fleet.carried = prepared()
        flight = fly(
            fleet, display.say, lambda step: display.show_or_say(step, fleet.heard.statuses())
        )
    _show_fleet_flight(flight, as_json, out)


def _fly_on_clock(
    scenario: "Scenario",
    bundle: Path,
    as_json: bool,
    out: Path | None,
    recorded: Path | None,
) -> None:
    """Fly whole robots on one simulated clock; exit code 1 unless it ended as it should."""
    from lpac.sim.fleet.clocked import fly_simulated

    with tempfile.TemporaryDirectory(prefix="lpac-sim-") as nowhere:
        folder = out or Path(nowhere)
        said = ["the fleet is made"]

        def say(text: str) -> None:
            said.append(text)
            typer.echo(text, err=True)

        with lines_of(lambda: f"{said[-1]}: still at it"):
            flight = fly_simulated(
                scenario, folder, bundle, say, logs=out is not None, recorded=recorded
            )
    _show_fleet_flight(flight, as_json, out)


def _show_fleet_flight(flight: "FleetFlight", as_json: bool, out: Path | None) -> None:
    from lpac.sim.fleet.flight import summary_lines

    if out:
        from lpac.sim.report import write_fleet_flight

        write_fleet_flight(flight, out)
    if as_json:
        typer.echo(json.dumps(flight.summary(), indent=2))
    else:
        for line in summary_lines(flight):
            typer.echo(line)
        if out:
            logged = any(robot.logs for robot in flight.robots)
            logs = f"; the flight logs are in {out / 'robots'}" if logged else ""
            typer.echo(f"see {out / 'flight.png'}{logs}")
            if logged:
                typer.echo(
                    f"next: `lpac report {shlex.quote(str(out))}` makes all figures and a page; "
                    "with `lpac sim --vehicle mavlink --no-script` you command (docs/ground.md)"
                )
    if flight.problem or not flight.all_landed:
        raise typer.Exit(1)


def _serve(
    scenario: "Scenario",
    bundle: Path,
    px4: Path | None,
    out: Path,
    prepared: Callable[[], int | None],
) -> None:
    """Run a fleet of processes for `lpac ground` until Ctrl-C, and only listen to it."""
    from edge.core.counted import counted
    from lpac.cli.live import FleetDisplay
    from lpac.sim.fleet.processes import Fleet

    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with FleetDisplay(scenario.robots) as display:
            fleet = Fleet(scenario, out, bundle, px4_build=px4, say=display.say)
            fleet.carried = prepared()
            with fleet:
                while not fleet.heard.wait_for(lambda s: len(s) == len(fleet.robots), 0.2):
                    fleet.require_running()
                    fleet.vehicles.require_running()
                    display.show_or_say("programs start", fleet.heard.statuses())
                fleet.begin()
                display.print(
                    f"{counted(len(fleet.robots), 'robot')} until Ctrl-C; in a second terminal:\n\n"
                    f"  export LPAC_FLEET={shlex.quote(str(out / fleet.fleet_toml.name))}\n"
                    "  lpac ground\n"
                )
                try:
                    _watch_over(fleet, display)
                finally:
                    # The robots' programs must be ended, whoever is in a hurry.
                    for number in (signal.SIGINT, signal.SIGTERM):
                        signal.signal(number, signal.SIG_IGN)
    except KeyboardInterrupt:
        typer.echo("ended")


def _watch_over(fleet: "Fleet", display: "FleetDisplay") -> None:
    """Say once that this machine does not keep up, and of each robot that its program has ended.

    Raises FleetError if all have, VehicleError if a vehicle has ended.
    """
    from lpac.sim.fleet.processes import OverloadError, SimulatedFleetError

    running, keeps_up = list(fleet.robots), True
    while running:
        fleet.vehicles.require_running()
        try:
            fleet.require_keeping_up()
        except OverloadError as error:
            if keeps_up:
                display.say(str(error))
            keeps_up = False
        for robot in [robot for robot in running if not robot.running]:
            running.remove(robot)
            display.say(f"the program of {robot.name} has ended, {robot.ending()}")
        display.show(f"fleet {fleet.name}", fleet.heard.statuses())
        fleet.forget()
        time.sleep(0.2)
    raise SimulatedFleetError("the programs of all robots have ended")


def fly_points(
    scenarios: list[tuple[str, "Scenario"]], bundle_path: Path
) -> list["SimulatedFlight"]:
    """Simulate the named scenarios; how far each is goes to stderr."""
    from edge.drivers.registry import load_policy
    from edge.policy.bundle import load_bundle
    from edge.policy.family import verified
    from lpac.sim.experiment import fly

    bundle = load_bundle(bundle_path)
    if any(scenario.controller == Controller.LPAC.value for _, scenario in scenarios):
        problem = verified(load_policy(bundle)).problem
        if problem:
            typer.echo(f"warning: {bundle_path}: {problem}: no robot takes off with it", err=True)
    gc.freeze()  # what is loaded by now stays: not to be looked through during the flight
    flights = []
    with progress_of("s flown:") as progress:
        for name, scenario in scenarios:
            task = progress.add_task(name, total=scenario.duration_s)
            flights.append(fly(scenario, bundle, partial(_show, progress, task)))
    return flights


def _flier(controller: Controller, bundle: Path) -> str:
    """Whoever flew, by name: a policy's is its bundle's."""
    from edge.policy.bundle import load_bundle

    return load_bundle(bundle).manifest.name if controller is Controller.LPAC else controller.value


def _result(flight: "SimulatedFlight", duration_s: float) -> str:
    if not flight.importance.any():
        return "what there is lies outside of the world, so that there was nothing to cover"
    cost = flight.normalized_cost[-1]
    return f"after {duration_s:g} s the coverage cost is {cost:.3f} of the initial cost"


def _require_something_to_cover(
    world: Path | None, of_file: "Sequence[Feature] | None", random_features: int
) -> None:
    from edge.core.world import has_importance

    empty = random_features == 0 if of_file is None else not has_importance(of_file)
    if empty:
        what = "--features 0" if world is None else str(world)
        raise ValueError(f"{what}: the world would have nothing in it to cover")


def _starts(
    path: Path, robots: int | None, bundle: Path, world_size: int | None, scale: "ModelScale"
) -> tuple[tuple[float, float], ...]:
    """The positions in the file, m. Raises ValueError that names the line."""
    from edge.policy.bundle import load_bundle

    perception = load_bundle(bundle).manifest.perception
    if world_size is None and perception is not None:
        world_size = perception.world_size
    side_m = math.inf if world_size is None else world_size / scale.env_scale
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


def _clocks(
    perception_hz: float, policy_hz: float, control_hz: float, *, synchronous: bool
) -> "Clocks":
    """Raises ValueError for a rate that is impossible."""
    from lpac.sim.ticks import Clocks

    rates_hz = {"perception": perception_hz, "policy": policy_hz, "control": control_hz}
    for loop, rate_hz in rates_hz.items():
        if not 0.1 <= rate_hz <= 100.0:
            raise ValueError(f"--{loop}-hz {rate_hz:g}: must be from 0.1 to 100")
    return Clocks(
        perception_s=1.0 / perception_hz,
        policy_s=1.0 / policy_hz,
        control_s=1.0 / control_hz,
        synchronous=synchronous,
    )


def _text(path: Path) -> str:
    try:
        return path.read_text("utf-8-sig")
    except UnicodeDecodeError:
        raise ValueError(f"{path}: is not a text file") from None


def _show(progress: "Progress", task: "TaskID", moment: "FlightMoment") -> None:
    progress.update(task, completed=moment.time_s)
