"""`lpac fleet init`, `operator`, `members`, `revoke` and `rotate`: who belongs to the fleet."""

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
        str, typer.Option("--name", help="What you are called in the fleet; else user@host.")
    ] = "",
) -> None:
    """Make the fleet's keys on this computer; the first `enroll` does it too."""
    from lpac.fleet.members import init as make_authority
    from lpac.fleet.settings import load_fleet

    authority = make_authority(load_fleet(fleet), name or user_at_host())
    typer.echo(f"made the fleet's keys: {authority.folder}")
    typer.echo(
        "keep a copy of that folder where nobody else can read it: whoever has it can fly the "
        "fleet, and without it no robot joins"
    )


def operator(
    name: Annotated[str, typer.Argument(help="What that ground station is called.")],
    out: Annotated[Path, typer.Option(help="The new folder that its laptop gets.")],
    fleet: Fleet = DEFAULT_FLEET,
    observer: Annotated[
        bool, typer.Option("--observer", help="It may ask the fleet to hold, and nothing else.")
    ] = False,
) -> None:
    """Make another laptop a ground station of the fleet: the folder OUT, for it alone.

    A key that NAME had before is taken off the list of members, which all robots that answer are
    brought.
    """
    from edge.identity.members import Role
    from lpac.fleet.authority import new_member
    from lpac.fleet.members import open_authority
    from lpac.fleet.settings import load_fleet

    if out.exists():
        raise ValueError(f"{out}: is there already: give a new folder")
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
        f"move the folder to that laptop, by a way that nobody else can read, and name it there "
        f'in {fleet.name}: keys = "FOLDER"'
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
    """Bring the list of members to all robots that answer, and print which do not."""
    from lpac.fleet.members import send_members_to

    async def one(robot: "RobotHost", report: "Report") -> None:
        await send_members_to(config, robot, report)

    outcomes = run_for_each(tuple(config.robots.values()), one)
    if any(outcome.problem is not None for outcome in outcomes):
        print_problems(outcomes)
        typer.echo("these keep the list of members that they have until `lpac fleet up`")


def revoke(
    name: Annotated[str, typer.Argument(help="A robot or a ground station of the fleet.")],
    fleet: Fleet = DEFAULT_FLEET,
    in_flight: Annotated[
        bool, typer.Option("--in-flight", help="Also if it is in the air, or commands.")
    ] = False,
) -> None:
    """Let nobody listen to NAME any more: its drone or laptop was lost.

    It is taken off the list of members, which all robots that answer are brought, also in flight.
    Robots keep away from where they heard one last that left.
    """
    from lpac.fleet.members import open_authority
    from lpac.fleet.settings import load_fleet

    config = load_fleet(fleet)
    authority = open_authority(config)
    authority.named(name)
    why = _why_not_now(config, name)
    if why and not in_flight:
        raise ValueError(f"{why}: add --in-flight if that is what you want")
    authority.revoke(name)
    typer.echo(f"{name} is no member any more")
    send_list(config)


def _why_not_now(config: "FleetConfig", name: str) -> str:
    """Reason against it as far as this laptop's ground knows; "" if there is none."""
    snapshot = _snapshot(config)
    if snapshot is None:
        return f"no `lpac ground` runs here, so nobody knows what {name} does now"
    if snapshot.commander == name:
        return f"{name} commands the fleet"
    return f"{name} was heard in the air last" if name in _flying(snapshot) else ""


def _snapshot(config: "FleetConfig") -> "FleetSnapshot | None":
    """The fleet as this laptop's ground sees it; None if none runs."""
    from lpac.analysis.snapshot import FleetSnapshot
    from lpac.ground.station.client import GroundError, subscribe

    try:
        with subscribe(config.fleet) as told:
            return next(t for t in told if isinstance(t, FleetSnapshot))
    except GroundError:
        return None


def _flying(snapshot: "FleetSnapshot") -> list[str]:
    """Robots that were last heard in the air."""
    from lpac.ground.station.station import is_down

    return [r.name for r in snapshot.robots if r.status is not None and not is_down(r.status)]


def rotate(fleet: Fleet = DEFAULT_FLEET, robots: Robots = None) -> None:
    """Renew everybody's keys: robots on the ground get new ones, and this computer.

    The old keys leave the list of members. A robot in flight refuses, and keeps its own; so does
    this computer while one flies that its `lpac ground` may command.
    """
    from edge.identity.members import Role
    from lpac.fleet.authority import new_member
    from lpac.fleet.members import open_authority, renew_key

    config, chosen = open_fleet(fleet, robots)
    authority = open_authority(config)
    snapshot = _snapshot(config) if robots is None else None
    if snapshot is not None and (flying := _flying(snapshot)):
        raise ValueError(
            f"{', '.join(flying)} flew when last heard, and would lose this computer's ground: "
            "land them first, or name the robots that are to get new keys"
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
