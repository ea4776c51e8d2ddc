"""`lpac robot`: fly one robot, or check whether it could fly."""

import json
import signal
import sys
import threading
from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(name="robot", help="Fly one robot, or check whether it could.")

_END_WITHIN_S = 2.9

ConfigPath = Annotated[Path, typer.Option("--config", help="The robot's configuration, TOML.")]


@app.command()
def run(config: ConfigPath = Path("robot.toml")) -> None:
    """Fly this robot, under the ground's commands, until SIGTERM or Ctrl-C.

    A vehicle that is flying then holds, or lands if the configuration says so.
    """
    stop = threading.Event()

    def on_signal(*_: object) -> None:
        if not stop.is_set():
            stop.set()
            # Whatever hangs, the program ends; PX4 then lands a vehicle that it was flying.
            signal.setitimer(signal.ITIMER_REAL, _END_WITHIN_S)

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, on_signal)
    # A terminal that the Wi-Fi takes away must not end a flight; the ground does that.
    signal.signal(signal.SIGHUP, signal.SIG_IGN)

    # structlog would load it to draw tracebacks: 5 MB that no robot has a use for.
    sys.modules["rich"] = None  # type: ignore[assignment]
    from edge.robot import run as run_robot
    from edge.runtime.config import load_config

    run_robot(load_config(config), stop)


@app.command()
def check(
    config: ConfigPath = Path("robot.toml"),
    wait: Annotated[float, typer.Option(help="How long the robot may take to be ready, s.")] = 15.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Say what PX4 would do when something fails, and what still keeps the robot from flying.

    With parameters = "set" in the configuration, unsafe PX4 parameters are set.
    """
    from edge.robot import check as check_robot
    from edge.runtime.config import load_config

    report = check_robot(load_config(config), wait)
    if as_json:
        typer.echo(json.dumps(report._asdict(), indent=2))
    else:
        for line in report.explanations:
            typer.echo(line)
        for line in report.changes:
            typer.echo(f"set: {line}")
        for line in report.failed:
            typer.echo(f"FAILED  {line}")
    if report.failed:
        count = len(report.failed)
        raise ValueError(f"not ready to fly: {count} check{'s' if count > 1 else ''} failed")
    typer.echo("ready to fly", err=as_json)
