"""Generates the reference of commands."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer

from handbook.markdown import cell, code, table
from lpac.cli.main import app

_WIDE = 200
# Removed from defaults that are files of the repository.
_ROOT = Path(__file__).resolve().parent.parent


def page() -> str:
    """Reference of every command with its arguments and options."""
    root: Any = typer.main.get_command(app)
    return "\n\n".join(
        [
            "# Commands",
            "`lpac COMMAND --help` shows the same in a terminal. If packages are missing, a "
            "command names the extra to install. The exit code is 0 only if a command succeeded.",
            *_below(root, _context(root, None, "lpac")),
        ]
    )


def names() -> list[str]:
    """Every command in full, such as "lpac mission origin"."""
    root: Any = typer.main.get_command(app)
    return [context.command_path for _, context in _walk(root, _context(root, None, "lpac"))]


def _context(command: Any, parent: Any, name: str) -> Any:
    return command.context_class(command, parent=parent, info_name=name, max_content_width=_WIDE)


def _walk(group: Any, context: Any) -> Iterator[tuple[Any, Any]]:
    """Yield each command below a group with child context, groups first."""
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        child = _context(command, context, name)
        yield command, child
        if hasattr(command, "list_commands"):
            yield from _walk(command, child)


def _below(root: Any, context: Any) -> Iterator[str]:
    for command, child in _walk(root, context):
        depth = len(child.command_path.split())
        yield f"{'#' * depth} {child.command_path}"
        yield "\n".join(line.strip() for line in (command.help or "").splitlines())
        if hasattr(command, "list_commands"):
            continue
        pieces = " ".join(piece for piece in command.collect_usage_pieces(child))
        yield f"```text\n{child.command_path} {pieces}\n```"
        records = [parameter.get_help_record(child) for parameter in command.get_params(child)]
        rows = [
            (code(name), cell(text.replace(f"{_ROOT}/", "")))
            for name, text in filter(None, records)
            if name != "--help"
        ]
        if rows:
            yield table(("argument or option", "meaning"), rows)
