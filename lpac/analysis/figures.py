"""Figures of flights. Times are s from the mission's start."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon, Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from edge.core import F64
from edge.messages.mission import FlightState
from lpac.analysis import style
from lpac.analysis.flight import LOOPS, FlightRecord, LoopLateness, Messages, RobotRecord, quantile
from lpac.analysis.style import FAINT, GREY, INK, WIDTH_IN, tidy

SNAPSHOTS = (0.0, 0.25, 0.5, 1.0)  # of a mission's duration
# Shown with costs that rise by at least this share.
_RISES = "The cost may rise at first: robots\nleave covered areas to explore others."
_RISE = 0.05
LLOYD = "Lloyd, knowing the whole world"
_MUCH_MS, _MUCH_LOSS = 200.0, 10.0
_MOST_NAMES, _MOST_SMALL_NAMES, _MOST_TICKS, _MOST_STATES_IN_ROW = 12, 32, 8, 7
_LONGEST_IN_DISC = 2
_HALO = [withStroke(linewidth=1.6, foreground="white")]


def snapshots(flight: FlightRecord, times_s: Sequence[float]) -> Figure:
    """Robots, Voronoi cells and paths at some times, over the density seen until then."""
    rows = -(-len(times_s) // 4)
    columns = -(-len(times_s) // rows)
    with style.figure(WIDTH_IN, rows * (WIDTH_IN / columns + 0.35) + 0.25) as figure:
        _draw_snapshots(figure, flight, times_s, rows, columns)
        return figure


def snapshots_of_several(flights: Mapping[str, FlightRecord], times_s: Sequence[float]) -> Figure:
    """A row of snapshots per flight, by its name; all worlds must have one size."""
    count = len(times_s)
    with style.figure(WIDTH_IN, len(flights) * WIDTH_IN / count + 0.55) as figure:
        panels = figure.subplots(len(flights), count, squeeze=False, sharex=True, sharey=True)
        for row, flight in zip(panels, flights.values(), strict=True):
            for axes, time_s in zip(row, times_s, strict=True):
                _draw_snapshot(axes, flight, time_s)
        for axes in panels[1:].ravel():
            axes.set_title("")
        _frame(panels, next(iter(flights.values())), margin=False)
        for axes, name in zip(panels[:, 0], flights, strict=True):
            axes.set_ylabel(f"{name}\ny (m)")
        _add_snapshot_legend(figure, has_world=True)
        return figure


def snapshots_and_costs(flights: Mapping[str, FlightRecord]) -> Figure:
    """Snapshots of the first flight above the costs of all, by name."""
    first = next(iter(flights.values()))
    with style.figure(WIDTH_IN, 4.3) as figure:
        rows = figure.add_gridspec(2, 1, height_ratios=(1.12, 0.88))
        above, below = figure.add_subfigure(rows[0]), figure.add_subfigure(rows[1])
        _draw_snapshots(above, first, [share * first.duration_s for share in SNAPSHOTS], 1, 4)
        draw_costs(below.subplots(), flights)
        return figure


def draw_snapshot(axes: Axes, flight: FlightRecord, time_s: float) -> None:
    """Draw one of the `snapshots` into your axes: robots, their cells, and paths, in m."""
    _draw_snapshot(axes, flight, time_s)
    _frame(np.array([[axes]]), flight, margin=False)


def draw_costs(axes: Axes, flights: Mapping[str, FlightRecord]) -> None:
    """Draw the normalised coverage cost of flights, by name, over time into your axes.

    The legend, beside the axes, has the final costs; a "constrained" layout leaves room for it.
    Records without a world are left out.
    """
    for index, (name, flight) in enumerate(flights.items()):
        _draw_cost(axes, flight, *style.CURVES[index % len(style.CURVES)], name)
    _frame_costs(axes, max(flight.duration_s for flight in flights.values()))
    if any(map(_rises, flights.values())):
        axes.text(1.02, 0.0, _RISES, transform=axes.transAxes, fontsize=7, va="bottom")


def draw_states(axes: Axes, flight: FlightRecord) -> None:
    """Draw a bar per robot, coloured by state, into your axes; simulated points have no states.

    The legend is above the axes.
    """
    handles = _draw_states(axes, flight)
    axes.legend(
        handles=handles, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4, handlelength=1.0,
        handleheight=0.8,
    )  # fmt: skip
    axes.set(xlabel="time since the mission began (s)", xlim=(flight.from_s, flight.to_s))


def draw_heights(axes: Axes, flight: FlightRecord) -> None:
    """Draw each robot's height above its pad over time, m, into your axes; 0 for points."""
    _draw_heights(axes, flight)
    axes.set(xlabel="time since the mission began (s)", xlim=(flight.from_s, flight.to_s))


def start_and_end(flight: FlightRecord) -> Figure:
    """Map of the flight: the robots' paths in the mission, takeoff and landing points."""
    with style.figure(6.2, 4.0) as figure:
        handles = _draw_field(figure.subplots(), flight)
        figure.legend(handles=handles, loc="outside right center")
        return figure


def overview(flight: FlightRecord) -> Figure:
    """Map of the flight, with states, heights and coverage cost over time."""
    with style.figure(WIDTH_IN, 4.7) as figure:
        columns = figure.add_gridspec(1, 2, width_ratios=(1.08, 1.0))
        left, right = figure.add_subfigure(columns[0]), figure.add_subfigure(columns[1])
        handles = _draw_field(left.subplots(), flight)
        left.legend(handles=handles, loc="outside lower center", ncols=2, fontsize=7)
        upper, middle, lower = right.subplots(3, 1, sharex=True, height_ratios=(1.3, 1.0, 1.0))
        handles = _draw_states(upper, flight)
        upper.legend(
            handles=handles, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4, fontsize=6.5,
            handlelength=1.0, handleheight=0.8, columnspacing=1.0, borderpad=0.2,
        )  # fmt: skip
        _draw_heights(middle, flight)
        if len(flight.normalized):
            _draw_cost(lower, flight, style.BLACK, "-", "estimated positions")
            if np.isfinite(flight.true_cost).any():
                lower.plot(
                    flight.curve_time_s, flight.normalized_true, color=style.VERMILLION, ls="--",
                    lw=1.2, label=f"{flight.normalized_true[-1]:.2f}  true positions",
                )  # fmt: skip
            _draw_lloyd(lower, flight)
            lower.legend(
                loc="lower center", bbox_to_anchor=(0.5, 0.98), ncols=2, fontsize=6.5,
                handlelength=1.8, columnspacing=1.0, handletextpad=0.5, borderpad=0.1,
            )  # fmt: skip
        lower.set(ylabel=r"cost $J\,/\,J(0)$", ylim=(0.0, None))
        tidy(lower)
        time_label = "time since the mission began (s)"
        if _rises(flight):
            time_label += f"\n{_RISES}"
        lower.set(xlabel=time_label, xlim=(flight.from_s, flight.to_s))
        right.align_ylabels([upper, middle, lower])
        return figure


def costs(flights: Sequence[FlightRecord]) -> Figure:
    """Normalised coverage cost of each flight over time, with the result of Lloyd's algorithm."""
    with style.figure(WIDTH_IN, 2.5) as figure:
        axes = figure.subplots()
        for index, flight in enumerate(flights):
            colour, dashes = style.CURVES[index % len(style.CURVES)]
            _draw_cost(axes, flight, colour, dashes, flight.name)
            _draw_lloyd(axes, flight, colour)
        _frame_costs(axes, max(flight.duration_s for flight in flights))
        return figure


def repeatability(flights: Sequence[FlightRecord]) -> Figure:
    """Costs of all missions with mean and deviation, and the robots' end positions by mission.

    Thin curves are costs from the vehicles' true positions, where recorded.
    """
    colours = style.colours_of(len(flights))
    with style.figure(WIDTH_IN, 3.1) as figure:
        left, right = figure.subplots(1, 2, width_ratios=(1.25, 1.0))
        end_s = min(flight.duration_s for flight in flights)
        times_s = np.linspace(0.0, end_s, 300)
        curves = np.array([np.interp(times_s, f.curve_time_s, f.normalized) for f in flights])
        for flight, colour in zip(flights, colours, strict=True):
            left.plot(flight.curve_time_s, flight.normalized, color=colour, lw=0.8)
            if flight.truth:
                left.plot(flight.curve_time_s, flight.normalized_true, color=colour, lw=0.4)
        mean, deviation = curves.mean(axis=0), curves.std(axis=0, ddof=1)
        left.fill_between(times_s, mean - deviation, mean + deviation, color=FAINT, alpha=0.6, lw=0)
        left.plot(times_s, mean, color="k", lw=1.8)
        lloyd = float(np.mean([flight.normalized_lloyd for flight in flights]))
        left.axhline(lloyd, color="k", lw=0.8, ls=style.DOTTED)
        handles = [
            Line2D([], [], color="k", lw=1.8, label=f"mean, {mean[-1]:.2f} at {end_s:.0f} s"),
            Patch(color=FAINT, label=f"standard deviation, {deviation[-1]:.3f}"),
            Line2D([], [], color="k", lw=0.8, ls=style.DOTTED, label=f"{LLOYD}, {lloyd:.2f}"),
        ]
        if any(flight.truth for flight in flights):
            handles.append(Line2D([], [], color=INK, lw=0.4, label="a mission, true cost"))
        left.legend(
            handles=handles, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2,
            handlelength=1.6, fontsize=7, columnspacing=1.0, borderaxespad=0.2,
        )  # fmt: skip
        _frame_cost_axes(left, max(flight.duration_s for flight in flights))
        if all(flight.coverage is flights[0].coverage for flight in flights):
            _draw_world(right, flights[0])
        for flight, colour in zip(flights, colours, strict=True):
            places_m = np.array(list(flight.places_at(flight.duration_s).values())).reshape(-1, 2)
            right.plot(*places_m.T, ls="", marker="o", ms=4.5, color=colour, mec="k", mew=0.4)
        right.set_title("end positions, coloured by mission")
        _frame(np.array([[right]]), flights[0], margin=False)
        if len(flights) <= _MOST_NAMES:
            handles = [
                Line2D([], [], ls="", marker="o", ms=4.5, color=colour, mec="k", label=flight.name)
                for flight, colour in zip(flights, colours, strict=True)
            ]
            figure.legend(
                handles=handles, loc="outside lower center", ncols=min(len(flights), 6),
                handlelength=1.0,
            )  # fmt: skip
        return figure


def states(flight: FlightRecord) -> Figure:
    """A bar per robot, coloured by state, with alarms and restarts on it."""
    with style.figure(WIDTH_IN, 0.9 + 0.2 * max(len(flight.robots), 3)) as figure:
        axes = figure.subplots()
        handles = _draw_states(axes, flight)
        rows = -(-len(handles) // _MOST_STATES_IN_ROW)
        figure.legend(
            handles=handles, loc="outside upper center", ncols=-(-len(handles) // rows),
            handlelength=1.0, handleheight=0.8,
        )  # fmt: skip
        axes.set(xlabel="time (s)", xlim=(flight.from_s, flight.to_s))
        return figure


def messages(flight: FlightRecord, received: Messages) -> Figure:
    """Ages and losses of messages, by pair of robots and over time."""
    names = [robot.name for robot in flight.robots]
    with style.figure(WIDTH_IN, 4.6) as figure:
        rows = figure.add_gridspec(2, 1, height_ratios=(1.25, 1.0))
        upper, lower = figure.add_subfigure(rows[0]), figure.add_subfigure(rows[1])
        panels = upper.subplots(1, 2)
        age_ms, loss = 1e3 * received.age_s, 100.0 * received.loss
        draw_matrix(upper, panels[0], age_ms, names, "median age (ms)", _MUCH_MS)
        draw_matrix(upper, panels[1], loss, names, "lost (%)", _MUCH_LOSS)
        left, right = lower.subplots(1, 2)
        edges_s = np.linspace(0.0, flight.duration_s, max(2, min(61, int(flight.duration_s) + 1)))
        middles_s = (edges_s[1:] + edges_s[:-1]) / 2.0
        bins = np.digitize(received.heard_at_s, edges_s) - 1
        for share, dashes, name in ((0.5, "-", "median"), (0.95, "--", "95th percentile")):
            ages_s = (received.heard_age_s[bins == b] for b in range(len(middles_s)))
            values = [quantile(each_s, share) for each_s in ages_s]
            left.plot(middles_s, 1e3 * np.array(values), color=style.BLUE, ls=dashes, label=name)
        left.set(ylabel="message age (ms)")
        left.legend(loc="upper right", ncols=2)
        came = np.histogram(received.heard_at_s, edges_s)[0]
        missing = np.histogram(received.gaps[:, 0], edges_s, weights=received.gaps[:, 1])[0]
        share_lost = 100.0 * missing / np.maximum(came + missing, 1)
        right.stairs(
            share_lost, edges_s, fill=True, color=style.VERMILLION, alpha=0.4, lw=0, zorder=2
        )
        right.stairs(share_lost, edges_s, baseline=None, color=style.VERMILLION, lw=1.4, zorder=3)
        right.set(ylabel="lost (%)")
        # Keep a line at 0 visible above the axis.
        for axes, least, below in ((left, 10.0, 0.0), (right, _MUCH_LOSS, 0.05)):
            highest = max(1.25 * axes.get_ylim()[1], least)
            axes.set(
                xlabel="time (s)", xlim=(0.0, flight.duration_s), ylim=(-below * highest, highest)
            )
            tidy(axes)
        return figure


def loops(flight: FlightRecord) -> Figure:
    """Lateness of the loops' ticks, over time and by robot at the end."""
    with style.figure(WIDTH_IN, 3.6) as figure:
        panels = figure.subplots(2, len(LOOPS), sharey="row")
        for column, loop in enumerate(LOOPS):
            _draw_lateness(panels[0, column], flight, flight.lateness[loop])
            panels[0, column].set_title(f"{loop} loop")
            _draw_robots_lateness(panels[1, column], flight.lateness[loop])
        panels[0, 0].set_ylabel("lateness, 99th\npercentile (ms)")
        panels[1, 0].set_ylabel("lateness at\nthe end (ms)")
        panels[0, 0].legend(loc="upper left", handlelength=1.6, fontsize=7)
        panels[1, 0].legend(
            loc="upper left", handlelength=0.6, ncols=3, columnspacing=0.8, fontsize=7
        )
        for row, room in zip(panels, (1.7, 1.4), strict=True):
            row[0].set_ylim(0.0, room * max(row[0].get_ylim()[1], 1.0))
        return figure


def _draw_lateness(axes: Axes, flight: FlightRecord, robots: Mapping[str, LoopLateness]) -> None:
    for index, late in enumerate(robots.values()):
        label = "each robot" if index == 0 else None
        axes.plot(late.time_s, late.p99_ms, color=style.SKY, lw=0.6, alpha=0.8, label=label)
    if robots:
        times_s = np.linspace(0.0, flight.duration_s, 200)
        curves = np.array([np.interp(times_s, r.time_s, r.p99_ms) for r in robots.values()])
        axes.plot(times_s, curves.max(axis=0), color=style.VERMILLION, lw=1.2, label="worst robot")
        axes.plot(times_s, np.median(curves, axis=0), color="k", lw=1.2, label="median robot")
    axes.set(xlabel="time (s)", xlim=(0.0, flight.duration_s))
    tidy(axes)


def _draw_robots_lateness(axes: Axes, robots: Mapping[str, LoopLateness]) -> None:
    places = np.arange(len(robots))
    for key, colour, marker, label in (
        ("max_ms", style.VERMILLION, "^", "maximum"),
        ("p99_ms", style.BLUE, "s", "99 %"),
        ("p50_ms", "k", "o", "median"),
    ):
        values = [getattr(late, key)[-1] for late in robots.values()]
        axes.plot(places, values, ls="", marker=marker, ms=4, color=colour, label=label)
    step = -(-len(robots) // _MOST_TICKS) or 1
    axes.set(xlim=(-0.6, max(len(robots) - 0.4, 0.6)), xlabel="robot")
    axes.set_xticks(places[::step], list(robots)[::step])
    tidy(axes)


def _draw_snapshots(
    figure: Any, flight: FlightRecord, times_s: Sequence[float], rows: int, columns: int
) -> None:
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for axes in panels.ravel()[len(times_s) :]:
        axes.set_visible(False)
    for axes, time_s in zip(panels.ravel(), times_s, strict=False):
        _draw_snapshot(axes, flight, time_s)
    _frame(panels, flight, margin=False)
    for axes in panels.ravel()[len(times_s) - columns : len(times_s)]:
        axes.tick_params(labelbottom=True)
        axes.set_xlabel("x (m)")
    _add_snapshot_legend(figure, has_world=flight.coverage is not None)


def _draw_snapshot(axes: Axes, flight: FlightRecord, time_s: float) -> None:
    _draw_world(axes, flight, time_s)
    _draw_cells(axes, flight, time_s)
    for robot in flight.robots:
        _draw_path(axes, robot, 0.0, time_s, style.SWARM)
    _draw_robots(axes, flight.places_at(time_s), small=True)
    axes.set_title(f"$t$ = {round(time_s, 1):g} s")


def _add_snapshot_legend(figure: Any, *, has_world: bool) -> None:
    handles: list[Any] = [
        _robot_handle(style.SWARM, "robot, its name"),
        Line2D([], [], color=style.SWARM, lw=1.0, label="path"),
    ]
    if has_world:
        handles += _world_handles()
    figure.legend(
        handles=handles, loc="outside upper center", ncols=len(handles), fontsize=6.5,
        handlelength=1.6, handleheight=0.9, columnspacing=1.0, handletextpad=0.5,
    )  # fmt: skip


def _draw_field(axes: Axes, flight: FlightRecord) -> list[Any]:
    """Draw the world as seen at the end, the fence, and each robot; returns legend handles."""
    _draw_world(axes, flight, flight.duration_s)
    _draw_cells(axes, flight, flight.duration_s)
    handles: list[Any] = [_robot_handle(FAINT, "robot at the end, its name")]
    begin_s, end_s = (0.0, flight.duration_s) if flight.duration_s else (flight.from_s, flight.to_s)
    colours = {r.name: style.robot_colour(i) for i, r in enumerate(flight.robots)}
    for robot in flight.robots:
        _draw_path(axes, robot, begin_s, end_s, colours[robot.name])
        if robot.name in flight.truth:
            track = flight.truth[robot.name]
            true_m = track.position_m[(track.time_s >= begin_s) & (track.time_s <= end_s), :2]
            axes.plot(*true_m.T, color=colours[robot.name], lw=0.7, ls=style.DASHED)
            if len(track.position_m):
                axes.plot(
                    *track.position_m[0, :2], ls="", marker="s", ms=4.5, mfc="white",
                    mec=colours[robot.name], mew=1.0, zorder=4,
                )  # fmt: skip
        if robot.statuses:
            axes.plot(
                *robot.statuses[-1].landing_point_m, ls="", marker="x", ms=4.5,
                color=colours[robot.name], mew=1.2, zorder=4, path_effects=_HALO,
            )  # fmt: skip
    start_m, end_m = flight.places_at(0.0), flight.places_at(flight.duration_s)
    for name, place_m in start_m.items():
        axes.plot(*place_m, ls="", marker="o", ms=3.0, mfc="white", mec=colours[name], mew=1.0)
    _draw_robots(axes, end_m, colours)
    handles += [
        Line2D([], [], ls="", marker="o", ms=3, mfc="white", mec=INK, label="start"),
        Line2D([], [], color=INK, lw=0.9, label="estimated path"),
    ]
    if flight.truth:
        handles += [
            Line2D([], [], color=INK, lw=0.7, ls=style.DASHED, label="true path"),
            Line2D([], [], mec=INK, marker="s", ms=4, mfc="white", ls="", label="true pad"),
        ]
    handles.append(Line2D([], [], color=INK, marker="x", ms=4, ls="", label="landing point"))
    if flight.coverage is not None:
        handles += _world_handles()
    if flight.fence is not None:
        axes.add_patch(
            Polygon(flight.fence.vertices_m, fill=False, ec=style.FENCE, lw=0.9, ls=(0, (6, 3)))
        )
        handles.append(Line2D([], [], color=style.FENCE, lw=0.9, ls=(0, (6, 3)), label="fence"))
    _frame(np.array([[axes]]), flight, margin=True)
    return handles


def _draw_states(axes: Axes, flight: FlightRecord) -> list[Any]:
    """Draw a bar per robot; returns legend handles."""
    seen: set[FlightState] = set()
    for row, robot in enumerate(flight.robots):
        for state, begin_s, end_s in robot.intervals(flight.to_s):
            seen.add(state)
            colour = style.STATE_COLOURS[state]
            axes.barh(row, end_s - begin_s, left=begin_s, height=0.8, color=colour, lw=0)
        nonces = [status.boot_nonce for status in robot.statuses]
        for k in range(1, len(nonces)):
            if nonces[k] != nonces[k - 1]:
                axes.plot(robot.time_s[k], row, marker="|", ms=9, color="k", mew=1.5)
    rows = {robot.name: row for row, robot in enumerate(flight.robots)}
    alarm: Any = {"ls": "", "marker": "v", "ms": 5, "color": style.VERMILLION, "mec": "w"}
    for time_s, name, *_ in flight.alarms:
        axes.plot(time_s, rows[name], mew=0.5, **alarm)
    for at_s in (0.0, flight.duration_s) if flight.duration_s else ():
        axes.axvline(at_s, color=INK, lw=0.6, ls=(0, (4, 2)))
    named = {state.value: c for state, c in style.STATE_COLOURS.items() if state in seen}
    # States of one colour share an entry.
    labels = {
        colour: ", ".join(name for name, c in named.items() if c == colour)
        for colour in dict.fromkeys(named.values())
    }
    handles: list[Any] = [Patch(color=colour, label=label) for colour, label in labels.items()]
    if flight.alarms:
        handles.append(Line2D([], [], label="new alarm", **alarm))
    if flight.restarts:
        handles.append(Line2D([], [], ls="", marker="|", ms=9, color="k", label="restart"))
    count = len(flight.robots)
    axes.set(
        ylabel="robot", ylim=(count - 0.4, -0.6), yticks=range(count),
        yticklabels=[robot.name for robot in flight.robots],
    )  # fmt: skip
    axes.tick_params(axis="y", length=0, labelsize=8 if count <= _MOST_NAMES else 5)
    axes.spines[["top", "right", "left"]].set_visible(False)
    return handles


def _draw_heights(axes: Axes, flight: FlightRecord) -> None:
    """Draw heights in the air; each curve ends with the robot's name."""
    for index, robot in enumerate(flight.robots):
        height_m = np.where(robot.flying, robot.position_m[:, 2], np.nan)
        axes.plot(robot.time_s, height_m, color=style.robot_colour(index), lw=0.9)
        at = np.searchsorted(robot.time_s, flight.duration_s)
        if at < len(height_m) and np.isfinite(height_m[at]):
            axes.annotate(
                robot.name, (flight.duration_s, height_m[at]), (2, 0), va="center", fontsize=5,
                textcoords="offset points", path_effects=_HALO,
            )  # fmt: skip
    axes.set(ylabel="height (m)", ylim=(0.0, None))
    tidy(axes)


def _draw_cost(axes: Axes, flight: FlightRecord, colour: str, dashes: Any, name: str) -> None:
    if len(flight.normalized):
        axes.plot(
            flight.curve_time_s, flight.normalized, color=colour, ls=dashes, lw=1.3,
            label=f"{flight.normalized[-1]:.2f}  {name}",
        )  # fmt: skip


def _rises(flight: FlightRecord) -> bool:
    cost = flight.normalized
    return bool((cost - np.minimum.accumulate(cost)).max(initial=0.0) > _RISE)


def _draw_lloyd(axes: Axes, flight: FlightRecord, colour: str = style.LLOYD) -> None:
    share = flight.normalized_lloyd
    axes.plot(
        (0.0, flight.duration_s), (share, share), color=colour, lw=1.0, ls=style.DOTTED,
        label=f"{share:.2f}  {LLOYD}",
    )  # fmt: skip


def _frame_costs(axes: Axes, end_s: float) -> None:
    _frame_cost_axes(axes, end_s)
    if not axes.get_legend_handles_labels()[0]:
        return  # no record has a world
    axes.legend(
        loc="center left", bbox_to_anchor=(1.01, 0.5), title="$J$ at the end / $J(0)$",
        alignment="left", handlelength=2.8, fontsize=7,
    )  # fmt: skip


def _frame_cost_axes(axes: Axes, end_s: float) -> None:
    axes.set(
        xlabel="time (s)", ylabel=r"coverage cost $J(t)\,/\,J(0)$", xlim=(0.0, end_s),
        ylim=(0.0, None),
    )  # fmt: skip
    tidy(axes)


def _draw_world(axes: Axes, flight: FlightRecord, time_s: float | None = None) -> None:
    """Draw the density; with a time, unseen areas are faint and the seen area is outlined."""
    coverage = flight.coverage
    if coverage is None:
        return
    extent = (0.0, coverage.size_m, 0.0, coverage.size_m)
    shown = coverage.importance / max(float(coverage.importance.max()), 1e-9)
    if time_s is not None:
        seen = flight.seen(time_s)
        shown = shown * np.where(seen, 1.0, style.UNSEEN_STRENGTH)
        if seen.any() and not seen.all():
            axes.contour(
                seen.T.astype(float), levels=[0.5], extent=extent, colors=style.SEEN,
                linewidths=0.7, linestyles=[style.DOTTED],
            )  # fmt: skip
    axes.imshow(
        shown.T, origin="lower", extent=extent, cmap=style.DENSITY, vmin=0.0, vmax=1.0,
        interpolation="bilinear",
    )  # fmt: skip
    axes.add_patch(Rectangle((0.0, 0.0), coverage.size_m, coverage.size_m, fill=False, ec=FAINT))


def _draw_cells(axes: Axes, flight: FlightRecord, time_s: float) -> None:
    places_m = np.array(list(flight.places_at(time_s).values())).reshape(-1, 2)
    if flight.coverage is None or len(places_m) < 2:
        return
    for cell_m in flight.coverage.cells_m(places_m):
        if cell_m:
            axes.add_patch(Polygon(cell_m, fill=False, ec=GREY, lw=0.5, joinstyle="round"))


def _draw_path(
    axes: Axes, robot: RobotRecord, begin_s: float, end_s: float, colour: str
) -> None:  # fmt: skip
    shown = (robot.time_s >= begin_s) & (robot.time_s <= end_s)
    path_m = np.where(robot.flying[shown, None], robot.position_m[shown, :2], np.nan)
    axes.plot(*path_m.T, color=colour, lw=1.0, solid_capstyle="round", path_effects=_HALO)


def _draw_robots(
    axes: Axes, places_m: Mapping[str, tuple[float, float]],
    colours: Mapping[str, str] | None = None, *, small: bool = False,
) -> None:  # fmt: skip
    """Draw discs with the robots' names, or with long names beside them."""
    inside = all(len(name) <= _LONGEST_IN_DISC for name in places_m)
    size = (6.5 if small else 8.0) if inside else 4.5
    for name, place_m in places_m.items():
        colour = style.SWARM if colours is None else colours[name]
        axes.plot(*place_m, ls="", marker="o", ms=size, color=colour, mec="k", mew=0.5, zorder=5)
        white = inside and colour in style.DARK
        axes.annotate(
            name, place_m, (0, 0) if inside else (4, 4), textcoords="offset points", zorder=6,
            ha="center" if inside else "left", va="center_baseline" if inside else "bottom",
            fontsize=4.5 if small else 5.5, color="w" if white else "k",
            path_effects=None if inside else _HALO,
        )  # fmt: skip


def _world_handles() -> list[Any]:
    return [
        Line2D([], [], color=GREY, lw=0.6, label="Voronoi cells"),
        Patch(color=style.DENSITY(0.9), label="density, seen"),
        Patch(color=style.DENSITY(0.9 * style.UNSEEN_STRENGTH), label="density, not yet seen"),
        Line2D([], [], color=style.SEEN, lw=0.8, ls=style.DOTTED, label="edge of what was seen"),
    ]


def _robot_handle(colour: str, label: str) -> Line2D:
    return Line2D([], [], ls="", marker="o", ms=5.5, color=colour, mec="k", mew=0.5, label=label)


def _frame(panels: Any, flight: FlightRecord, *, margin: bool) -> None:
    """Set the limits of maps: the world, or with a margin also the fence."""
    for axes in panels.ravel():
        axes.set_aspect("equal")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(MaxNLocator(4, integer=True))
    for axes in panels[-1]:
        axes.set_xlabel("x (m)")
    for axes in panels[:, 0]:
        axes.set_ylabel("y (m)")
    points_m = [robot.position_m[robot.flying, :2] for robot in flight.robots]
    if flight.coverage is not None:
        points_m.append(np.array([(0.0, 0.0), (flight.coverage.size_m, flight.coverage.size_m)]))
    if margin and flight.fence is not None:
        points_m.append(np.array(flight.fence.vertices_m))
    known_m = np.concatenate(points_m)
    known_m = known_m[np.isfinite(known_m[:, 0])]
    if len(known_m) == 0:
        return
    (x_low, y_low), (x_high, y_high) = known_m.min(axis=0) - 0.7, known_m.max(axis=0) + 0.7
    panels[0, 0].set(xlim=(x_low, x_high), ylim=(y_low, y_high))


def draw_matrix(
    figure: Any, axes: Axes, values: F64, names: Sequence[str], label: str, much: float
) -> None:
    """Draw values by receiver and sender; the strongest colour is at least at `much`."""
    highest = max(values[np.isfinite(values)].max(initial=0.0), much)
    image = axes.imshow(values, cmap=style.SCALE, vmin=0.0, vmax=highest)
    few, step = len(names) <= _MOST_NAMES, -(-len(names) // _MOST_SMALL_NAMES)
    ticks = np.arange(0, len(names), step)
    axes.set_xticks(ticks, names[::step], rotation=0 if few else 90)
    axes.set_yticks(ticks, names[::step])
    axes.tick_params(length=0, labelsize=8 if few else 5)
    axes.set(xlabel="sender", ylabel="receiver", facecolor=style.NOTHING)
    if few:
        for row, column in np.argwhere(np.isfinite(values)):
            value = values[row, column]
            colour = "white" if value > 0.6 * highest else INK
            axes.text(
                column, row, f"{value:.1f}" if value < 10.0 else f"{value:.0f}", ha="center",
                va="center", fontsize=6.5, color=colour,
            )  # fmt: skip
    figure.colorbar(image, ax=axes, label=label, shrink=0.9)
