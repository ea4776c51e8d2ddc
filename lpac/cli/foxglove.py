"""`lpac foxglove`: show the fleet and its logs in Foxglove."""

from pathlib import Path
from typing import Annotated

import typer

from lpac.cli.apps import new_app
from lpac.cli.options import DEFAULT_FLEET, Fleet
from lpac.cli.printing import progress_of

app = new_app("foxglove", "Show the fleet in Foxglove, live or from logs; or write its layout.")

_LAYOUT = Path(__file__).parents[1] / "ground" / "foxglove" / "lpac.layout.json"
Out = Annotated[Path, typer.Option("--out", "-o", help="The file to write.")]


@app.command()
def live(
    fleet: Fleet = DEFAULT_FLEET,
    port: Annotated[int, typer.Option(min=0, max=65535, help="0: any free port.")] = 8765,
    host: Annotated[
        str, typer.Option(help="Address to serve; on a network, everybody there can look.")
    ] = "127.0.0.1",
) -> None:
    """Serve the fleet to Foxglove, until Ctrl-C; needs `lpac ground`. It only observes."""
    import asyncio

    from edge.core.address import require_host
    from lpac.fleet.settings import load_fleet
    from lpac.ground.foxglove.live import serving
    from lpac.ground.serve import serve

    require_host("--host", host)
    name = load_fleet(fleet).fleet

    def ready(bound_port: int) -> None:
        typer.echo(f"fleet {name} for Foxglove: open a connection to ws://{host}:{bound_port}")
        typer.echo("it only observes; `lpac foxglove layout` writes the panels to import")
        typer.echo("Ctrl-C ends it, and nothing else")

    asyncio.run(serve(serving(name, host=host, port=port), ready))


@app.command()
def log(
    folder: Annotated[Path, typer.Argument(help="Folder with what `lpac record` wrote.")],
    out: Out = Path("foxglove.mcap"),
) -> None:
    """Convert the ground's logs to one file that Foxglove shows like a live fleet."""
    from lpac.ground.foxglove.logs import convert, ground_logs

    paths = ground_logs(folder)
    with progress_of("logs") as progress:
        task = progress.add_task("", total=len(paths))
        convert(paths, out, lambda done: progress.update(task, completed=done))
    typer.echo(f"{out}: open it in Foxglove, with the panels of `lpac foxglove layout`")


@app.command()
def layout(out: Out = Path("lpac.layout.json")) -> None:
    """Write the layout to import in Foxglove, for a live fleet and for logs."""
    out.write_text(_LAYOUT.read_text())
    typer.echo(f"{out}: in Foxglove, Layouts, Import from file")
