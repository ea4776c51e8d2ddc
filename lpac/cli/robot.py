"""`lpac robot`: fly, check or set up one robot."""

import dataclasses
import json
import os
import signal
from collections.abc import Iterable
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lpac.cli.apps import AsJson, new_app

if TYPE_CHECKING:
    from edge.robot.setup import SetupReport

app = new_app("robot", "Fly one robot, or check whether it could.")

_END_WITHIN_S = 2.9


class Rc(StrEnum):
    """Remote control that can take over the vehicle."""

    PILOT = "pilot"
    NONE = "none"


ConfigPath = Annotated[Path, typer.Option("--config", help="The robot's configuration, TOML.")]


@app.command()
def run(config: ConfigPath = Path("robot.toml")) -> None:
    """Fly this robot, under the ground's commands, until SIGTERM or Ctrl-C.

    A vehicle that is flying then holds, or lands if the configuration says so.
    """
    # While modules are imported there is nothing to clean up.
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: os._exit(0))
    # A terminal lost with the Wi-Fi must not end a flight.
    signal.signal(signal.SIGHUP, signal.SIG_IGN)

    from edge.drivers.stop import Stop
    from edge.robot.config import load_config
    from edge.robot.process import run as run_robot

    loaded = load_config(config)
    stop = Stop()

    def on_signal(*_: object) -> None:
        if not stop.is_set():
            # The program ends even if it hangs; PX4 then lands a vehicle that it was flying.
            signal.setitimer(signal.ITIMER_REAL, _END_WITHIN_S)
            stop.set()

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, on_signal)
    run_robot(loaded, stop)


@app.command()
def check(
    config: ConfigPath = Path("robot.toml"),
    wait: Annotated[float, typer.Option(help="How long the robot may take to be ready, s.")] = 15.0,
    as_json: AsJson = False,
) -> None:
    """Print PX4's version, its reactions to failures, and what prevents a flight.

    With parameters = "set" in the configuration, unsafe PX4 parameters are set.
    """
    from edge.core.counted import counted
    from edge.robot.config import load_config
    from edge.robot.process import check as check_robot

    report = check_robot(load_config(config), wait)
    if as_json:
        checks = [dataclasses.asdict(each) for each in report.failed]
        typer.echo(json.dumps(report._asdict() | {"failed": checks}, indent=2))
    else:
        for line in (report.version, *report.explanations):
            typer.echo(line)
        _print_changes(report.changes, [failed.text for failed in report.failed])
    if report.failed:
        count = len(report.failed)
        raise ValueError(f"not ready to fly: {counted(count, 'check')} failed")
    typer.echo("ready to fly", err=as_json)


def _print_changes(changes: Iterable[str], problems: Iterable[str]) -> None:
    for line in (*(f"set: {each}" for each in changes), *(f"FAILED  {each}" for each in problems)):
        typer.echo(line)


@app.command()
def setup(
    *,
    system_id: Annotated[int, typer.Option(min=1, max=255, help="The MAV_SYS_ID to set.")],
    rc: Annotated[Rc, typer.Option(help="Whether a pilot holds a remote control.")],
    ceiling: Annotated[float, typer.Option(help="The fence's ceiling above the pad, m.")],
    url: Annotated[
        str, typer.Option(help="Address at which PX4's MAVLink arrives.")
    ] = "udpin://127.0.0.1:14551",
    insecure: Annotated[
        bool,
        typer.Option(
            "--insecure", help="Allow an address other than 127.0.0.1, which others reach."
        ),
    ] = False,
    command_timeout: Annotated[
        float, typer.Option(help="Time after which a hung program's vehicle holds, s.")
    ] = 0.5,
    wait: Annotated[float, typer.Option(help="How long to listen for the vehicle, s.")] = 10.0,
    as_json: AsJson = False,
) -> None:
    """Set a vehicle's system id and failsafe parameters once, also those that need a reboot.

    It must be the only vehicle at the URL, and disarmed. No configuration is needed.
    """
    from edge.core.logger import show
    from edge.drivers.px4.autopilot import MavsdkAutopilot
    from edge.drivers.px4.driver import vehicle_lock
    from edge.flight.failsafe import required
    from edge.robot.config import AutopilotConfig, port_of
    from edge.robot.setup import set_up

    requirements = required(rc.value, ceiling, command_timeout)
    AutopilotConfig(url, system_id, insecure=insecure)
    show("error")
    with vehicle_lock(port_of(url)), MavsdkAutopilot(url) as autopilot:
        report = set_up(autopilot, autopilot, requirements, system_id, wait)
    _print_setup(report, as_json=as_json)


def _print_setup(report: "SetupReport", *, as_json: bool) -> None:
    """Print the report. Raises ValueError if there are problems."""
    if as_json:
        typer.echo(json.dumps(report._asdict(), indent=2))
    else:
        _print_changes(report.changes, report.problems)
    if report.problems:
        raise ValueError("the vehicle is not safe to fly as it is")
    if report.needs_reboot:
        typer.echo("restart the autopilot: some changes take effect only then", err=as_json)
    elif not report.changes:
        typer.echo("nothing had to be changed", err=as_json)
