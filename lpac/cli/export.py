"""`lpac export`: a bundle from a trained torch checkpoint."""

from pathlib import Path
from typing import Annotated

import typer

from lpac.cli.apps import new_app
from lpac.cli.bundle import show
from lpac.cli.options import existing
from lpac.cli.printing import working

app = new_app()


@app.command()
def export(
    checkpoint: Annotated[
        Path,
        typer.Argument(
            callback=existing, help="LPAC state dict (.pt), or the authors' folder of tensors."
        ),
    ],
    params: Annotated[
        Path,
        typer.Option(
            callback=existing, help="Our parameter file (TOML), or coverage_control_params.toml."
        ),
    ],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="Bundle to write: a directory, or a .zip archive."),
    ],
    name: Annotated[
        str | None, typer.Option(help="The policy's name; by default the checkpoint's.")
    ] = None,
    cnn: Annotated[
        Path | None,
        typer.Option(
            callback=existing, help="State dict whose CNN is used, such as for the authors' folder."
        ),
    ] = None,
    force: Annotated[
        bool,
        typer.Option("--force", help="Even if the checkpoint contradicts the parameter file."),
    ] = False,
) -> None:
    """Export a trained torch checkpoint as a bundle that runs without torch."""
    from edge.policy.bundle import write_bundle
    from export.exporter import export_bundle

    with working("exporting"):
        bundle = export_bundle(checkpoint, params, name, cnn=cnn, force=force)
    write_bundle(bundle, output)
    typer.echo(f"{output}:")
    show(bundle)
