"""`lpac export`: a bundle from a trained torch checkpoint."""

from pathlib import Path
from typing import Annotated

import typer

from lpac.cli.apps import new_app
from lpac.cli.bundle import show
from lpac.cli.options import existing
from lpac.cli.printing import working

app = new_app()

_Source = Annotated[
    str,
    typer.Argument(
        help="LPAC state dict (.pt), or the authors' folder of tensors; or MODULE:CLASS, any torch "
        "module with encode and step. MODULE is a package's, or a .py file."
    ),
]
_Parameters = Annotated[
    Path,
    typer.Option(
        callback=existing, help="Our parameter file (TOML), or a coverage_control_params.toml."
    ),
]
_Cnn = Annotated[
    Path | None,
    typer.Option(
        callback=existing, help="State dict whose CNN is used, such as for the authors' folder."
    ),
]


@app.command()
def export(
    source: _Source,
    params: _Parameters,
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="Bundle to write: a directory, or a .zip archive."),
    ],
    name: Annotated[
        str | None,
        typer.Option(help="The policy's name; by default the checkpoint's or the class's."),
    ] = None,
    checkpoint: Annotated[
        Path | None, typer.Option(callback=existing, help="State dict of MODULE:CLASS.")
    ] = None,
    cnn: _Cnn = None,
    force: Annotated[
        bool,
        typer.Option("--force", help="Even if the checkpoint contradicts the parameter file."),
    ] = False,
) -> None:
    """Export a trained torch checkpoint as a bundle that runs without torch."""
    from edge.policy.bundle import write_bundle
    from export.exporter import export_bundle
    from export.module import export_module

    with working("exporting"):
        if ":" in source and not Path(source).exists():
            bundle = export_module(source, checkpoint, params, name)
        else:
            if source.endswith(".py"):
                raise ValueError(f"{source}: name the class, too: {source}:CLASS")
            Path(source).stat()  # names a missing file
            bundle = export_bundle(Path(source), params, name, cnn=cnn, force=force)
    write_bundle(bundle, output)
    typer.echo(f"{output}:")
    show(bundle)
