"""Terminal side of the fleets of programs that `lpac sim` runs in real time."""

import shlex
import signal
import time
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import typer

from lpac.cli.options import DEFAULT_ROBOTS

if TYPE_CHECKING:
    from lpac.cli.live import FleetDisplay
    from lpac.sim.fleet.processes import Fleet


def serve(fleet: "Fleet", fleet_toml: Path, display: "FleetDisplay") -> None:
    """Run the fleet for `lpac ground` until Ctrl-C; it is not commanded from here.

    `fleet_toml` is the path of its description in the printed commands.
    """
    from edge.core.counted import counted

    with fleet:
        while not fleet.listener.wait_for(lambda s: len(s) == len(fleet.robots), 0.2):
            fleet.require_running()
            fleet.vehicles.require_running()
            display.show_or_say("programs start", fleet.listener.statuses())
        fleet.begin()
        display.print(
            f"{counted(len(fleet.robots), 'robot')} until Ctrl-C; in a second terminal:\n\n"
            f"  export LPAC_FLEET={shlex.quote(str(fleet_toml))}\n"
            "  lpac ground\n"
        )
        try:
            _watch_over(fleet, display)
        finally:
            # A second Ctrl-C must not leave robots' programs behind.
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, signal.SIG_IGN)


def _watch_over(fleet: "Fleet", display: "FleetDisplay") -> None:
    """Report once if this machine does not keep up, and each program that ends.

    Raises SimulatedFleetError once all programs have ended, VehicleError if a vehicle has ended.
    """
    from lpac.sim.fleet.processes import OverloadError, SimulatedFleetError

    running, keeps_up = list(fleet.robots), True
    while running:
        fleet.vehicles.require_running()
        try:
            fleet.require_keeping_up()
        except OverloadError as error:
            if keeps_up:
                display.say(str(error))
            keeps_up = False
        for robot in [robot for robot in running if not robot.running]:
            running.remove(robot)
            display.say(f"the program of {robot.name} has ended, {robot.ending()}")
        display.show(f"fleet {fleet.name}", fleet.listener.statuses())
        fleet.forget()
        time.sleep(0.2)
    raise SimulatedFleetError("the programs of all robots have ended")


def choose_robot_count(bundle: Path, vehicle: Literal["mavlink", "px4"]) -> int:
    """Print and return the number of robots that this machine can run, from 1 to 10."""
    from lpac.sim.fleet.load import robots_carried

    carried = int(robots_carried(bundle, vehicle))
    robots = max(1, min(DEFAULT_ROBOTS, carried))
    typer.echo(f"{_carries(carried)}: flying {robots}", err=True)
    return robots


def report_capacity(
    robots: int | None, bundle: Path, vehicle: Literal["mavlink", "px4"]
) -> int | None:
    """Print and return how many robots this machine can run, with advice if they are too few.

    None, without output, if `robots` is None: their number was chosen in this way.
    """
    from lpac.sim.fleet.load import robots_carried

    if robots is None:
        return None
    carried = int(robots_carried(bundle, vehicle))
    if carried >= robots:
        typer.echo(_carries(carried), err=True)
        return carried
    advice = f"; fewer: -n {max(1, carried)}" if robots > 1 else ""
    typer.echo(f"{_carries(carried)}, not {robots}: it may not keep up{advice}", err=True)
    return carried


def _carries(robots: int) -> str:
    count = f"about {robots}" if robots else "less than one"
    return f"this machine, as busy as it is now, carries {count} of these robots and vehicles"
