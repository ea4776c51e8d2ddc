"""`lpac hosts`: simulated robot computers on this machine, to try `lpac fleet`."""

import os
import signal
import time
from pathlib import Path
from typing import Annotated

import typer

from lpac.cli.apps import new_app
from lpac.cli.options import DEFAULT_BUNDLE

app = new_app()

_FORGET_EVERY_S = 60.0


@app.command()
def hosts(
    *,
    count: Annotated[int, typer.Option("--hosts", "-n", help="Computers, including spares.")] = 3,
    spares: Annotated[int, typer.Option(help="Number of them without a slot.")] = 0,
    image: Annotated[Path, typer.Option(help="Image from `make image ARCH=amd64`.")] = Path(
        "out/image/amd64"
    ),
    bundle: Annotated[Path, typer.Option(help="Policy bundle.")] = DEFAULT_BUNDLE,
    out: Annotated[Path, typer.Option(help="Folder for fleet.toml, SSH's files and logs.")] = Path(
        "out/fleet-demo"
    ),
) -> None:
    """Simulate robot computers (Ubuntu, systemd, sshd, a simulated PX4 each) until Ctrl-C."""
    from lpac.sim.hosts.hosts import SimulatedHosts

    def end(*_: object) -> None:
        # Ignore further signals, or an interrupted cleanup would leave hosts behind.
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, signal.SIG_IGN)
        raise KeyboardInterrupt

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, end)
    try:
        with SimulatedHosts(
            count, out, image=image, bundle=bundle, spares=spares, report=typer.echo
        ) as running:
            _give_to_user(out)
            typer.echo(f"fleet {running.fleet}; Ctrl-C ends all; in another terminal:")
            for command in ("enroll", "deploy", "status", "stop", "start"):
                typer.echo(f"  lpac fleet {command} --fleet {running.fleet_toml}")
            typer.echo(f"  ssh -F {running.ssh_config} {running[0].name}")
            while True:
                time.sleep(_FORGET_EVERY_S)
                for host in running:
                    with host.stepped:
                        host.vehicle.truth.clear()
    except KeyboardInterrupt:
        typer.echo("ended")


def _give_to_user(folder: Path) -> None:
    """Under sudo, give the files to the user: SSH refuses keys of other owners."""
    user, group = os.environ.get("SUDO_UID"), os.environ.get("SUDO_GID")
    if user and group:
        for path in (folder, *folder.iterdir()):
            os.chown(path, int(user), int(group))
