"""`lpac ground`: the ground station's process."""

import asyncio
import contextlib
import signal
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated

import typer

from lpac.cli.apps import new_app
from lpac.cli.options import DEFAULT_FLEET, Fleet, user_at_host

if TYPE_CHECKING:
    from lpac.analysis.snapshot import FleetSetup, GroundEvent
    from lpac.ground.station.server import GroundProcess

app = new_app()

_AGAIN_S = 5.0
_LOOK_AGAIN_S = 1.0
_LONGEST_NAME = 64


@app.command()
def ground(
    fleet: Fleet = DEFAULT_FLEET,
    name: Annotated[
        str,
        typer.Option("--name", help="This station's name; by default its member's, or user@host."),
    ] = "",
) -> None:
    """Run the ground station until Ctrl-C; `lpac mission`, `watch` and others need it.

    It commands nothing on its own. Started again, it continues where the last one stopped.
    """
    from edge.core.counted import counted
    from lpac.ground.station.config import load_ground
    from lpac.ground.station.server import GroundProcess

    if not name.isprintable() or len(name) > _LONGEST_NAME:
        raise ValueError(f"--name {name!r}: must be at most {_LONGEST_NAME} printable characters")
    config = load_ground(fleet, name or None, default_name=user_at_host)
    # Texts of robots may have characters that this terminal cannot encode.
    sys.stdout.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
    process = GroundProcess(config, _print_event)
    started = (
        f"ground station {config.setup.operator} of fleet {config.setup.fleet}, "
        f"{counted(len(config.setup.robots), 'robot')}: Ctrl-C ends it"
    )
    asyncio.run(_run(process, config.setup, lambda: typer.echo(started)))


async def _run(
    process: "GroundProcess", setup: "FleetSetup", on_listening: Callable[[], None]
) -> None:
    hold_s = setup.ground_timeout_s
    land_s = hold_s + setup.ground_lost_land_s
    loop = asyncio.get_running_loop()
    running = asyncio.create_task(process.run(on_listening))
    asked_s: list[float] = []

    def interrupt() -> None:
        now_s = time.monotonic()
        if not process.is_needed() or (asked_s and now_s - asked_s[-1] < _AGAIN_S):
            running.cancel()
            return
        asked_s.append(now_s)
        typer.echo(
            f"robots are in the air: without a ground station they hold after {hold_s:g} s and "
            f"land after {land_s:g} s: Ctrl-C again ends it",
            err=True,
        )

    def hang_up() -> None:
        # Without its terminal it cannot ask, so it ends once no robot is in the air.
        if process.is_needed():
            loop.call_later(_LOOK_AGAIN_S, hang_up)
        else:
            running.cancel()

    loop.add_signal_handler(signal.SIGINT, interrupt)
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # nohup
        loop.add_signal_handler(signal.SIGHUP, hang_up)
    loop.add_signal_handler(signal.SIGTERM, running.cancel)
    with contextlib.suppress(asyncio.CancelledError):
        await running


def _print_event(event: "GroundEvent") -> None:
    clock = time.strftime("%H:%M:%S", time.localtime(event.unix_time_s))
    by = f"{event.operator}: " if event.operator and event.kind == "command" else ""
    robot = f"{event.robot}: " if event.robot else ""
    with contextlib.suppress(OSError):  # A closed pipe must not end the station.
        typer.echo(f"{clock}  {robot}{by}{event.text}")
