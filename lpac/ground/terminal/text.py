"""Text of `lpac watch` above and below its table. Pure."""

from collections.abc import Iterable, Sequence
from itertools import accumulate

from edge.messages.mission import GroundState
from lpac.analysis.snapshot import FleetSetup, FleetSnapshot
from lpac.ground.alarms import ID, Alarm, Severity
from lpac.ground.rendering import MARKS, Span, direction, duration, fence_size, in_order
from lpac.ground.station.protocol import CommandReport
from lpac.ground.terminal.lines import Line, fit, line, plain, some, wrapped
from lpac.ground.terminal.robots import columns, heading, table_row

_OTHER_KEYS = {
    "l": "land", "r": "resume", "Enter": "robot", "a": "alarms", "?": "help", "q": "quit",
}  # fmt: skip
KEYS: Line = (
    Span(" h HOLD  ", "strong"),
    *(
        span
        for key, does in _OTHER_KEYS.items()
        for span in (Span(f" {key} ", "strong"), Span(f"{does}  ", "faint"))
    ),
)
HELP = (
    "Keys",
    "h      HOLD the whole fleet, at once, in every view",
    "l      land the whole fleet where it is (asks; y is yes)",
    "r      resume: withdraw hold, return and land, and fly on (asks; y is yes)",
    "c      take the command of the fleet from another station (asks; y is yes)",
    "j k    next and previous robot, as the arrows",
    "Enter  everything about the robot; again, or Esc: back",
    "H L    there: hold it at once, land it (asks); elsewhere as h and l",
    "a      all alarms",
    "t      light or dark: for the sun, for the night",
    "q      quit; the fleet is not touched",
    "",
    "!      critical: act now.  *  warning: look into it.  -  note: good to know.",
    "       Robots with ! and * are on top. A robot that is not heard is faint.",
    "",
    "x y h  in the mission frame; height above its own takeoff point",
    "feat   age of the policy's features",
    "neigh  number of neighbours, mean rate and worst age of their messages",
    "lag    lateness of its loops in the last minute, 99th percentile",
    "link   age of its last status",
    "fence  distance inside the fence's line",
    "reason its gravest alarm; without one, the reason of its state",
)


def header(setup: FleetSetup, snapshot: FleetSnapshot, width: int) -> list[Line]:
    """Three lines about the fleet."""
    state, mission_s = snapshot.state, snapshot.mission_s
    clock = "" if mission_s is None else f"mission {duration(mission_s)}"
    who = _commander(setup, snapshot)
    trial = state.trial and f"trial {state.trial}"
    running = ", ".join(snapshot.running)
    first = _spaced(Span(setup.fleet, "strong"), who, Span(trial))
    return [
        (*line(width - len(clock) - 1, *first), Span(" " + clock, "strong")),
        line(
            width,
            *_spaced(
                _enabled(state),
                _safety_action(setup, state) if snapshot.ground else Span(""),
                Span(running and f"now: {running}", "busy"),
                Span(f"fence {fence_size(state.fence or setup.fence)}"),
            ),
        ),
        line(width, *_spaced(*_field(setup, snapshot))),
    ]


def _spaced(*spans: Span) -> list[Span]:
    return [part for span in spans if span.text for part in (span, Span("  "))][:-1]


def _commander(setup: FleetSetup, snapshot: FleetSnapshot) -> Span:
    if not snapshot.commander:
        return Span(f"nobody commands (this is {setup.operator})", "warning")
    if snapshot.commander == setup.operator:
        return Span(f"{setup.operator} commands")
    return Span(f"{snapshot.commander} commands, {setup.operator} observes", "foreign")


def _enabled(state: GroundState) -> Span:
    others = sum(enabled != state.enabled for enabled in state.robot_enabled.values())
    but = f" but {others}" if others else ""
    return Span(f"ENABLED{but}", "busy") if state.enabled else Span(f"not enabled{but}")


def _safety_action(setup: FleetSetup, state: GroundState) -> Span:
    names = {str(robot_id): name for name, robot_id in setup.robots.items()}
    asked = [] if state.safety_action == "none" else [state.safety_action.upper()]
    for safety_action in ("hold", "return", "land", "none"):
        who = [
            names.get(r, r)
            for r, c in state.robot_safety_actions.items()
            if c == safety_action != state.safety_action
        ]
        if who:
            asked.append(
                f"{'FLY' if safety_action == 'none' else safety_action.upper()} {some(who, 16)}"
            )
    by = state.safety_action_by or state.operator
    return Span(f"{', '.join(asked)} by {by}", "calm") if asked else Span("no hold")


def _field(setup: FleetSetup, snapshot: FleetSnapshot) -> Iterable[Span]:
    origin = snapshot.state.origin
    if origin is None:
        yield Span("no origin", "warning")
    else:
        yield Span(
            f"origin {origin.latitude_deg:.5f} {origin.longitude_deg:.5f} "
            f"{direction(origin.heading_deg)}"
        )
    yield Span(f"bundle {setup.bundle_id[:ID]}")
    world = snapshot.state.world_id or setup.world_id
    yield Span(f"world {world[:ID]}")


def alarm_lines(alarms: Sequence[Alarm], width: int) -> list[Line]:
    """All alarms; robots with the same alarm share a line."""
    return [line for one in _each_alarm(alarms, width) for line in one]


def _each_alarm(alarms: Sequence[Alarm], width: int) -> list[list[Line]]:
    robots: dict[tuple[Severity, str], list[str]] = {}
    for severity, robot, _, text in alarms:
        robots.setdefault((severity, text), []).append(robot or "fleet")
    who = 14
    return [
        wrapped(
            width,
            (
                Span(f"{MARKS[severity]} ", severity),
                Span(f"{fit(some(names, who), who)} ", "" if severity == "note" else severity),
            ),
            Span(text, "" if severity == "note" else severity),
        )
        for (severity, text), names in robots.items()
    ]


def few_alarms(alarms: Sequence[Alarm], width: int, height: int) -> list[Line]:
    """As many alarms as fit, and the number of the others."""
    each = _each_alarm(alarms, width)
    lines = [line for one in each for line in one]
    if not lines:
        return [line(width, Span("no alarms", "good"))]
    if len(lines) > height:
        hidden = sum(end > height - 1 for end in accumulate(map(len, each)))
        lines = [*lines[: height - 1], line(width, Span(f"  {hidden} more: a shows all", "faint"))]
    return lines


def connection_lost(setup: FleetSetup | None, text: str, lost_s: float, width: int) -> list[Line]:
    """Banner while there is no ground process; `text` is the cause."""
    then = "hold, then land where they are."
    if setup is not None:
        hold_s = setup.ground_timeout_s
        land_s = hold_s + setup.ground_lost_land_s
        then = f"hold after {hold_s:g} s, land where they are after {land_s:g} s."
    texts = (
        f"NO GROUND STATION for {duration(lost_s)}",
        f"{text[:1].upper()}{text[1:]}.",
        f"Robots without a ground: {then}",
        "The view reconnects automatically; it shows the last known state.",
    )
    return [line(width, Span(f" {fit(text, width - 1)}", "banner")) for text in texts]


def outcome(word: str, report: CommandReport) -> Span:
    """Results of a command, failures first."""
    if report.problem is not None:
        return Span(f"{word} NOT DONE: {report.problem.text}", "critical")
    who: dict[tuple[bool, str], list[str]] = {}
    for result in report.results:
        who.setdefault((result.done, result.text), []).append(result.robot)
    parts = [
        f"{'' if done else 'NOT '}{_robots(names, report)}: {text}"
        for (done, text), names in sorted(who.items(), key=lambda item: item[0][0])
    ]
    return Span(f"{word}: {'; '.join(parts) or 'no robot'}", "good" if report.done else "critical")


def _robots(names: Sequence[str], report: CommandReport) -> str:
    is_all = len(names) == len(report.results) > 4
    return f"all {len(names)}" if is_all else some(names, 16)


def full_view(
    setup: FleetSetup, snapshot: FleetSnapshot, alarms: Sequence[Alarm], width: int
) -> str:
    """The whole view as plain text."""
    shown = columns(setup, width)
    rows = in_order(setup, snapshot, alarms)
    lines = [
        *header(setup, snapshot, width),
        *alarm_lines(alarms, width),
        line(width),
        *heading(shown),
        *(table_row(shown, row) for row in rows),
    ]
    return plain(lines)
