"""`lpac mission`: command the fleet."""

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lpac.cli.apps import new_app
from lpac.cli.fields import options_of
from lpac.cli.ground_requests import (
    Addressed,
    ListenSeconds,
    address,
    ask,
    confirm,
    interruptible,
    measure,
    subscribe,
)
from lpac.cli.mission.rehearse import rehearse
from lpac.cli.mission.run import run
from lpac.cli.options import DEFAULT_FLEET, AsJson, Fleet, FleetOptions

if TYPE_CHECKING:
    from edge.messages.mission import Origin
    from lpac.ground.site import Point, Standing

app = new_app(
    "mission", "Command the fleet, through `lpac ground`. Done when every robot has answered."
)
# Negative coordinates must not be parsed as options.
_NUMBERS = {"ignore_unknown_options": True}

Yes = Annotated[bool, typer.Option("--yes", help="Do not ask.")]


@dataclass(frozen=True, slots=True, kw_only=True)
class WholeFleetOptions(FleetOptions):
    """Options of a command for the whole fleet, which shares one origin, fence and world."""

    robots: Annotated[
        str | None,
        typer.Option(
            "--robots",
            help="Wait for these robots only, such as r1,r3; all robots get the command.",
        ),
    ] = None


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotsOptions(FleetOptions):
    """Options of a command for robots by name or by --robots; all robots by default."""

    names: Annotated[
        list[str] | None, typer.Argument(metavar="[ROBOT...]", help="The robots; else all.")
    ] = None


@dataclass(frozen=True, slots=True, kw_only=True)
class LandingOptions(RobotsOptions):
    """Options of a command that ends on the ground."""

    wait: Annotated[bool, typer.Option("--wait", help="Wait until all have landed.")] = False


@dataclass(frozen=True, slots=True, kw_only=True)
class NamedOptions(RobotsOptions):
    """Options of a command that requires robots to be named."""

    names: Annotated[
        list[str] | None, typer.Argument(metavar="ROBOT...", help="The robots; never all.")
    ] = None
    robots: Annotated[str | None, typer.Option("--robots", help="The same, such as r1,r3.")] = None


def _named(options: RobotsOptions, command: str) -> Addressed:
    """Resolve names or --robots. Raises ValueError for both, or if `NamedOptions` get neither."""
    if options.names and options.robots is not None:
        raise ValueError("give the robots' names or --robots, not both")
    to = address(options.fleet, ",".join(options.names) if options.names else options.robots)
    if isinstance(options, NamedOptions) and not to.robots:
        raise ValueError(
            f"{command}: name the robots, such as `lpac mission {command} r3`: it is never for all"
        )
    return to


@dataclass(frozen=True, slots=True, kw_only=True)
class OriginOptions:
    """Origin of the mission frame."""

    latitude: Annotated[float | None, typer.Argument(metavar="LAT", help="Degrees.")] = None
    longitude: Annotated[float | None, typer.Argument(metavar="LON", help="Degrees.")] = None
    heading: Annotated[
        float | None,
        typer.Argument(metavar="HEADING_DEG", help="Of the y axis, from true north, [0, 360)."),
    ] = None
    from_robot: Annotated[
        str, typer.Option("--from", help="This robot's position; y points along its nose.")
    ] = ""
    toward: Annotated[str, "The y axis points to this robot; with --from."] = ""
    seconds: Annotated[
        float, typer.Option("--seconds", min=0.5, max=600, help="How long --from listens.")
    ] = 5.0


@app.command(context_settings=_NUMBERS)
@options_of(OriginOptions, WholeFleetOptions)
def origin(given: OriginOptions, options: WholeFleetOptions) -> None:
    """Set the mission frame's origin: LAT LON HEADING_DEG, or a robot's pose (--from)."""
    from lpac.ground.station.protocol import SetOrigin

    to = address(options.fleet, options.robots)
    where = _measured_origin(to, given) if given.from_robot else _given_origin(to, given)
    typer.echo(
        f"origin: {where.latitude_deg:.7f} {where.longitude_deg:.7f}, y axis {where.heading_deg:g} "
        "deg from north",
        err=True,
    )
    ask(to, SetOrigin(where, to.robots), "origin", as_json=options.as_json)


def _measured_origin(to: Addressed, given: OriginOptions) -> "Origin":
    from lpac.ground.site import origin_at

    if given.latitude is not None:
        raise ValueError("origin: give LAT LON HEADING_DEG, or --from ROBOT, not both")
    with subscribe(to) as subscriber:
        robots = [given.from_robot, *filter(None, [given.toward])]
        stands = measure(subscriber, robots, given.seconds)
    first, second = stands[given.from_robot], stands.get(given.toward)
    where = origin_at(first, second)
    typer.echo(_measured(first, second), err=True)
    return where


def _given_origin(to: Addressed, given: OriginOptions) -> "Origin":
    """Read LAT LON HEADING_DEG; warn if it is far from the robots."""
    from edge.messages.mission import Origin
    from lpac.ground.site import FAR_M, furthest_m

    if given.latitude is None or given.longitude is None or given.heading is None or given.toward:
        raise ValueError(
            "origin: give LAT LON HEADING_DEG, or --from ROBOT, with or without --toward ROBOT"
        )
    try:
        where = Origin(given.latitude, given.longitude, given.heading)
    except ValueError as error:
        raise ValueError(f"origin: {error}") from None
    with subscribe(to) as subscriber:
        far_m = furthest_m(where, subscriber.snapshot)
    if far_m > FAR_M:
        typer.echo(f"NOTE: robots are up to {far_m / 1e3:.1f} km from this origin", err=True)
    return where


def _measured(first: "Standing", second: "Standing | None") -> str:
    from lpac.ground.site import distance_m, error_deg

    text = f"{first.robot} stands within {first.spread_m:.2f} m"
    if second is not None:
        apart_m = distance_m(first.position_deg, second.position_deg)
        return (
            f"{text}, {second.robot} within {second.spread_m:.2f} m, {apart_m:.1f} m apart: "
            f"1 m of GPS error turns the heading by {error_deg(apart_m):.0f} deg"
        )
    assert first.heading is not None
    return f"{text}, its heading is within {first.heading.spread_deg:.1f} deg"


fence = new_app("fence", "Where robots may fly.")
app.add_typer(fence)


@fence.command("on")
@options_of(WholeFleetOptions)
def fence_on(options: WholeFleetOptions) -> None:
    """Restore each robot's configured fence."""
    from lpac.ground.station.protocol import SetFence

    to = address(options.fleet, options.robots)
    ask(to, SetFence(None, to.robots), "fence on", as_json=options.as_json)


@fence.command("off")
@options_of(WholeFleetOptions)
def fence_off(options: WholeFleetOptions, *, yes: Yes = False) -> None:
    """Widen the fence to a square of 200 m around the origin. Asks first."""
    from lpac.ground.site import WIDE_FENCE_M, wide_fence
    from lpac.ground.station.protocol import SetFence

    to = address(options.fleet, options.robots)
    confirm(
        f"Let all robots of fleet {to.fleet} fly {WIDE_FENCE_M / 2:g} m far from the origin?",
        "fence off",
        yes=yes,
    )
    with subscribe(to) as subscriber:
        wide = wide_fence(subscriber.setup.fence)
    ask(to, SetFence(wide, to.robots), "fence off", as_json=options.as_json)


@fence.command("set", context_settings=_NUMBERS)
@options_of(WholeFleetOptions)
def fence_set(
    options: WholeFleetOptions,
    *,
    corners: Annotated[
        list[str], typer.Argument(metavar="X,Y...", help="Corners in the mission frame, m.")
    ],
    buffer: Annotated[
        float | None, typer.Option("--buffer", help="How far inside robots stop, m.")
    ] = None,
    floor: Annotated[float | None, typer.Option("--floor", help="Lowest height, m.")] = None,
    ceiling: Annotated[float | None, typer.Option("--ceiling", help="Greatest height, m.")] = None,
) -> None:
    """Set a convex polygon, such as 0,0 32,0 32,32 0,32.

    Buffer, floor and ceiling stay as configured unless given.
    """
    from edge.core.fence import Fence as Polygon
    from lpac.ground.station.protocol import SetFence

    to = address(options.fleet, options.robots)
    points = tuple(_point(corner) for corner in corners)
    with subscribe(to) as subscriber:
        configured = subscriber.setup.fence
    try:
        polygon = Polygon(
            points,
            configured.buffer_m if buffer is None else buffer,
            configured.floor_m if floor is None else floor,
            configured.ceiling_m if ceiling is None else ceiling,
        )
    except ValueError as error:
        raise ValueError(f"fence set: {error}") from None
    ask(to, SetFence(polygon, to.robots), "fence set", as_json=options.as_json)


def _point(text: str) -> "Point":
    try:
        x_m, y_m = map(float, text.split(","))
    except ValueError:
        raise ValueError(f"fence set: {text!r}: must be X,Y in m, such as 32,0") from None
    return x_m, y_m


@app.command()
@options_of(WholeFleetOptions)
def world(
    options: WholeFleetOptions,
    *,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A CoverageControl world file.")],
) -> None:
    """Send a world to the robots' virtual sensors. Refused in flight."""
    from edge.messages.mission import world_id
    from lpac.ground.script import read_world
    from lpac.ground.station.protocol import SetWorld

    to = address(options.fleet, options.robots)
    text = read_world(file)
    typer.echo(f"world: {file.name}, {world_id(text)}", err=True)
    ask(to, SetWorld(text, file.name, to.robots), "world", as_json=options.as_json)


@app.command()
@options_of(FleetOptions)
def assign(
    options: FleetOptions,
    *,
    site: Annotated[
        str, typer.Option("--site", help="Its pads; else those of the site in use.")
    ] = "",
    seconds: ListenSeconds = 2.0,
) -> None:
    """Assign each robot the slot (height, landing point) of the pad it stands on, by GPS.

    Refused if a robot is more than 3 m from every pad, if another pad is less than 1 m further than
    the nearest, or if two robots stand at one pad.
    """
    from lpac.ground.procedure import collect_statuses
    from lpac.ground.site import Sites, assign_places, mean_position_m, pads_in_use
    from lpac.ground.station.protocol import SetPlaces
    from lpac.ground.station.subscriber import addressed

    to = address(options.fleet, options.robots)
    with subscribe(to) as subscriber:
        setup, ground = subscriber.setup, subscriber.snapshot.ground
        names = addressed(setup, to.robots)
        if ground is None or ground.origin is None:
            raise ValueError("assign: the origin is not set: `lpac mission origin` sets it")
        pads = pads_in_use(Sites(to.path), site, setup, ground.origin)
        with interruptible("assign"):
            heard = subscriber.carry_out(collect_statuses(subscriber, names, seconds))
        places_m = {name: mean_position_m(name, heard[name], ground.origin) for name in names}
    assigned, places = assign_places(places_m, pads.slots, setup)
    typer.echo(f"pads of {pads.source}", err=True)
    details = {
        name: {"pad": on_pad.height, "m": round(on_pad.distance_m, 2)}
        for name, on_pad in assigned.items()
    }
    ask(to, SetPlaces(places), "assign", as_json=options.as_json, details=details)


def _add(name: str, about: str, kind: type[RobotsOptions] = RobotsOptions) -> None:
    """Add a command that sends one request to robots."""

    @options_of(kind)
    def command(options: RobotsOptions) -> None:
        from lpac.ground.station.protocol import SafetyCommand, of_robots

        to = _named(options, name)
        request = of_robots(name, to.robots)
        if isinstance(options, LandingOptions) and isinstance(request, SafetyCommand):
            request = replace(request, wait=options.wait)
        ask(to, request, name, as_json=options.as_json)

    app.command(name, help=about)(command)


_add("enable", "Allow the robots to run their checks and fly.")
_add("disable", "Forbid the robots to fly; those in the air hold.")


@app.command()
@options_of(RobotsOptions)
def takeoff(
    options: RobotsOptions,
    *,
    interval: Annotated[
        float, typer.Option("--interval", min=0, max=60, help="Between two robots, s.")
    ] = 2.0,
    abort_on_failure: Annotated[
        bool, typer.Option("--abort-on-failure", help="Start no more robots once one has failed.")
    ] = False,
    yes: Yes = False,
) -> None:
    """Take off, the highest first; done when all hold at their heights.

    Asks first at a terminal; without one it starts at once.
    """
    from lpac.ground.station.protocol import Takeoff

    to = _named(options, "takeoff")
    who = ", ".join(to.robots) or f"all robots of fleet {to.fleet}"
    confirm(
        f"Start the motors of {who}, and take off?",
        "takeoff",
        yes=yes or not sys.stdin.isatty(),
    )
    ask(to, Takeoff(to.robots, interval, abort_on_failure), "takeoff", as_json=options.as_json)


_add("start", "Fly the mission, from hold.")
_add("hold", "Hold position. Any ground station may command it.")
_add("resume", "Cancel hold, return or land; robots that flew the mission fly it again.")
_add("land", "Land at the present position.", LandingOptions)
_add(
    "return",
    "Fly to the landing points at their own heights, and land there, the lowest first.",
    LandingOptions,
)
_add(
    "pilot", "Hand robots to human pilots, by name: the program commands nothing until `rejoin`.",
    NamedOptions,
)  # fmt: skip
_add(
    "rejoin",
    "Take robots back from their pilots, by name: they hold; then `start`.",
    NamedOptions,
)


@app.command()
@options_of(RobotsOptions)
def disarm(options: RobotsOptions) -> None:
    """Stop the motors on the ground. A robot in the air refuses."""
    from lpac.ground.station.protocol import RobotCommand
    from lpac.ground.station.subscriber import addressed

    to = _named(options, "disarm")
    names = to.robots
    if not names:
        with subscribe(to) as subscriber:
            names = addressed(subscriber.setup, ())
    ask(to, RobotCommand("disarm", names), "disarm", as_json=options.as_json)


@app.command()
@options_of(NamedOptions)
def kill(options: NamedOptions, *, yes: Yes = False) -> None:
    """Stop the motors at once, also in the air: THE ROBOTS FALL. Asks first."""
    from lpac.ground.station.protocol import RobotCommand

    to = _named(options, "kill")
    confirm(f"KILL {', '.join(to.robots)}? What flies falls.", "kill", yes=yes)
    ask(to, RobotCommand("kill", to.robots), "kill", as_json=options.as_json)


@app.command()
@options_of(FleetOptions)
def again(
    options: FleetOptions,
    *,
    trial: Annotated[
        str, typer.Argument(metavar="[TRIAL]", help="Its name; else the next number.")
    ] = "",
) -> None:
    """Begin the next trial: robots discard explored maps and neighbours' messages."""
    from lpac.ground.station.protocol import NextTrial

    to = address(options.fleet, options.robots)
    ask(to, NextTrial(trial, to.robots), "again", as_json=options.as_json)


@app.command()
def command(fleet: Fleet = DEFAULT_FLEET, as_json: AsJson = False) -> None:
    """Take command of the fleet from another ground station."""
    from lpac.ground.station.protocol import TakeCommand

    ask(address(fleet, None), TakeCommand(), "command", as_json=as_json)


app.command()(rehearse)
app.command()(run)
