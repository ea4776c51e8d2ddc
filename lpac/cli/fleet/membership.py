"""`lpac fleet enroll`, `swap` and `pull`: a robot comes, one is replaced, a trial is taken home."""

import asyncio
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lpac.cli.fields import flag_of, options_of
from lpac.cli.fleet.keys import send_list
from lpac.cli.fleet.progress import run_for_each, tell
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
        typer.Argument(help="The robot's name in the fleet, such as r11; else all of the file."),
    ] = None
    host: Annotated[
        str | None,
        typer.Argument(
            help="Its address, or its name in ssh's configuration; not needed if the file has it."
        ),
    ] = None
    fleet: Fleet = DEFAULT_FLEET
    user: Annotated[str | None, "Who logs in: root (the default), or a user with sudo."] = None
    port: Annotated[int | None, "Its ssh port, if not ssh's own."] = None
    address: Annotated[
        str | None, "Its IPv4 address for the other robots, if HOST's is not that."
    ] = None
    robot_id: Annotated[
        int | None, "Its id in the fleet; by default, if new, the number in its name."
    ] = None
    yes: Annotated[bool, "Even if it is enrolled as another robot."] = False


@options_of(EnrollOptions)
def enroll(of: EnrollOptions) -> None:
    """Make a computer with a vehicle a robot of the fleet; may be repeated at any time.

    It gets a key, a place in the fleet's file as a spare, an id, and a line in the list of members,
    which all robots that answer are brought; voxl-vision-hub is set, programs that commanded the
    vehicle before are stopped; then come the release and PX4's parameters. ssh asks for the
    password, if it is needed.
    """
    from lpac.fleet.settings import load_fleet

    if of.name is None:
        for option in ("host", "user", "port", "address", "robot_id"):
            if getattr(of, option) is not None:
                flag = option if option == "host" else flag_of(option)
                raise ValueError(f"{flag} is one robot's: give its name too")
    names = list(load_fleet(of.fleet).robots) if of.name is None else [of.name]
    if not names:
        raise ValueError(f"{of.fleet}: has no robots yet: give a name and an address")
    left = []
    before = _members(of.fleet)
    try:
        for name in names:
            if len(names) > 1:
                typer.echo(f"{name}:")
            if steps := _enroll(name, of):
                left.append(f"{name} is not ready: left to do: {', '.join(steps)}")
    finally:
        if _members(of.fleet) != before:
            send_list(load_fleet(of.fleet))
    if left:
        raise ValueError("; ".join(left))
    are = "is" if len(names) == 1 else "are"
    typer.echo(
        f"{', '.join(names)} {are} enrolled; `lpac fleet doctor --robots {','.join(names)}` looks "
        "at the rest"
    )


def _members(fleet: Path) -> bytes | None:
    """This computer's list of members, None without one."""
    from edge.drivers.identity_folder import MEMBERS
    from lpac.fleet.settings import load_fleet

    keys = load_fleet(fleet).keys
    return None if keys is None or not (keys / MEMBERS).exists() else (keys / MEMBERS).read_bytes()


def _enroll(name: str, of: EnrollOptions) -> list[str]:
    """Print each step; those that are left to do."""
    from lpac.fleet.enroll import enroll as enroll_robot
    from lpac.fleet.setup import EnrollStep

    left: list[str] = []

    def on_step(step: EnrollStep) -> None:
        _say("")
        typer.echo(f"{step.name:{_STEP_WIDTH}} {step.outcome}")
        for note in step.notes:
            typer.echo(f"{'':{_STEP_WIDTH}} {note}")
        if step.outcome == "left to do":
            left.append(step.name)

    asyncio.run(
        enroll_robot(
            of.fleet, name, of.host, user=of.user, port=of.port, address=of.address,
            robot_id=of.robot_id, rename=of.yes, operator=user_at_host, on_step=on_step,
            on_progress=_say,
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
        _say(step if share is None else f"{step} {100.0 * share:.0f} %")

    swapped = asyncio.run(swap_robots(fleet, failed, spare, report, user_at_host))
    _say("")
    _print_swapped(fleet, failed, spare, swapped)


def _print_swapped(fleet: Path, failed: str, spare: str, swapped: "Swapped") -> None:
    from lpac.fleet.settings import load_fleet

    slot = load_fleet(fleet).slots[swapped.slot]
    deployed = swapped.deployed
    if not swapped.changed:
        typer.secho(
            f"{spare:6} had the slot already; the other way round it is `lpac fleet swap {spare} "
            f"{failed}`",
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
        str | None, typer.Option(help="Only what belongs to it; else whatever is new.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder of trials.")] = Path("trials"),
    as_json: AsJson = False,
) -> None:
    """Fetch flight logs, PX4's logs and parameters, journal and configuration; may be repeated.

    They come to OUT/TRIAL/ROBOT, checked against the robots' checksums. A robot in flight refuses.
    """
    from lpac.fleet.pull import pull as pull_from

    config, chosen = open_fleet(fleet, robots)

    async def one(robot: "RobotHost", report: "Report") -> "Pulled":
        return await pull_from(config, robot, trial, out, report)

    tell(
        config, run_for_each(chosen, one), "pulled from", as_json=as_json, cells=_pulled_cells,
        numbers=("files", "MB", "MB sent"), describe=lambda pulled: pulled._asdict(),
    )  # fmt: skip


def _pulled_cells(value: "Pulled") -> tuple["str | Text", ...]:
    sizes = (f"{size / 1e6:.1f}" for size in (value.size_bytes, value.sent_bytes))
    return str(value.files), *sizes, styled(value.summary, GOOD)


def _say(text: str) -> None:
    """Show the present step, on a terminal only; the next text takes its place."""
    if sys.stderr.isatty():
        sys.stderr.write(f"\r\x1b[K{text[:78]}")
        sys.stderr.flush()
