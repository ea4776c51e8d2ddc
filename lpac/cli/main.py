"""The `lpac` command: `lpac NAME` is in `lpac.cli.NAME`, and is loaded when it is called."""

import importlib
import os
import sys
from importlib.util import find_spec
from typing import Annotated, Any

# One process is one robot, or a simulation on one core: BLAS threads would only disturb the loops.
# numpy reads this when it is first imported, and no command has imported it yet.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import typer

from lpac.cli.apps import CommandList

# Each command, and what its own help begins with; a test compares them.
_COMMANDS = {
    "demo": "Ten robots over an unknown world for 60 s, beside the baselines; makes a figure.",
    "sim": "Fly a swarm over an unknown world and print how well it covers it.",
    "evaluate": (
        "Policies and baselines over many worlds: how well they cover, with confidence intervals."
    ),
    "study": (
        "Fly an experiment of yours, from a TOML file: policies over worlds, or faults in flight."
    ),
    "train": (
        "Train a policy, or continue where a training stopped, keeping the weights that fly best."
    ),
    "ablate": "Train a method without each of its parts, and say what each of them is worth.",
    "paper": "Repeat the paper's experiments, and run some that its arguments call for.",
    "drill": "Inject faults into a fleet in flight, and judge by the truth whether promises held.",
    "hosts": "Simulate robot computers (Ubuntu, systemd, sshd, a simulated PX4 each) until Ctrl-C.",
    "ground": "Speak to the fleet, until Ctrl-C: `lpac mission`, `watch`, `map`, `record` need it.",
    "mission": "Command the fleet, through `lpac ground`.",
    "watch": "Show fleet and mission, alarms first; h holds all robots, l lands them, ? helps.",
    "map": "Show the fleet on a live map, in a browser; needs `lpac ground`, and no internet.",
    "foxglove": "Show the fleet in Foxglove, live or from logs; or write its layout.",
    "site": "Places to fly at: origin, fence, pads and landing points, beside fleet.toml.",
    "record": "Write what `lpac ground` tells to a log, until Ctrl-C: statuses, commands, costs.",
    "report": "Make figures and an HTML page from flight logs; and how well missions repeat.",
    "replay": "Run policy and flight decisions again on flight logs; say what differs.",
    "fleet": "Deploy to the robots, start and stop them.",
    "export": "Export a trained torch checkpoint as a bundle that runs without torch.",
    "bundle": "Look at a policy bundle; verify or time it on this machine.",
    "robot": "Fly one robot, or check whether it could.",
    "bench": (
        "Measure this machine's network: what the programs send, and what bandwidth they leave."
    ),
    "log": "What the robots' and the ground's logs hold.",
}
# The extra that has a command's packages; without one they are in every install.
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
# What these have done is on the disk.
_GO_ON = ("train", "ablate", "evaluate", "study", "drill")


class _Lpac(CommandList):
    """Knows its commands without loading them. A robot has, and lists, few of them."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        # Who mistypes one is told the nearest of these names.
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
        """Ctrl-C, where a command has nothing to say about it; and what is not installed."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            # `python -m` dies of the signal, whatever is caught, if it came while a string was
            # executed, as named tuples do when they are imported. The next string forgets that.
            exec("")
            then = ": the same command goes on" if ctx.invoked_subcommand in _GO_ON else ""
            typer.echo(f"lpac: interrupted{then}", err=True)
            raise typer.Exit(_INTERRUPTED) from None
        except ModuleNotFoundError as error:
            sys.exit(_what_is_missing(error, ctx.invoked_subcommand))


def _what_is_missing(error: ModuleNotFoundError, command: str | None) -> str:
    """One line. Raises the error if no install of ours would help."""
    package = (error.name or "").split(".")[0]
    if package in ("lpac", "export"):
        return f"lpac: {error.name} is not installed here: this command is the workstation's"
    extra = next((extra for extra, its in _EXTRAS.items() if command in its), None)
    if package == "edge" or extra is None:
        raise error
    from lpac.extras import install_command

    return f"lpac: {package} is not installed here: `{install_command(extra)}`"


app = typer.Typer(
    name="lpac",
    cls=_Lpac,
    no_args_is_help=True,
    # A shell with people at it is a workstation's.
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
    """Run `lpac`; a person's mistake ends in one line and a non-zero exit code."""
    try:
        app()
    except OSError as error:
        sys.exit(f"lpac: {_in_words(error)}")
    except ValueError as error:
        sys.exit(f"lpac: {error}")


def _in_words(error: OSError) -> str:
    """The file and its fault; the error as it is, if it is no file's, or a person wrote it."""
    from edge.core.file_errors import in_words, is_known

    if error.filename is None or not is_known(error):
        return str(error)
    return f"{os.fsdecode(error.filename)}: {in_words(error)}"


if __name__ == "__main__":
    main()
