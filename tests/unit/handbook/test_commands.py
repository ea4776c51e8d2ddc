"""Commands of the pages: those in fences parse, and the text's have options that exist."""

import re
import shlex
from collections.abc import Iterator
from contextlib import suppress
from importlib.util import find_spec
from typing import Any

import pytest
import typer

from handbook import pages
from lpac.cli.main import app
from tests.conftest import ROOT

_LPAC: Any = typer.main.get_command(app)
_TARGETS = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.M))
# PX4's target, and modules of packages that pages show.
_OTHERS = {"px4_sitl", "lpac_lloyd.policy", "lpac_camera.figure"}
_FENCE = re.compile(r"^```(?:sh|text)\n(.*?)^```$", re.M | re.S)
_SPAN = re.compile(r"`((?:lpac|make|python -m) [^`\n]+)`")
_PAGES = [
    # The changelog names commands of former releases.
    *(page for page in pages.hand_written() if page != "CHANGELOG.md"),
    *(path.relative_to(ROOT).as_posix() for path in sorted(ROOT.glob("examples/*/README.md"))),
]


@pytest.mark.parametrize("page", _PAGES)
def test_commands_of_a_page_are_right(page: str) -> None:
    text = pages.page_text(page)
    for line in "".join(_FENCE.findall(text)).splitlines():
        for words in typed(line):
            check(words, (page, line), parses=True)
    for span in _SPAN.findall(text):
        # Placeholders stand for values.
        check(shlex.split(span), (page, span), parses=False)


def typed(line: str) -> Iterator[list[str]]:
    """Yield the words of each `lpac`, `make` and `python -m` in a line of a shell."""
    line = re.sub(r"(?:sudo )?\.venv/bin/", "", line.partition(" # ")[0])
    for command in re.split(" && | >>? ", line):
        if re.match("lpac |make |python -m ", command):
            yield shlex.split(command)


def check(words: list[str], where: object, *, parses: bool) -> None:
    """Require that a command and its options exist and, if it `parses`, that their values fit."""
    program, *arguments = words
    if program == "make":
        assert {word for word in arguments if "=" not in word} <= _TARGETS | _OTHERS, where
    elif program == "python":
        assert arguments[1] in _OTHERS or find_spec(arguments[1]) is not None, where
    else:
        command = _LPAC
        while hasattr(command, "list_commands"):
            if not arguments or not re.fullmatch("[a-z0-9]+", arguments[0]):
                return
            command = command.get_command(None, arguments.pop(0))
            assert command is not None, where
        known = {o for each in command.params for o in (*each.opts, *each.secondary_opts)}
        given = {word for word in arguments if re.fullmatch("--?[a-z][a-z-]*", word)}
        assert given <= known | {"--help"}, where
        if parses and "--help" not in arguments:
            # Some files of the pages are their reader's.
            with suppress(FileNotFoundError):
                command.make_context(" ".join(words), arguments)
