"""Display of a fleet of programs while it runs, as it stands on the terminal."""

import io
import re
import sys
from typing import Any

import pytest
from rich.console import Console

from edge.messages.mission import FlightState
from lpac.cli.live import FleetDisplay
from tests.said import checks
from tests.unit.ground.snapshots import on_ground, status

CAUSES = checks("mission origin is not set: order `mission origin`", "GPS sees 3 satellites " * 9)
NEXT = "4 robots run; in a second terminal:\n\n  export LPAC_FLEET=out/fleet.toml\n  lpac ground\n"
HEADINGS = ["robot", "state", "x", "m", "y", "m", "h", "m", "v", "m/s", "neigh", "n", "bat", "%"]


class Terminal:
    """Where stdout and stderr both go, with a clock."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, width: int, *, real: bool = True) -> None:
        self._bytes = io.BytesIO()
        stream = io.TextIOWrapper(self._bytes, write_through=True)
        monkeypatch.setattr(sys, "stdout", stream)
        monkeypatch.setattr(sys, "stderr", stream)
        console = Console(stderr=True, highlight=False, force_terminal=real, width=width, height=24)
        self.now_s = 0.0
        self.display = FleetDisplay(4, console, lambda: self.now_s)

    @property
    def text(self) -> str:
        return self._bytes.getvalue().decode()

    def lines(self) -> list[str]:
        """Render the output as a terminal would show it."""
        lines, row = [""], 0
        for told in re.findall(r"\x1b\[[\d;?]*[A-Za-z]|\r|\n|[^\x1b\r\n]+", self.text):
            if told == "\n":
                row += 1
                lines += [""] * (row + 1 - len(lines))
            elif told.endswith("A") and told[0] == "\x1b":
                row -= int(told[2:-1])
            elif told == "\x1b[2K":
                lines[row] = ""
            elif told[0] not in "\x1b\r":
                lines[row] += told
        return [line.rstrip() for line in lines]


def statuses(**changes: Any) -> dict[int, Any]:
    """Of four robots; r3 is not heard."""
    flying = status(1, alarms=(), position_m=(31.4, -0.5, 18.5))
    return {0: on_ground(0, failed_checks=CAUSES), 1: flying, 2: status(2, **changes)}


@pytest.mark.parametrize("width", [80, 120, 200])
def test_what_is_to_be_done_next_stays_above_a_table_of_fixed_columns(
    monkeypatch: pytest.MonkeyPatch, width: int
) -> None:
    terminal = Terminal(monkeypatch, width)
    with terminal.display as display:
        for step in ("programs start", "fleet a"):
            terminal.now_s += 1.0
            display.show(step, {})
        display.print(NEXT)
        tops = set()
        for battery in (None, 1.0, 0.05):
            terminal.now_s += 1.0
            display.show("fleet a", statuses(battery=battery))
            *lines, last = terminal.lines()
            # The terminal echoes Ctrl-C there.
            assert not last
            start = next(n for n, line in enumerate(lines) if line.startswith("robot"))
            assert lines[:start] == [*NEXT.splitlines(), "", f"{terminal.now_s:.0f} s: fleet a"]
            assert lines[start].split() == HEADINGS
            assert [line.split()[0] for line in lines[start + 1 :]] == ["r0", "r1", "r2", "r3"]
            tops.add(lines[start])
            reasons_at = len(lines[start].rstrip()) + 1
            assert lines[start + 1][reasons_at:].startswith("mission origin is not set")
            assert lines[start + 1].endswith("…") and max(map(len, lines)) == width
            flying = ["r1", "mission", "31.4", "-0.5", "18.5", "1.0", "3", "90"]
            assert lines[start + 2].split() == [*flying, "mission", "started"]
            assert lines[start + 4].split()[:3] == ["r3", "not", "heard"]
        assert len(tops) == 1
        display.say("r2 has ended")
        said = [*NEXT.splitlines(), "", "   5.0 s  r2 has ended"]
        assert terminal.lines()[:-1] == [*said, *lines[start - 1 :]]
    assert terminal.lines()[: len(said) + 1] == [*said, ""]


def test_without_a_terminal_a_line_says_how_far_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal(monkeypatch, 80, real=False)
    with terminal.display as display:
        display.say("return")
        for _ in range(25):
            terminal.now_s += 1.0
            display.show("fleet a", {})
            display.show_or_say("return", statuses(state=FlightState.LAND))
    assert terminal.lines() == [
        "   0.0 s  return",
        "  10.0 s  return; robots: 1 idle, 1 mission, 1 land",
        "  20.0 s  return; robots: 1 idle, 1 mission, 1 land",
        "",
    ]
