"""`lpac fleet enroll`, `swap` and `pull`: add robots, replace one, and fetch its logs."""

import asyncio
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lpac.cli.fields import flag_of, options_of
from lpac.cli.fleet.keys import send_list
from lpac.cli.fleet.progress import print_results, run_for_each
from lpac.cli.options import DEFAULT_FLEET, AsJson, Fleet, Robots, open_fleet, user_at_host
from lpac.cli.printing import GOOD, styled

if TYPE_CHECKING:
    from rich.text import Text

    from lpac.fleet.hold import Report
    from lpac.fleet.pull import Pulled
    from lpac.fleet.settings import RobotHost
    from lpac.fleet.swap import Swapped

_STEP_WIDTH = 14


@dataclass(frozen=True, slots=True, kw_only=True)
class EnrollOptions:
    """Arguments of `lpac fleet enroll`: the computer, and its robot's name and id."""

    name: Annotated[
        str | None,
        typer.Argument(help="The robot's name in the fleet, such as r11; else all in the file."),
    ] = None
    host: Annotated[
        str | None,
        typer.Argument(
            help="Its address, or its name in ssh's configuration; not needed if the file has it."
        ),
    ] = None
    fleet: Fleet = DEFAULT_FLEET
    user: Annotated[str | None, "Its login: root (the default), or a user with sudo."] = None
    port: Annotated[int | None, "Its SSH port, if not ssh's default."] = None
    address: Annotated[
        str | None, "Its IPv4 address for the other robots, if it is not HOST's."
    ] = None
    robot_id: Annotated[
        int | None, "Its id in the fleet; for a new robot by default the number in its name."
    ] = None
    yes: Annotated[bool, "Even if it is enrolled as another robot."] = False


@options_of(EnrollOptions)
def enroll(options: EnrollOptions) -> None:
    """Make a vehicle's computer a robot of the fleet; may be repeated at any time.

    It gets a key, an id, a place in the fleet's file as a spare, and a line in the list of members.
    All robots that answer get the new list. voxl-vision-hub is set up, and other programs that
    command the vehicle are stopped. Then the release and PX4's parameters follow. ssh asks for the
    password, if it is needed.
    """
    from lpac.fleet.settings import load_fleet

    if options.name is None:
        for option in ("host", "user", "port", "address", "robot_id"):
            if getattr(options, option) is not None:
                flag = option if option == "host" else flag_of(option)
                raise ValueError(f"{flag} is for one robot: give its name too")
    names = list(load_fleet(options.fleet).robots) if options.name is None else [options.name]
    if not names:
        raise ValueError(f"{options.fleet}: has no robots yet: give a name and an address")
    left = []
    before = _members(options.fleet)
    try:
        for name in names:
            if len(names) > 1:
                typer.echo(f"{name}:")
            if steps := _enroll(name, options):
                left.append(f"{name} is not ready: left to do: {', '.join(steps)}")
    finally:
        if _members(options.fleet) != before:
            send_list(load_fleet(options.fleet))
    if left:
        raise ValueError("; ".join(left))
    are = "is" if len(names) == 1 else "are"
    typer.echo(
        f"{', '.join(names)} {are} enrolled; `lpac fleet doctor --robots {','.join(names)}` checks "
        "the rest"
    )


def _members(fleet: Path) -> bytes | None:
    """This computer's list of members, None without one."""
    from edge.drivers.identity_folder import MEMBERS
    from lpac.fleet.settings import load_fleet

    keys = load_fleet(fleet).keys
    return None if keys is None or not (keys / MEMBERS).exists() else (keys / MEMBERS).read_bytes()


def _enroll(name: str, options: EnrollOptions) -> list[str]:
    """Enroll a robot, print each step, and return those left to do."""
    from lpac.fleet.enroll import enroll as enroll_robot
    from lpac.fleet.setup import EnrollStep

    left: list[str] = []

    def on_step(step: EnrollStep) -> None:
        _show_step("")
        typer.echo(f"{step.name:{_STEP_WIDTH}} {step.outcome}")
        for note in step.notes:
            typer.echo(f"{'':{_STEP_WIDTH}} {note}")
        if step.outcome == "left to do":
            left.append(step.name)

    asyncio.run(
        enroll_robot(
            options.fleet, name, options.host, user=options.user, port=options.port,
            address=options.address, robot_id=options.robot_id, rename=options.yes,
            operator=user_at_host, on_step=on_step, on_progress=_show_step,
        )
    )  # fmt: skip
    return left


def swap(
    failed: Annotated[str, typer.Argument(help="The robot that cannot fly.")],
    spare: Annotated[str, typer.Argument(help="The enrolled robot that is to fly instead.")],
    fleet: Fleet = DEFAULT_FLEET,
) -> None:
    """Let a spare fly in a failed robot's slot: pad, height, landing point; may be repeated.

    The failed robot is stopped if it answers; one in flight refuses.
    """
    from lpac.fleet.swap import swap as swap_robots

    def report(step: str, share: float | None) -> None:
        _show_step(step if share is None else f"{step} {100.0 * share:.0f} %")

    swapped = asyncio.run(swap_robots(fleet, failed, spare, report, user_at_host))
    _show_step("")
    _print_swapped(fleet, failed, spare, swapped)


def _print_swapped(fleet: Path, failed: str, spare: str, swapped: "Swapped") -> None:
    from lpac.fleet.settings import load_fleet

    slot = load_fleet(fleet).slots[swapped.slot]
    deployed = swapped.deployed
    if not swapped.changed:
        typer.secho(
            f"{spare:6} had the slot already; to swap back: `lpac fleet swap {spare} {failed}`",
            fg="yellow",
        )
    if swapped.not_stopped is None:
        typer.echo(f"{failed:6} stopped; it does not start at boot either")
    else:
        typer.secho(f"{failed:6} was not stopped: {swapped.not_stopped}", fg="yellow")
        typer.echo(
            f"{'':6} if it comes back, its program starts with the same height and landing point; "
            f"then it and {spare} both fail their checks and do not take off. Then run `lpac fleet "
            f"deploy --robots {failed}`: that makes it a spare"
        )
    typer.echo(
        f"{spare:6} runs release {deployed.release} ({deployed.sent_bytes / 1e6:.1f} MB sent): "
        f"pad {list(slot.pad_m)} m, height {slot.height}, landing point "
        f"{list(slot.landing_point_m)} m"
    )
    others = ", ".join(swapped.callers)
    typer.echo(
        f"{'':6} put it on that pad; "
        + (
            f"{others} may not know {spare}, if deployed before it was in the file: `lpac fleet "
            "status` marks what needs a deploy"
            if others
            else f"no other robot needs a deploy, since {spare} calls them all"
        )
    )


def pull(
    fleet: Fleet = DEFAULT_FLEET,
    robots: Robots = None,
    trial: Annotated[
        str | None, typer.Option(help="Only this trial; else all that is new.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder of trials.")] = Path("trials"),
    as_json: AsJson = False,
) -> None:
    """Fetch flight logs, PX4's logs and parameters, journal and configuration; may be repeated.

    They go to OUT/TRIAL/ROBOT, verified by checksum. A robot in flight refuses.
    """
    from lpac.fleet.pull import pull as pull_from

    config, chosen = open_fleet(fleet, robots)

    async def one(robot: "RobotHost", report: "Report") -> "Pulled":
        return await pull_from(config, robot, trial, out, report)

    print_results(
        config, run_for_each(chosen, one), "pulled from", as_json=as_json, cells=_pulled_cells,
        numbers=("files", "MB", "MB sent"), describe=lambda pulled: pulled._asdict(),
    )  # fmt: skip


def _pulled_cells(value: "Pulled") -> tuple["str | Text", ...]:
    sizes = (f"{size / 1e6:.1f}" for size in (value.size_bytes, value.sent_bytes))
    return str(value.files), *sizes, styled(value.summary, GOOD)


def _show_step(text: str) -> None:
    """Show the present step, on a terminal only; the next text takes its place."""
    if sys.stderr.isatty():
        sys.stderr.write(f"\r\x1b[K{text[:78]}")
        sys.stderr.flush()
