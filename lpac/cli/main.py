"""The `lpac` command. `lpac NAME` is in `lpac.cli.NAME`, which is imported on use."""

import importlib
import os
import sys
from importlib.util import find_spec
from typing import Annotated, Any

# One process is one robot, or a simulation on one core: BLAS threads would only disturb the loops.
# numpy reads this on import, and no command has imported it yet.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import typer

from lpac.cli.apps import CommandList

# First sentence of each command's help, known without importing it; a test compares them.
_COMMANDS = {
    "demo": "Fly ten robots and the baselines over an unknown world for 60 s, and draw a figure.",
    "sim": "Fly a swarm over an unknown world and print how well it covers it.",
    "evaluate": "Compare policies and baselines over many worlds, with confidence intervals.",
    "study": "Fly your own experiment from a TOML file: policies over worlds, or faults in flight.",
    "train": (
        "Train a policy, or continue where a training stopped, keeping the weights that fly best."
    ),
    "ablate": "Train a method without each of its parts, and measure what each contributes.",
    "paper": "Repeat the paper's experiments, and run others that its arguments call for.",
    "drill": "Inject faults into a flying fleet, and check promises against the true tracks.",
    "hosts": "Simulate robot computers (Ubuntu, systemd, sshd, a simulated PX4 each) until Ctrl-C.",
    "ground": "Run the ground station until Ctrl-C; `lpac mission`, `watch` and others need it.",
    "mission": "Command the fleet, through `lpac ground`.",
    "watch": "Show fleet and mission, alarms first; h holds all robots, l lands them, ? helps.",
    "map": "Show the fleet on a live map, in a browser; needs `lpac ground`, and no internet.",
    "foxglove": "Show the fleet in Foxglove, live or from logs; or write its layout.",
    "site": "Places to fly at: origin, fence, pads and landing points, beside fleet.toml.",
    "record": "Log statuses, commands and costs from `lpac ground`, until Ctrl-C.",
    "report": "Make figures and an HTML page from flight logs, and show how well missions repeat.",
    "replay": "Recompute policy and flight decisions from flight logs, and print differences.",
    "fleet": "Deploy to the robots, start and stop them.",
    "export": "Export a trained torch checkpoint as a bundle that runs without torch.",
    "bundle": "Show, verify or time a policy bundle on this machine.",
    "robot": "Fly one robot, or check whether it could.",
    "bench": "Measure the bandwidth that the robots' programs leave on this machine's network.",
    "log": "List the trials in logs, and repair damaged logs.",
}
# The extra with a command's packages; other commands work in every install.
_EXTRAS = {
    "sim": ("demo", "sim", "evaluate", "study", "paper", "drill", "hosts"),
    "ground": ("ground", "mission", "watch", "map", "site", "record", "report"),
    "fleet": ("fleet",),
    "foxglove": ("foxglove",),
    "export": ("export",),
    "train": ("train", "ablate"),
    "bench": ("bench",),
}
_INTERRUPTED = 130
# These store finished work, and continue when repeated.
_CONTINUE = ("train", "ablate", "evaluate", "study", "drill")


class _Lpac(CommandList):
    """All commands, each imported on use. A robot's install has, and lists, few of them."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        # click suggests the nearest of these names for a mistyped one.
        names: dict[str, Any] = dict.fromkeys(_COMMANDS)
        self.commands = names

    def list_commands(self, ctx: Any) -> list[str]:
        return [name for name in _COMMANDS if find_spec(f"lpac.cli.{name}") is not None]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if cmd_name not in _COMMANDS:
            return None
        return typer.main.get_command(importlib.import_module(f"lpac.cli.{cmd_name}").app)

    def first_sentence(self, ctx: Any, name: str) -> str:
        return _COMMANDS[name]

    def invoke(self, ctx: Any) -> Any:
        """Invoke a command, and handle Ctrl-C and missing packages in one line each."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            # Python remembers an interrupt inside exec(), which namedtuple calls on import, and
            # `python -m` then dies of the signal even if it is caught. The next exec() resets it.
            exec("")
            then = ": the same command continues" if ctx.invoked_subcommand in _CONTINUE else ""
            typer.echo(f"lpac: interrupted{then}", err=True)
            raise typer.Exit(_INTERRUPTED) from None
        except ModuleNotFoundError as error:
            sys.exit(_missing_package(error, ctx.invoked_subcommand))


def _missing_package(error: ModuleNotFoundError, command: str | None) -> str:
    """One line with the remedy. Raises the error if no extra would help."""
    package = (error.name or "").split(".")[0]
    if package in ("lpac", "export"):
        return f"lpac: {error.name} is not installed here: this command is for a workstation"
    extra = next((extra for extra, commands in _EXTRAS.items() if command in commands), None)
    if package == "edge" or extra is None:
        raise error
    from lpac.extras import install_command

    return f"lpac: {package} is not installed here: `{install_command(extra)}`"


app = typer.Typer(
    name="lpac",
    cls=_Lpac,
    no_args_is_help=True,
    # Shell completion is for workstations only.
    add_completion=find_spec("lpac.sim") is not None,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


def _print_version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        typer.echo(f"lpac {version('lpac-edge')}")
        raise typer.Exit


@app.callback()
def _lpac(
    version: Annotated[
        bool,
        typer.Option(
            "--version", is_eager=True, callback=_print_version, help="Print the version and exit."
        ),
    ] = False,
) -> None:
    """Decentralised perception-action-communication policies on small drones."""


def main() -> None:
    """Run `lpac`; a user's mistake ends in one line and a non-zero exit code."""
    try:
        app()
    except OSError as error:
        sys.exit(f"lpac: {_text(error)}")
    except ValueError as error:
        sys.exit(f"lpac: {error}")


def _text(error: OSError) -> str:
    """Text with the file and its fault, or the error's own if it has no file."""
    from edge.core.file_errors import in_words, is_known

    if error.filename is None or not is_known(error):
        return str(error)
    return f"{os.fsdecode(error.filename)}: {in_words(error)}"


if __name__ == "__main__":
    main()
