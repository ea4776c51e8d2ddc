"""Ground control: mission."""

import typer

app = typer.Typer(name="mission", help="Not built yet.", no_args_is_help=True)


@app.callback()
def _group() -> None:
    pass
