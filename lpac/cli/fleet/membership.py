"""`lpac fleet enroll`, `swap` and `pull`: a robot comes, one is replaced, a trial is taken home."""

import asyncio
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lpac.cli.fleet.progress import print_json, print_problems, require_all, run_for_each
from lpac.cli.options import DEFAULT_FLEET, AsJson, Fleet, Robots, open_fleet, user_at_host
from lpac.cli.printing import GOOD, print_table, styled

if TYPE_CHECKING:
    from rich.text import Text

    from lpac.fleet.hold import Report
    from lpac.fleet.pull import Pulled
    from lpac.fleet.settings import RobotHost

_STEP_WIDTH = 14


def enroll(
    name: Annotated[
        str | None,
        typer.Argument(help="The robot's name in the fleet, such as r11; else all of the file."),
    ] = None,
    host: Annotated[
        str | None,
        typer.Argument(
            help="Its address, or its name in ssh's configuration; not needed if the file has it."
        ),
    ] = None,
    fleet: Fleet = DEFAULT_FLEET,
    user: Annotated[
        str | None, typer.Option(help="Who logs in: root (the default), or a user with sudo.")
    ] = None,
    port: Annotated[int | None, typer.Option(help="Its ssh port, if not ssh's own.")] = None,
    address: Annotated[
        str | None,
        typer.Option(help="Its IPv4 address for the other robots, if HOST's is not that."),
    ] = None,
    robot_id: Annotated[
        int | None,
        typer.Option(help="Its id in the fleet; by default, if new, the number in its name."),
    ] = None,
    yes: Annotated[
        bool, typer.Option("--yes", help="Even if it is enrolled as another robot.")
    ] = False,
) -> None:
    """Make a computer with a vehicle a robot of the fleet; may be repeated at any time.

    It gets a key, a place in the fleet's file as a spare, an id and a card; voxl-vision-hub is set,
    programs that commanded the vehicle before are stopped; then come the release and PX4's
    parameters. ssh asks for the password, if it is needed.
    """
    from lpac.fleet.settings import load_fleet

    options = {"host": host, "--user": user, "--port": port, "--address": address,
               "--robot-id": robot_id}  # fmt: skip
    given = [option for option, value in options.items() if value is not None]
    if name is None and given:
        raise ValueError(f"{given[0]} is one robot's: give its name too")
    names = list(load_fleet(fleet).robots) if name is None else [name]
    if not names:
        raise ValueError(f"{fleet}: has no robots yet: give a name and an address")
    left = {}
    for each in names:
        if len(names) > 1:
            typer.echo(f"{each}:")
        left[each] = _enroll(
            fleet, each, host, user=user, port=port, address=address, robot_id=robot_id, rename=yes
        )
    problems = [
        f"{each} is not ready: left to do: {', '.join(steps)}"
        for each, steps in left.items()
        if steps
    ]
    if problems:
        raise ValueError("; ".join(problems))
    are = "is" if len(names) == 1 else "are"
    typer.echo(
        f"{', '.join(names)} {are} enrolled; `lpac fleet doctor --robots {','.join(names)}` looks "
        "at the rest"
    )


def _enroll(
    fleet: Path,
    name: str,
    host: str | None,
    *,
    user: str | None,
    port: int | None,
    address: str | None,
    robot_id: int | None,
    rename: bool,
) -> list[str]:
    """Print each step; those that are left to do."""
    from lpac.fleet.enroll import EnrolStep
    from lpac.fleet.enroll import enroll as enroll_robot

    left: list[str] = []

    def on_step(step: EnrolStep) -> None:
        _say("")
        typer.echo(f"{step.name:{_STEP_WIDTH}} {step.outcome}")
        for note in step.notes:
            typer.echo(f"{'':{_STEP_WIDTH}} {note}")
        if step.outcome == "left to do":
            left.append(step.name)

    asyncio.run(
        enroll_robot(
            fleet, name, host, user=user, port=port, address=address, robot_id=robot_id,
            rename=rename, operator=user_at_host, on_step=on_step, say=_say,
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
    from lpac.fleet.settings import load_fleet
    from lpac.fleet.swap import swap as swap_robots

    def report(step: str, share: float | None) -> None:
        _say(step if share is None else f"{step} {100.0 * share:.0f} %")

    swapped = asyncio.run(swap_robots(fleet, failed, spare, report, user_at_host))
    _say("")
    slot = load_fleet(fleet).slots[swapped.slot]
    deployed = swapped.deployed
    if not swapped.changed:
        typer.secho(
            f"{spare:6} had the slot already; the other way round it is `lpac fleet swap {spare} "
            f"{failed}`",
            fg="yellow",
        )
    if swapped.silent is None:
        typer.echo(f"{failed:6} stopped; it does not start at boot either")
    else:
        typer.secho(f"{failed:6} was not stopped: {swapped.silent}", fg="yellow")
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

    outcomes = run_for_each(chosen, one)
    if as_json:
        print_json(config, outcomes, lambda pulled: pulled._asdict())
    else:
        rows: list[list[str | Text]] = [
            [o.robot.name, "", "", "", ""]
            if o.value is None
            else [
                o.robot.name, str(o.value.files), f"{o.value.size_bytes / 1e6:.1f}",
                f"{o.value.sent_bytes / 1e6:.1f}", styled(o.value.summary, GOOD),
            ]
            for o in outcomes
        ]  # fmt: skip
        headings = ("robot", "files", "MB", "MB sent", "result")
        print_table(headings, rows, headings[1:4])
        print_problems(outcomes)
    require_all(outcomes, "pulled from")


def _say(text: str) -> None:
    """What is being done, on a terminal only; the next text takes its place."""
    if sys.stderr.isatty():
        sys.stderr.write(f"\r\x1b[K{text[:78]}")
        sys.stderr.flush()
