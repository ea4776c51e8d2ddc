"""`lpac ground`: the process that speaks to the fleet."""

import asyncio
import contextlib
import getpass
import signal
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lpac.cli.apps import new_app
from lpac.cli.options import DEFAULT_FLEET, Fleet

if TYPE_CHECKING:
    from lpac.analysis.snapshot import FleetSetup, GroundEvent
    from lpac.ground.station.config import GroundConfig
    from lpac.ground.station.server import GroundProcess

app = new_app()

_AGAIN_S = 5.0
_LOOK_AGAIN_S = 1.0
_LONGEST_NAME = 64


@app.command()
def ground(
    fleet: Fleet = DEFAULT_FLEET,
    name: Annotated[
        str, typer.Option("--name", help="This station's name; by default user@host.")
    ] = "",
) -> None:
    """Speak to the fleet, until Ctrl-C: `lpac mission`, `watch`, `map`, `record` need it.

    It sets nothing in motion by itself. Started again, it goes on where the last one was.
    """
    from lpac.ground.station.server import GroundProcess

    operator = name or _user_at_host()
    if not operator.isprintable() or len(operator) > _LONGEST_NAME:
        raise ValueError(f"--name {name!r}: must be at most {_LONGEST_NAME} printable characters")
    config = load_setup(fleet, operator)
    # Nothing that a robot says can be a text that cannot be printed.
    sys.stdout.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
    process = GroundProcess(config, _print_event)
    started = (
        f"ground station {operator} of fleet {config.setup.fleet}, {len(config.setup.robots)} "
        "robots: Ctrl-C ends it"
    )
    asyncio.run(_run(process, config.setup, lambda: typer.echo(started)))


def _user_at_host() -> str:
    try:
        return f"{getpass.getuser()}@{socket.gethostname()}"
    except (KeyError, OSError):
        raise ValueError("this user has no name: give the station one with --name") from None


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
        if not process.needed() or (asked_s and now_s - asked_s[-1] < _AGAIN_S):
            running.cancel()
            return
        asked_s.append(now_s)
        typer.echo(
            f"robots are in the air: without a ground station they hold after {hold_s:g} s and "
            f"land after {land_s:g} s: Ctrl-C again ends it",
            err=True,
        )

    def hang_up() -> None:
        # Its terminal was closed: it cannot ask, so it ends when nobody is in the air.
        if process.needed():
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
    with contextlib.suppress(OSError):  # Nobody reads it: no reason to leave the fleet alone.
        typer.echo(f"{clock}  {robot}{by}{event.text}")


def load_setup(path: Path, operator: str) -> "GroundConfig":
    """What the ground station needs to know of the fleet. Raises ValueError or OSError."""
    from edge.core.world import parse_world
    from edge.messages.mission import Place, world_id
    from edge.policy.bundle import load_bundle
    from lpac.analysis.snapshot import FleetSetup, FleetSlot
    from lpac.fleet.settings import load_fleet
    from lpac.ground.station.config import GroundConfig

    config = load_fleet(path)
    seated = next((slot.robot for slot in config.slots if slot.robot), None)
    if seated is None:
        raise ValueError(f"{path}: slots: no robot sits in one")
    robot = config.robot_config(seated)
    bundle = load_bundle(config.bundle)
    perception, training = bundle.manifest.perception, bundle.manifest.training
    if perception is None:
        raise ValueError(f"{config.bundle}: the bundle has no perception: it cannot fly")
    world = config.world.read_text("utf-8-sig")
    parse_world(world, str(config.world))
    return GroundConfig(
        setup=FleetSetup(
            fleet=config.fleet,
            operator=operator,
            robots={name: host.robot_id for name, host in config.robots.items()},
            slots=tuple(
                FleetSlot(Place(slot.height, slot.landing_point_m), slot.pad_m, slot.robot or "")
                for slot in config.slots
            ),
            fence=robot.fence,
            world=world,
            world_id=world_id(world),
            bundle_id=bundle.id,
            world_size=perception.world_size,
            sensor_size=perception.sensor_size,
            communication_range=perception.communication_range,
            env_scale=robot.policy.env_scale,
            truncation=training.idf_truncation,
            norm=training.idf_norm,
            base_height_m=robot.flight.base_height_m,
            slot_spacing_m=robot.flight.slot_spacing_m,
            errors=robot.errors,
            battery_critical=robot.flight.battery_critical,
            ground_timeout_s=robot.flight.ground_timeout_s,
            ground_lost_land_s=robot.flight.ground_lost_land_s,
        ),
        connect=tuple(f"tcp/{host.address}:{host.zenoh_port}" for host in config.robots.values()),
    )
