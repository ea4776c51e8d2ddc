"""`lpac fleet init`, `operator`, `members`, `revoke` and `rotate`: keys and membership."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lpac.cli.fleet.progress import print_outcomes, print_problems, require_all, run_for_each
from lpac.cli.options import DEFAULT_FLEET, AsJson, Fleet, Robots, open_fleet, user_at_host
from lpac.cli.printing import GOOD, print_table, styled

if TYPE_CHECKING:
    from rich.text import Text

    from edge.identity.members import Member
    from lpac.analysis.snapshot import FleetSnapshot
    from lpac.fleet.hold import Report
    from lpac.fleet.settings import FleetConfig, RobotHost


def init(
    fleet: Fleet = DEFAULT_FLEET,
    name: Annotated[
        str, typer.Option("--name", help="Your name in the fleet; else user@host.")
    ] = "",
) -> None:
    """Make the fleet's keys on this computer; the first `enroll` does it too."""
    from lpac.fleet.members import init as make_authority
    from lpac.fleet.settings import load_fleet

    authority = make_authority(load_fleet(fleet), name or user_at_host())
    typer.echo(f"made the fleet's keys: {authority.folder}")
    typer.echo(
        "keep a copy of that folder where nobody else can read it: anyone who has it can fly the "
        "fleet, and without it no robot can join"
    )


def operator(
    name: Annotated[str, typer.Argument(help="The ground station's name.")],
    out: Annotated[Path, typer.Option(help="New folder, to be moved to its laptop.")],
    fleet: Fleet = DEFAULT_FLEET,
    observer: Annotated[
        bool, typer.Option("--observer", help="It may only ask the fleet to hold.")
    ] = False,
) -> None:
    """Make keys, in the folder OUT, for another laptop as a ground station of the fleet.

    An earlier key of NAME leaves the list of members. All robots that answer get the new list.
    """
    from edge.identity.members import Role
    from lpac.fleet.authority import new_member
    from lpac.fleet.members import open_authority
    from lpac.fleet.settings import load_fleet

    if out.exists():
        raise ValueError(f"{out}: exists: give a new folder")
    role = Role.OBSERVER if observer else Role.OPERATOR
    config = load_fleet(fleet)
    authority, snapshot = open_authority(config), _snapshot(config)
    if snapshot is not None and snapshot.commander == name:
        raise ValueError(
            f"{name} commands the fleet, and would lose its key: let another ground station "
            "command first (`lpac mission command`), or end it"
        )
    new_member(authority, out, role, name)
    typer.echo(f"{out}: {name} is an {role} of fleet {config.fleet}")
    send_list(config)
    typer.echo(
        "move the folder to that laptop, so that nobody else can read it, and name it there in "
        f'{fleet.name}: keys = "FOLDER"'
    )


def members(fleet: Fleet = DEFAULT_FLEET, as_json: AsJson = False) -> None:
    """List the fleet's members."""
    from lpac.fleet.members import open_authority
    from lpac.fleet.settings import load_fleet

    known = open_authority(load_fleet(fleet)).members
    if as_json:
        described = [_facts(member) for member in known.members]
        typer.echo(json.dumps({"list": known.number, "members": described}))
        return
    rows: list[list[str | Text]] = [
        [member.name, member.role.value, "" if member.robot_id is None else str(member.robot_id)]
        for member in known.members
    ]
    print_table(("name", "role", "robot id"), rows, ("robot id",))
    typer.echo(f"list {known.number}")


def _facts(member: "Member") -> dict[str, object]:
    return {
        "name": member.name,
        "role": member.role.value,
        "robot_id": member.robot_id,
        "fingerprint": member.fingerprint.hex(),
    }


def send_list(config: "FleetConfig") -> None:
    """Send the list of members to all robots, and print which do not answer."""
    from lpac.fleet.members import send_members_to

    async def one(robot: "RobotHost", report: "Report") -> None:
        await send_members_to(config, robot, report)

    outcomes = run_for_each(tuple(config.robots.values()), one)
    if any(outcome.problem is not None for outcome in outcomes):
        print_problems(outcomes)
        typer.echo("these keep their old list of members until `lpac fleet up`")


def revoke(
    name: Annotated[str, typer.Argument(help="A robot or a ground station of the fleet.")],
    fleet: Fleet = DEFAULT_FLEET,
    in_flight: Annotated[
        bool, typer.Option("--in-flight", help="Even if it is in the air, or commands.")
    ] = False,
) -> None:
    """Exclude NAME from the fleet, for example if its drone or laptop was lost.

    It leaves the list of members. All robots that answer get the new list, also in flight. They
    keep away from where they last heard a robot that was revoked.
    """
    from lpac.fleet.members import open_authority
    from lpac.fleet.settings import load_fleet

    config = load_fleet(fleet)
    authority = open_authority(config)
    authority.named(name)
    why = _why_not_now(config, name)
    if why and not in_flight:
        raise ValueError(f"{why}: add --in-flight to revoke it anyway")
    authority.revoke(name)
    typer.echo(f"{name} is no longer a member")
    send_list(config)


def _why_not_now(config: "FleetConfig", name: str) -> str:
    """Reason not to revoke it now, as far as this laptop's ground station knows, or ""."""
    snapshot = _snapshot(config)
    if snapshot is None:
        return f"no `lpac ground` runs here, so it is unknown what {name} does now"
    if snapshot.commander == name:
        return f"{name} commands the fleet"
    return f"{name} was in the air when last heard" if name in _flying(snapshot) else ""


def _snapshot(config: "FleetConfig") -> "FleetSnapshot | None":
    """The fleet as this laptop's ground sees it; None if none runs."""
    from lpac.analysis.snapshot import FleetSnapshot
    from lpac.ground.station.client import GroundError, subscribe

    try:
        with subscribe(config.fleet) as answers:
            return next(each for each in answers if isinstance(each, FleetSnapshot))
    except GroundError:
        return None


def _flying(snapshot: "FleetSnapshot") -> list[str]:
    """Robots that were in the air when last heard."""
    from lpac.ground.station.station import is_down

    return [r.name for r in snapshot.robots if r.status is not None and not is_down(r.status)]


def rotate(fleet: Fleet = DEFAULT_FLEET, robots: Robots = None) -> None:
    """Renew the keys of the robots on the ground, and of this computer without --robots.

    The old keys leave the list of members. A robot in flight refuses, and keeps its key. Without
    --robots, nothing is renewed while `lpac ground` on this computer has a robot in flight.
    """
    from edge.identity.members import Role
    from lpac.fleet.authority import new_member
    from lpac.fleet.members import open_authority, renew_key

    config, chosen = open_fleet(fleet, robots)
    authority = open_authority(config)
    snapshot = _snapshot(config) if robots is None else None
    if snapshot is not None and (flying := _flying(snapshot)):
        raise ValueError(
            f"{', '.join(flying)}: in the air when last heard, and would lose this computer's "
            "ground station: land them first, or choose other robots with --robots"
        )

    async def one(robot: "RobotHost", report: "Report") -> None:
        report("new key", None)
        await renew_key(config, robot, report)

    outcomes = run_for_each(chosen, one)
    print_outcomes(outcomes, lambda _: (styled("new key", GOOD),))
    own = authority.own_name()
    if own is not None and robots is None:
        new_member(authority, authority.folder, Role.OPERATOR, own)
        typer.echo(f"{own} has a new key: start `lpac ground` again")
    authority.renew_group_key()
    send_list(config)
    for member in sorted(authority.members.members, key=lambda member: member.name):
        if member.robot_id is None and member.name != own:
            observer = " --observer" if member.role is Role.OBSERVER else ""
            typer.echo(
                f"{member.name} keeps its key: `lpac fleet operator {member.name} --out DIR"
                f"{observer}` makes a new one"
            )
    require_all(outcomes, "renewed on")
