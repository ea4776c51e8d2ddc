"""Ground control: site."""

import typer

app = typer.Typer(name="site", help="Not built yet.", no_args_is_help=True)


@app.callback()
def _group() -> None:
    pass
