"""Tables in a terminal."""

import ast
import io
import threading
from contextlib import AbstractContextManager
from queue import Queue
from typing import Any

import pytest

from lpac.cli import printing
from lpac.cli.printing import print_table, progress_of, progress_of_run, working
from tests.conftest import ROOT


def test_names_that_people_type_again_are_never_broken(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    name, text = "program-dies-as-the-ground-does", "a program dies, and the ground with it " * 3
    print_table(("fault", "what happens", "promise"), [(name, text, text), ("none", "", "")])
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].startswith(f"{name} ") and lines[-1].split() == ["none"]
    assert all(len(line) <= 60 for line in lines)
    # Whole sentences may be.
    print_table(("what", "promise"), [(text, text)])
    assert all(len(line) <= 60 for line in capsys.readouterr().out.splitlines())


@pytest.fixture
def lines(monkeypatch: pytest.MonkeyPatch) -> "Queue[str]":
    """Progress lines without a terminal, at the full rate."""
    said: Queue[str] = Queue()
    monkeypatch.setattr("sys.stderr", io.StringIO())
    monkeypatch.setattr(printing, "LINE_EVERY_S", 0.0)
    monkeypatch.setattr("typer.echo", lambda text, err: said.put(text))
    return said


def say_until(lines: "Queue[str]", wanted: str) -> None:
    while wanted not in lines.get(timeout=60.0):
        pass


def test_without_a_terminal_progress_comes_in_lines(lines: "Queue[str]") -> None:
    with progress_of("flights") as progress:
        say_until(lines, "flights")
        task = progress.add_task("r1", total=None)
        say_until(lines, "flights 0, r1")
        progress.update(task, completed=3, total=4)
        say_until(lines, "flights 3 of 4")
        progress.update(task, completed=4)
        say_until(lines, "flights 4 of 4, r1")
    with progress_of_run() as show:
        show(0.5, "round 1: fit", ["loss 0.5", "3 min left"])
        say_until(lines, "round 1: fit  50 %  loss 0.5  3 min left")
    with working("exporting"):
        say_until(lines, "exporting")


def test_the_last_line_is_how_it_ended(
    lines: "Queue[str]", monkeypatch: pytest.MonkeyPatch
) -> None:
    is_done = threading.Event()

    def echo(text: str, *, err: bool) -> None:
        lines.put(text)
        assert err and is_done.wait(60.0)

    monkeypatch.setattr("typer.echo", echo)
    with progress_of("flights") as progress:
        say_until(lines, "flights")
        progress.add_task("", total=4, completed=4)
        # No other line is due.
        monkeypatch.setattr(printing, "LINE_EVERY_S", 1000.0)
        is_done.set()
    assert lines.get(timeout=60.0) == "flights 4 of 4"


@pytest.mark.usefixtures("lines")
def test_they_end_with_the_work() -> None:
    before = threading.active_count()
    shown: list[AbstractContextManager[Any]] = [
        progress_of("runs"),
        progress_of_run(),
        working("x"),
    ]
    for each in shown:
        with pytest.raises(ValueError, match="broken"), each:
            assert threading.active_count() == before + 1
            raise ValueError("broken")
        assert threading.active_count() == before


def test_every_bar_has_lines_where_there_is_no_terminal() -> None:
    """A bar of rich's, or of typer's, is silent there: they are made in one place alone."""
    for path in (ROOT / "lpac" / "cli").rglob("*.py"):
        tree = ast.parse(path.read_text())
        bars = {
            node.attr
            for node in ast.walk(tree)
            if isinstance(node, ast.Attribute)
            and node.attr in ("progressbar", "status")
            and isinstance(node.value, ast.Name)
            and node.value.id in ("typer", "console")
        }
        made = {
            name.id
            for node in ast.walk(tree)
            if isinstance(node, ast.Call)
            and isinstance(name := node.func, ast.Name)
            and name.id == "Progress"
        }
        assert path.name == "printing.py" or not bars | made, path
