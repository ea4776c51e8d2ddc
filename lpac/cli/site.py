"""`lpac site`: save where a fleet flies, and fly there again."""

import dataclasses
from typing import TYPE_CHECKING, Annotated

import typer

from lpac.cli.apps import new_app
from lpac.cli.ground_requests import address, interruptible, looking, measure, print_json, show
from lpac.cli.options import DEFAULT_FLEET, AsJson, Fleet, Robots
from lpac.cli.printing import BAD, print_table, styled

if TYPE_CHECKING:
    from lpac.ground.site import SavedSite

app = new_app(
    "site", "Places to fly at: origin, fence, pads and landing points, beside fleet.toml."
)

Name = Annotated[str, typer.Argument(metavar="NAME", help="The site's name.")]


@app.command()
def save(
    name: Name,
    from_robot: Annotated[
        str, typer.Option("--from", help="The origin is where this robot stands; else as it is.")
    ] = "",
    toward: Annotated[
        str, typer.Option("--toward", help="The y axis points to this robot; with --from.")
    ] = "",
    land_at_pads: Annotated[
        bool, typer.Option("--land-at-pads", help="Robots land where they stand now.")
    ] = False,
    seconds: Annotated[
        float, typer.Option("--seconds", min=0.5, max=600, help="How long to listen.")
    ] = 5.0,
    force: Annotated[bool, typer.Option("--force", help="Replace a site of that name.")] = False,
    fleet: Fleet = DEFAULT_FLEET,
    robots: Robots = None,
    as_json: AsJson = False,
) -> None:
    """Save origin, fence, and as pads where the robots of the slots stand now.

    Nothing is told to the robots: `lpac site use NAME` does that.
    """
    from lpac.ground.site import Sites, site_as_it_stands
    from lpac.ground.station.subscriber import addressed

    if toward and not from_robot:
        raise ValueError("site save: --toward needs --from")
    to = address(fleet, robots)
    sites = Sites(to.path)
    if not force:
        sites.require_new(name)
    with looking(to) as subscriber:
        names = addressed(subscriber.setup, to.robots)
        measured = {*names, *filter(None, (from_robot, toward))}
        stands = measure(subscriber, sorted(measured), seconds)
        site = site_as_it_stands(
            subscriber.setup,
            subscriber.snapshot.ground,
            {robot: stands[robot] for robot in names},
            stands.get(from_robot),
            stands.get(toward),
            land_at_pads=land_at_pads,
        )
    path = sites.save(name, site)
    if as_json:
        print_json({"site": name, "path": str(path), **_described(site)})
    else:
        _print_slots(site)
        typer.echo(f"\n{path}: `lpac site use {name}` takes it")


@app.command()
def use(
    name: Name, fleet: Fleet = DEFAULT_FLEET, robots: Robots = None, as_json: AsJson = False
) -> None:
    """Have the fleet fly at a site: its origin, fence and landing points. Refused in flight."""
    from lpac.ground.script import take_site
    from lpac.ground.site import Sites

    to = address(fleet, robots)
    sites = Sites(to.path)
    site = sites.load(name)
    with looking(to) as subscriber, interruptible("site use"):
        report = subscriber.carry_out(take_site(site, subscriber.setup, to.robots))
    if report.problem is None:
        sites.use(name)
    show(to, report, "site use", as_json=as_json, details={})


@app.command("list")
def list_(fleet: Fleet = DEFAULT_FLEET, as_json: AsJson = False) -> None:
    """Show the sites that were saved, and which was used last."""
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
            name: {"used": name == used, "problem": None, **_described(site)}
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


def _described(site: "SavedSite") -> dict[str, object]:
    return dataclasses.asdict(site)
