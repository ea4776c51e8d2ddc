"""Typer apps with plain help, for all commands of `lpac`."""

from typing import Annotated, Any

import typer
from typer.core import TyperGroup

AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]

_WHOLE_LINE = 1000


class CommandList(TyperGroup):
    """A group of commands; its help lists each with the whole first sentence of its own help."""

    def first_sentence(self, ctx: Any, name: str) -> str:
        """First sentence of a command's help."""
        command = self.get_command(ctx, name)
        assert command is not None
        return command.get_short_help_str(_WHOLE_LINE)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """List whole sentences; typer would cut them off at the end of the line."""
        with formatter.section("Commands"):
            formatter.write_dl(
                [(name, self.first_sentence(ctx, name)) for name in self.list_commands(ctx)]
            )


def new_app(name: str | None = None, help: str | None = None) -> typer.Typer:  # noqa: A002
    """Make an app of one command or more; plain help, since rich is slow."""
    return typer.Typer(
        name=name, help=help, cls=CommandList, no_args_is_help=True, add_completion=False,
        rich_markup_mode=None,
    )  # fmt: skip
