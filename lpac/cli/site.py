"""`lpac site`: save where a fleet flies, and fly there again."""

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import typer

from lpac.cli.apps import new_app
from lpac.cli.fields import options_of
from lpac.cli.ground_requests import (
    Addressed,
    ListenSeconds,
    address,
    interruptible,
    measure,
    print_json,
    show,
    subscribe,
)
from lpac.cli.options import DEFAULT_FLEET, AsJson, Fleet, FleetOptions, Robots
from lpac.cli.printing import BAD, print_table, styled

if TYPE_CHECKING:
    from lpac.ground.site import SavedSite

app = new_app(
    "site", "Places to fly at: origin, fence, pads and landing points, beside fleet.toml."
)

Name = Annotated[str, typer.Argument(metavar="NAME", help="The site's name.")]


@dataclass(frozen=True, slots=True, kw_only=True)
class SiteOptions:
    """Options of `lpac site save`."""

    name: Name
    from_robot: Annotated[
        str,
        typer.Option("--from", help="Take this robot's position as origin; else the present one."),
    ] = ""
    toward: Annotated[str, "The y axis points to this robot; with --from."] = ""
    land_at_pads: Annotated[bool, "Robots land where they stand now."] = False
    seconds: ListenSeconds = 5.0
    force: Annotated[bool, "Replace a site of that name."] = False


@app.command()
@options_of(SiteOptions, FleetOptions)
def save(site: SiteOptions, options: FleetOptions) -> None:
    """Save origin, fence, and the present positions of the slots' robots as pads.

    Nothing is sent to the robots until `lpac site use NAME`.
    """
    from lpac.ground.site import Sites

    if site.toward and not site.from_robot:
        raise ValueError("site save: --toward needs --from")
    to = address(options.fleet, options.robots)
    sites = Sites(to.path)
    if not site.force:
        sites.require_new(site.name)
    saved = _as_it_stands(to, site)
    path = sites.save(site.name, saved)
    if options.as_json:
        print_json({"site": site.name, "path": str(path), **dataclasses.asdict(saved)})
    else:
        _print_slots(saved)
        typer.echo(f"\n{path}: `lpac site use {site.name}` takes it")


def _as_it_stands(to: Addressed, site: SiteOptions) -> "SavedSite":
    from lpac.ground.site import measure_site
    from lpac.ground.station.subscriber import addressed

    with subscribe(to) as subscriber:
        names = addressed(subscriber.setup, to.robots)
        measured = {*names, *filter(None, (site.from_robot, site.toward))}
        stands = measure(subscriber, sorted(measured), site.seconds)
        return measure_site(
            subscriber.setup,
            subscriber.snapshot.state,
            {robot: stands[robot] for robot in names},
            stands.get(site.from_robot),
            stands.get(site.toward),
            land_at_pads=site.land_at_pads,
        )


@app.command()
def use(
    name: Name, fleet: Fleet = DEFAULT_FLEET, robots: Robots = None, as_json: AsJson = False
) -> None:
    """Send a site's origin, fence and landing points to the fleet. Refused in flight."""
    from lpac.ground.script import take_site
    from lpac.ground.site import Sites

    to = address(fleet, robots)
    sites = Sites(to.path)
    site = sites.load(name)
    with subscribe(to) as subscriber, interruptible("site use"):
        report = subscriber.carry_out(take_site(site, subscriber.setup, to.robots))
    if report.problem is None:
        sites.use(name)
    show(to, report, "site use", as_json=as_json, details={})


@app.command("list")
def list_(fleet: Fleet = DEFAULT_FLEET, as_json: AsJson = False) -> None:
    """List the saved sites, and mark the last used one."""
    from lpac.ground.site import Sites

    sites = Sites(address(fleet, None).path)
    saved: dict[str, SavedSite] = {}
    problems: dict[str, str] = {}
    for name in sites.names():
        try:
            saved[name] = sites.load(name)
        except ValueError as error:
            problems[name] = str(error)
    used = sites.used()
    if as_json:
        described = {
            name: {"used": name == used, "problem": None, **dataclasses.asdict(site)}
            for name, site in saved.items()
        } | {name: {"used": name == used, "problem": why} for name, why in problems.items()}
        print_json({"sites": described})
        return
    if not saved and not problems:
        typer.echo(f"{sites.folder}: no sites: `lpac site save NAME` saves one")
        return
    headings = ("site", "latitude", "longitude", "heading", "slots", "")
    print_table(
        headings,
        [
            [
                name, f"{site.origin.latitude_deg:.6f}", f"{site.origin.longitude_deg:.6f}",
                f"{site.origin.heading_deg:.1f}", str(len(site.slots)),
                "used last" if name == used else "",
            ]
            for name, site in saved.items()
        ] + [[name, "", "", "", "", styled("unreadable", BAD)] for name in problems],
        headings[1:5],
    )  # fmt: skip
    for why in problems.values():
        typer.echo(why, err=True)


def _print_slots(site: "SavedSite") -> None:
    headings = ("height", "pad x", "y m", "landing x", "y m ")
    print_table(
        headings,
        [
            [str(slot.height), *(f"{c:.1f}" for c in (*slot.pad_m, *slot.landing_point_m))]
            for slot in site.slots
        ],
        headings,
    )
