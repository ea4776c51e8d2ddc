"""The `lpac` command: each sub-command imports its part of the project only when it runs."""

import os
import sys

import typer

from cli import bundle, export, sim

# One process is one robot, or a simulation on one core: BLAS threads would only disturb the loops.
# numpy reads this when it is first imported, and no sub-command has imported it yet.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

_EXTRAS = {"torch": "export", "onnx": "export", "matplotlib": "sim"}

app = typer.Typer(
    name="lpac",
    help="Decentralised perception-action-communication policies on small drones.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
app.command()(export.export)
app.command()(sim.sim)
app.command()(sim.demo)
app.add_typer(bundle.app)


def main() -> None:
    """Run `lpac`; a person's mistake ends in one line and a non-zero exit code."""
    try:
        app()
    except ModuleNotFoundError as error:
        if error.name in _EXTRAS:
            remedy = f"pip install 'lpac-edge[{_EXTRAS[error.name]}]'"
        elif error.name in ("export", "sim"):
            remedy = "this command is used from the repository, not from the robot's install"
        else:
            raise
        sys.exit(f"lpac: {error.name} is not installed: {remedy}")
    except (ValueError, OSError) as error:
        sys.exit(f"lpac: {error}")


if __name__ == "__main__":
    main()
