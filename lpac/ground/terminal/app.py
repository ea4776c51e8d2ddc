"""`lpac watch`: the fleet in a terminal.

An ordinary client of the ground process. Quitting it does not affect the fleet.
"""

import asyncio
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, NamedTuple, get_args

from rich.segment import Segment
from rich.style import Style as RichStyle
from textual import work
from textual.app import App, ComposeResult
from textual.containers import Vertical
from textual.events import Key, Resize
from textual.geometry import Region, Size
from textual.scroll_view import ScrollView
from textual.strip import Strip
from textual.theme import Theme

from lpac.analysis.snapshot import FleetSetup, FleetSnapshot
from lpac.ground.alarms import Alarm, Severity, SnapshotHistory, alarms
from lpac.ground.rendering import Row, Span, TextStyle, gravest, in_order
from lpac.ground.station.client import listen, send
from lpac.ground.station.protocol import Request, Resume, SafetyCommand, ServerMessage, TakeCommand
from lpac.ground.terminal.lines import Line, line
from lpac.ground.terminal.robots import columns, detail, heading, summary_lines, table_row
from lpac.ground.terminal.text import (
    HELP,
    KEYS,
    alarm_lines,
    connection_lost,
    few_alarms,
    header,
    outcome,
)

_CONNECT_AGAIN_S = 0.5
# A ground process that is silent for this long counts as lost.
_SILENT_S = 2.0
# A robot stays on top for this long after its alarm, so that rows do not jump.
_STAYS_UP_S = 5.0
# From the top; the bottom parts are always visible.
_PARTS = ("banner", "header", "alarms", "heading", "body", "selected")
_BOTTOM = ("message", "keys")
# Fraction of the height.
_ALARMS_SHARE = 6
# With fewer lines, other parts give their lines to the table.
_SMALL_LINES = 16
_SCREENSHOT_AFTER_S = 3.0
_STEPS = {
    "up": -1, "k": -1, "down": 1, "j": 1, "pageup": -10, "pagedown": 10, "home": -999, "end": 999,
}  # fmt: skip

_DARK = Theme(
    "night", primary="#7fb4ff", dark=True, background="#10151b", foreground="#d5dbe2",
    surface="#10151b", panel="#1a222c",
    variables={
        "faint": "#74808d", "good": "#7fd28c", "calm": "#7fb4ff", "busy": "#e9c46a",
        "foreign": "#d79bf0", "critical": "#ff6b60", "warning": "#f2b04b", "note": "#9aa5b1",
        "strong": "#ffffff", "bar": "#2b4560", "banner": "#ffffff", "alert": "#b3261e",
    },
)  # fmt: skip
_LIGHT = Theme(
    "sun", primary="#0b4f9e", dark=False, background="#ffffff", foreground="#111418",
    surface="#ffffff", panel="#e8ecf0",
    variables={
        "faint": "#66707a", "good": "#0a6b1d", "calm": "#0b4f9e", "busy": "#7a5200",
        "foreign": "#7a1fa2", "critical": "#c00000", "warning": "#a34700", "note": "#4b545d",
        "strong": "#000000", "bar": "#bcd8f7", "banner": "#ffffff", "alert": "#b00000",
    },
)  # fmt: skip
_BOLD = ("strong", "critical", "warning", "busy", "calm", "good", "banner")


class Lines(ScrollView):
    """Lines of styled text. Only changed lines are redrawn."""

    app: "Watch"

    def __init__(self, name: str) -> None:
        super().__init__(id=name, can_focus=False)
        self._lines: list[Line] = []
        self._selected: int | None = None

    def show(self, lines: Sequence[Line], selected: int | None = None) -> None:
        """Show these lines; scroll to the `selected` one."""
        before, self._lines = self._lines, list(lines)
        moved = selected != self._selected
        was, self._selected = self._selected, selected
        if len(before) != len(self._lines):
            self.virtual_size = Size(self.size.width, len(self._lines))
            self.refresh()
        else:
            pairs = enumerate(zip(before, self._lines, strict=True))
            changed = {at for at, (old, new) in pairs if old != new}
            if moved:
                changed |= {at for at in (was, selected) if at is not None}
            top, width = self.scroll_offset.y, self.size.width
            for at in changed:
                self.refresh(Region(0, at - top, width, 1))
        if moved and selected is not None:
            self.scroll_to_region(Region(0, selected, 1, 1), animate=False, force=True)

    def render_line(self, y: int) -> Strip:
        """Render one visible line for Textual."""
        at = y + self.scroll_offset.y
        base = self.rich_style
        if at >= len(self._lines):
            return Strip.blank(self.size.width, base)
        styles = self.app.styles_of_text
        if at == self._selected:
            base += styles["bar"]
        segments = [Segment(span.text, base + styles[span.style]) for span in self._lines[at]]
        return Strip(segments).adjust_cell_length(self.size.width, base)


class _Question(NamedTuple):
    """A question, and the request to send if the answer is y."""

    text: str
    word: str
    request: Request


_COMMAND = _Question("Take the command of the fleet?", "take command", TakeCommand())
_QUESTIONS = {
    "r": _Question("Withdraw hold, return and land, and fly on?", "resume", Resume()),
    "c": _COMMAND, "C": _COMMAND,
}  # fmt: skip


class Watch(App[str]):
    """The view. With `screenshot`, quit after 3 s and return an SVG."""

    ENABLE_COMMAND_PALETTE = False
    TITLE = "lpac watch"
    CSS = """
    Screen { overflow: hidden hidden; }
    Lines { overflow: hidden hidden; scrollbar-size-vertical: 1; }
    #banner { height: 4; display: none; }
    #header { height: 3; background: $panel; }
    #heading { height: 2; background: $panel; }
    #body {
        height: 1fr; overflow-y: auto; scrollbar-color: $faint; scrollbar-background: $panel;
    }
    #selected { height: 2; background: $panel; }
    #bottom { dock: bottom; height: 2; }
    #message { height: 1; background: $panel; }
    #keys { height: 1; background: $panel; }
    """

    def __init__(self, fleet: str, *, screenshot: bool = False) -> None:
        super().__init__()
        for theme in (_DARK, _LIGHT):
            self.register_theme(theme)
        self.theme = _DARK.name
        self.styles_of_text: dict[str, RichStyle] = {}
        self._fleet = fleet
        self._ends_by_screenshot = screenshot
        self._setup: FleetSetup | None = None
        self._snapshot: FleetSnapshot | None = None
        self._history = SnapshotHistory()
        self._began_s = self._received_at_s = time.monotonic()
        self._problem = "connecting"
        self._up_until_s: dict[str, tuple[Severity, float]] = {}
        self._rows: list[Row] = []
        self._alarms: tuple[Alarm, ...] = ()
        self._selected = ""
        self._view: Literal["table", "robot", "alarms", "help"] = "table"
        self._question: _Question | None = None
        self._message = Span("")

    def compose(self) -> ComposeResult:
        for name in _PARTS:
            yield Lines(name)
        yield Vertical(*map(Lines, _BOTTOM), id="bottom")

    def on_mount(self) -> None:
        self.theme_changed_signal.subscribe(self, lambda _: self._take_theme())
        self._take_theme()
        self.set_interval(0.5, self._check_silence)
        self._listen()

    def on_resize(self, event: Resize) -> None:
        lines = event.size.height
        least = 2 if lines < _SMALL_LINES else 3
        self.query_one("#alarms").styles.height = max(least, lines // _ALARMS_SHARE)
        self.call_after_refresh(self._draw)

    def _take_theme(self) -> None:
        variables = self.theme_variables
        self.styles_of_text = {"": RichStyle()} | {
            name: RichStyle(color=variables[name], bold=name in _BOLD)
            for name in get_args(TextStyle)
            if name not in ("", "bar")
        }
        self.styles_of_text["banner"] += RichStyle(bgcolor=variables["alert"])
        self.styles_of_text["bar"] = RichStyle(bgcolor=variables["bar"])
        self.refresh()

    @work
    async def _listen(self) -> None:
        """Follow the ground process, and reconnect when it has ended."""
        while True:
            try:
                async for message in listen(self._fleet):
                    self._take(message)
            except (OSError, ValueError) as error:
                self._problem = str(error)
                self._draw()
            await asyncio.sleep(_CONNECT_AGAIN_S)

    def _take(self, message: ServerMessage) -> None:
        now_s = time.monotonic()
        if isinstance(message, FleetSetup):
            self._setup = message
        elif isinstance(message, FleetSnapshot) and self._setup is not None:
            if self._problem:
                self._history = SnapshotHistory()
            self._problem = ""
            self._snapshot, self._received_at_s = message, now_s
            self._update(message, self._setup, now_s)
            self._draw()
            if self._ends_by_screenshot and now_s - self._began_s > _SCREENSHOT_AFTER_S:
                self.exit(self.export_screenshot())

    def _update(self, snapshot: FleetSnapshot, setup: FleetSetup, now_s: float) -> None:
        self._alarms = alarms(setup, snapshot, self._history.add(snapshot, now_s))
        for robot, alarm in gravest(self._alarms).items():
            if alarm.severity != "note":
                self._up_until_s[robot] = alarm.severity, now_s + _STAYS_UP_S
        lasting = {r: sev for r, (sev, until_s) in self._up_until_s.items() if now_s < until_s}
        self._rows = in_order(setup, snapshot, self._alarms, lasting)
        if self._selected not in setup.robots and self._rows:
            self._selected = self._rows[0].robot.name

    def _check_silence(self) -> None:
        silent_s = time.monotonic() - self._received_at_s
        if not self._problem and silent_s > _SILENT_S:
            self._problem = "`lpac ground` runs but sends nothing"
        if self._problem:
            self._draw()

    def _draw(self) -> None:
        # A snapshot may still come while the view closes.
        if not self.is_running:
            return
        now_s = time.monotonic()
        width = self.size.width
        banner = self.query_one("#banner", Lines)
        lost_s = now_s - self._received_at_s
        # No banner during the first attempt to connect.
        banner.display = bool(self._problem) and lost_s > _CONNECT_AGAIN_S
        if banner.display:
            banner.show(connection_lost(self._setup, self._problem, lost_s, width))
        question = self._question
        prompt = question and Span(f"{question.text}  y: yes, any other key: no ", "banner")
        self._show("message", [line(width, Span(" "), prompt or self._message)])
        self._show("keys", [line(width, *KEYS)])
        setup, snapshot = self._setup, self._snapshot
        if setup is None or snapshot is None:
            return
        self._show("header", header(setup, snapshot, width))
        alarms_height = self.query_one("#alarms").size.height
        self._show("alarms", few_alarms(self._alarms, width, alarms_height))
        self._draw_body(setup, snapshot, lost_s if self._problem else 0.0)

    def _draw_body(self, setup: FleetSetup, snapshot: FleetSnapshot, lost_s: float) -> None:
        # One column is the scroll bar's.
        width = self.size.width - 1
        rows = [
            row._replace(robot=replace(row.robot, age_s=row.robot.age_s + lost_s))
            if lost_s and row.robot.age_s is not None
            else row
            for row in self._rows
        ]
        names = [row.robot.name for row in rows]
        at = names.index(self._selected) if self._selected in names else 0
        self.query_one("#selected").display = (
            self._view == "table" and self.size.height >= _SMALL_LINES
        )
        if self._view == "table":
            if rows:
                self._show("selected", summary_lines(rows[at], width))
            shown = columns(setup, width)
            self._show("heading", heading(shown))
            self._show("body", [table_row(shown, row) for row in rows], at)
            return
        back = "Esc: back   PgUp PgDn: scroll"
        if self._view == "robot":
            one = self._selected
            back = f"{back}   j k: next robot   H: hold {one}   L: land {one}"
            title, *lines = detail(rows[at], snapshot, self._alarms, width)
        elif self._view == "alarms":
            title, *lines = (
                line(width, Span("all alarms", "strong")),
                *alarm_lines(self._alarms, width),
            )
        else:
            title, *lines = (line(width, Span(text)) for text in HELP)
        self._show("heading", [title, line(width, Span(back, "faint"))])
        self._show("body", lines)

    def _show(self, name: str, lines: Sequence[Line], selected: int | None = None) -> None:
        self.query_one(f"#{name}", Lines).show(lines, selected)

    def action_help_quit(self) -> None:
        """Quit on Ctrl-C."""
        self.exit()

    def on_key(self, event: Key) -> None:
        """Handle every key here, so that hold takes precedence."""
        key = event.character if event.is_printable and event.character else event.key
        capital = key in ("H", "L") and self._view == "robot"
        robots = (self._selected,) if capital else ()
        target = self._selected if capital else "the fleet"
        question, self._question = self._question, None
        if key in ("h", "H"):
            self._send(f"hold {target}", SafetyCommand("hold", robots))
        elif question is not None:
            self._message = Span("nothing done")
            if key in ("y", "Y"):
                self._send(question.word, question.request)
        elif key in ("l", "L"):
            text = f"Land {self._selected if capital else 'the WHOLE FLEET'} where it is?"
            self._question = _Question(text, f"land {target}", SafetyCommand("land", robots))
        elif key in _QUESTIONS:
            self._question = _QUESTIONS[key]
        elif key == "q":
            self.exit()
        elif key == "t":
            self.theme = _LIGHT.name if self.theme == _DARK.name else _DARK.name
        else:
            self._move(key)
        event.stop()
        self._draw()

    def _move(self, key: str) -> None:
        """Handle keys that only change the view."""
        body = self.query_one("#body", Lines)
        if key in ("escape", "enter") and self._view != "table":
            self._go("table")
        elif key == "enter":
            self._go("robot")
        elif key == "a":
            self._go("alarms")
        elif key == "?":
            self._go("help")
        elif key in ("pagedown", "pageup") and self._view != "table":
            body.scroll_relative(
                y=body.size.height * (1 if key == "pagedown" else -1), animate=False
            )
        elif key in _STEPS and self._rows:
            names = [row.robot.name for row in self._rows]
            at = names.index(self._selected) + _STEPS[key]
            self._selected = names[min(max(at, 0), len(names) - 1)]

    def _go(self, view: Literal["table", "robot", "alarms", "help"]) -> None:
        self._view = view
        self.query_one("#body", Lines).scroll_to(y=0, animate=False)

    @work
    async def _send(self, word: str, request: Request) -> None:
        """Send concurrently, so that a hold does not wait for an earlier command."""
        self._message = Span(f"{word} ...", "busy")
        self._draw()
        try:
            result = outcome(word, await send(self._fleet, request))
        except (OSError, ValueError) as error:
            result = Span(f"{word} NOT SENT: {error}", "critical")
        self._message = Span(f"{time.strftime('%H:%M:%S')} {result.text}", result.style)
        self._draw()
