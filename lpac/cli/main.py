"""The `lpac` command: each sub-command imports its part of the project only when it runs."""

import os
import sys
from typing import Any

import typer
from typer.core import TyperGroup

# field and field_setup add their commands to fleet's.
from lpac.cli import (  # noqa: F401
    bundle,
    export,
    field,
    field_setup,
    fleet,
    ground,
    hosts,
    live_map,
    log,
    mission,
    replay,
    report,
    robot,
    sim,
    site,
    watch,
)

# One process is one robot, or a simulation on one core: BLAS threads would only disturb the loops.
# numpy reads this when it is first imported, and no sub-command has imported it yet.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Third-party packages that a plain install, as the robot's is, leaves out -> the extra with them.
_EXTRAS = {
    "aiohttp": "ground", "matplotlib": "sim", "onnx": "export", "pymavlink": "sim",
    "pyulog": "sim", "rich": "sim", "textual": "ground", "tomlkit": "fleet", "torch": "export",
}  # fmt: skip


class _Commands(TyperGroup):
    def invoke(self, ctx: Any) -> Any:
        """Ctrl-C, where a command has nothing to say about it, as while it starts."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            typer.echo("lpac: interrupted", err=True)
            raise typer.Exit(130) from None


app = typer.Typer(
    name="lpac",
    cls=_Commands,
    help="Decentralised perception-action-communication policies on small drones.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
app.command()(export.export)
app.command()(sim.sim)
app.command()(sim.demo)
app.command()(hosts.hosts)
app.command()(replay.replay)
app.add_typer(bundle.app)
app.add_typer(robot.app)
app.add_typer(log.app)
app.add_typer(fleet.app)
app.command()(ground.ground)
app.add_typer(mission.app)
app.add_typer(site.app)
app.command()(watch.watch)
app.command("map")(live_map.live_map)
app.command()(report.record)
app.command()(report.report)


def main() -> None:
    """Run `lpac`; a person's mistake ends in one line and a non-zero exit code."""
    try:
        app()
    except ModuleNotFoundError as error:
        name = error.name or ""
        if name.split(".")[0] in ("lpac", "export"):
            sys.exit(f"lpac: {name} is not installed here: this command is the workstation's")
        if name not in _EXTRAS:
            raise
        extra = _EXTRAS[name]
        sys.exit(
            f"lpac: {name} is not installed here: `pip install 'lpac-edge[{extra}]'`, "
            "or `make setup` in the repository"
        )
    except (ValueError, OSError) as error:
        sys.exit(f"lpac: {error}")


if __name__ == "__main__":
    main()
