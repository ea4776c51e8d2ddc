"""The report's figures: made for print, for the screen, and for the colour-blind."""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon, Rectangle
from matplotlib.ticker import MaxNLocator

from edge.core import F64
from edge.messages.mission import FlightState
from lpac.analysis.trials import LOOPS, LoopLateness, Messages, RobotTrack, Trial

_STYLE: dict[Any, Any] = {
    "font.family": "serif",
    "font.serif": ["DejaVu Serif"],
    "mathtext.fontset": "dejavuserif",
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.linewidth": 0.6,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.direction": "in",
    "ytick.direction": "in",
    "legend.frameon": False,
    "savefig.dpi": 200,
}
_WIDTH_IN = 7.16
_DENSITY = LinearSegmentedColormap.from_list(
    "density", ["#ffffff", "#c6dbef", "#6baed6", "#2171b5", "#08306b"]
)
_SCALE = LinearSegmentedColormap.from_list("scale", ["#fff7ec", "#fdbb84", "#d7301f", "#7f0000"])
_UNSEEN_STRENGTH = 0.25
_INK, _GREY, _FAINT, _PATH, _FENCE = "#252525", "#636363", "#bdbdbd", "#d95f0e", "#7a0177"
# By position: told apart in print and by the colour-blind (Okabe and Ito's colours).
_CURVES: tuple[tuple[str, Any], ...] = (
    ("#000000", "-"),
    ("#d55e00", "--"),
    ("#0072b2", "-."),
    ("#009e73", (0, (5, 1))),
    ("#cc79a7", ":"),
    ("#e69f00", (0, (3, 1, 1, 1))),
    ("#56b4e9", (0, (1, 1))),
)
_S = FlightState
_STATE_COLOURS = {
    _S.INIT: "#f0f0f0",
    _S.IDLE: "#f0f0f0",
    _S.PREFLIGHT: "#d0d0d0",
    _S.ARMING: "#f6d7a0",
    _S.TAKEOFF: "#e69f00",
    _S.HOLD: "#f0e442",
    _S.MISSION: "#009e73",
    _S.RETURN: "#56b4e9",
    _S.LAND: "#0072b2",
    _S.LANDED: "#d0d0d0",
    _S.PILOT: "#cc79a7",
    _S.FAULT: "#000000",
}
_MOST_CURVES = len(_CURVES)
_MUCH_MS, _MUCH_LOSS = 200.0, 10.0
_MOST_NAMES, _MOST_TICKS = 12, 8


class Pictures:
    """Figures on their way to files: `folder`/`name`.png and .pdf. `drawn` is PNG by name."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.drawn: dict[str, bytes] = {}

    def save(self, name: str, figure: Figure) -> None:
        """Raises OSError if it cannot be written."""
        self._folder.mkdir(parents=True, exist_ok=True)
        with mpl.rc_context(_STYLE):
            figure.savefig(self._folder / f"{name}.pdf")
            # It is laid out now: that takes as long again as drawing.
            figure.set_layout_engine("none")
            png = io.BytesIO()
            figure.savefig(png, format="png")
        self.drawn[name] = png.getvalue()
        (self._folder / f"{name}.png").write_bytes(png.getvalue())


def snapshots(trial: Trial, times_s: Sequence[float]) -> Figure:
    """Robots, Voronoi cells and paths so far, over the density that was seen by then."""
    rows = -(-len(times_s) // 4)
    columns = -(-len(times_s) // rows)
    with mpl.rc_context(_STYLE):
        side_in = _WIDTH_IN / columns
        figure = Figure(figsize=(_WIDTH_IN, rows * (side_in + 0.35)), layout="constrained")
        panels = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
        for axes in panels.ravel()[len(times_s) :]:
            axes.set_visible(False)
        for axes, time_s in zip(panels.ravel(), times_s, strict=False):
            _draw_world(axes, trial, time_s)
            _draw_cells(axes, trial, time_s)
            for track in trial.tracks:
                _draw_path(axes, track, 0.0, time_s)
            _draw_robots(axes, trial.places_at(time_s))
            axes.set_title(f"$t$ = {round(time_s, 1):g} s")
        _frame(panels, trial, margin=False)
        for axes in panels.ravel()[len(times_s) - columns : len(times_s)]:
            axes.tick_params(labelbottom=True)
            axes.set_xlabel("x (m)")
        return figure


def start_and_end(trial: Trial) -> Figure:
    """Where the robots began and ended the mission, and their paths between."""
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(5.5, 3.5), layout="constrained")
        panels = figure.subplots(1, 1, squeeze=False)
        axes = panels[0, 0]
        _draw_world(axes, trial)
        _draw_cells(axes, trial, trial.duration_s)
        for track in trial.tracks:
            _draw_path(axes, track, 0.0, trial.duration_s)
            axes.plot(
                *track.said[-1].landing_point_m,
                ls="", marker="x", ms=4.5, color=_INK, mew=1.0, zorder=7,
            )  # fmt: skip
        _draw_robots(axes, trial.places_at(0.0), filled=False)
        _draw_robots(axes, trial.places_at(trial.duration_s), names=True)
        handles: list[Any] = [
            Line2D([], [], ls="", marker="o", ms=5, mfc="white", mec=_PATH, mew=1.2, label="start"),
            Line2D([], [], ls="", marker="o", ms=5, color=_PATH, mec="k", mew=0.5, label="end"),
            Line2D([], [], color=_PATH, lw=0.9, label="path"),
            Line2D([], [], ls="", marker="x", ms=4.5, color=_INK, label="landing point"),
            Line2D([], [], color=_GREY, lw=0.7, label="Voronoi cell at the end"),
        ]
        if trial.fence is not None:
            axes.add_patch(
                Polygon(trial.fence.vertices_m, fill=False, ec=_FENCE, lw=0.9, ls=(0, (6, 3)))
            )
            handles.append(Line2D([], [], color=_FENCE, lw=0.9, ls=(0, (6, 3)), label="fence"))
        _frame(panels, trial, margin=True)
        figure.legend(handles=handles, loc="outside right center", handlelength=2.2)
        return figure


def costs(trials: Sequence[Trial]) -> Figure:
    """Normalised coverage cost over time, beside the clairvoyant bound, of each trial."""
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(_WIDTH_IN, 2.5), layout="constrained")
        axes = figure.subplots()
        for index, trial in enumerate(trials):
            colour, style = _CURVES[index % _MOST_CURVES]
            cost = trial.normalized
            axes.plot(
                trial.cost_time_s, cost, color=colour, ls=style, lw=1.4,
                label=f"{cost[-1]:.2f}  {trial.name}",
            )  # fmt: skip
            axes.axhline(
                trial.normalized_bound, color=colour, lw=0.8, ls=(0, (1, 2)),
                label=f"{trial.normalized_bound:.2f}  bound, clairvoyant",
            )  # fmt: skip
        _draw_cost_axes(axes, max(trial.duration_s for trial in trials))
        axes.legend(
            loc="center left", bbox_to_anchor=(1.01, 0.5), title="$J$ at the end / $J(0)$",
            alignment="left", handlelength=2.8,
        )  # fmt: skip
        return figure


def repeatability(trials: Sequence[Trial]) -> Figure:
    """All trials' cost, their mean and spread; and where the robots ended, trial by trial."""
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(_WIDTH_IN, 3.1), layout="constrained")
        left, right = figure.subplots(1, 2, width_ratios=(1.25, 1.0))
        end_s = min(trial.duration_s for trial in trials)
        times_s = np.linspace(0.0, end_s, 300)
        curves = np.array([np.interp(times_s, t.cost_time_s, t.normalized) for t in trials])
        for trial, colour in zip(trials, _trial_colours(len(trials)), strict=True):
            left.plot(trial.cost_time_s, trial.normalized, color=colour, lw=0.8)
        mean, deviation = curves.mean(axis=0), curves.std(axis=0, ddof=1)
        left.fill_between(
            times_s, mean - deviation, mean + deviation, color=_FAINT, alpha=0.6, lw=0
        )
        left.plot(times_s, mean, color="k", lw=1.8)
        bound = float(np.mean([trial.normalized_bound for trial in trials]))
        left.axhline(bound, color="k", lw=0.8, ls=(0, (1, 2)))
        left.legend(
            handles=[
                Line2D([], [], color="k", lw=1.8, label=f"mean, {mean[-1]:.2f} at {end_s:.0f} s"),
                Patch(color=_FAINT, label=f"standard deviation, {deviation[-1]:.3f}"),
                Line2D([], [], color="k", lw=0.8, ls=(0, (1, 2)), label=f"bound, {bound:.2f}"),
            ],
            loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, handlelength=1.6, fontsize=7,
            columnspacing=1.0, borderaxespad=0.2,
        )  # fmt: skip
        _draw_cost_axes(left, max(trial.duration_s for trial in trials))
        if all(trial.coverage is trials[0].coverage for trial in trials):
            _draw_world(right, trials[0])
        for trial, colour in zip(trials, _trial_colours(len(trials)), strict=True):
            places_m = np.array(list(trial.places_at(trial.duration_s).values())).reshape(-1, 2)
            right.plot(*places_m.T, ls="", marker="o", ms=4.5, color=colour, mec="k", mew=0.4)
        right.set_title("end positions, coloured by trial")
        _frame(np.array([[right]]), trials[0], margin=False)
        if len(trials) <= _MOST_NAMES:
            handles = [
                Line2D([], [], ls="", marker="o", ms=4.5, color=colour, mec="k", label=trial.name)
                for trial, colour in zip(trials, _trial_colours(len(trials)), strict=True)
            ]
            figure.legend(
                handles=handles, loc="outside lower center", ncols=min(len(trials), 6),
                columnspacing=1.2, handlelength=1.0,
            )  # fmt: skip
        return figure


def states(trial: Trial) -> Figure:
    """A bar per robot, coloured by state, with alarms and restarts on it."""
    with mpl.rc_context(_STYLE):
        count = len(trial.tracks)
        figure = Figure(figsize=(_WIDTH_IN, 0.9 + 0.2 * max(count, 3)), layout="constrained")
        axes = figure.subplots()
        seen: set[FlightState] = set()
        for row, track in enumerate(trial.tracks):
            for state, begin_s, end_s in track.intervals(trial.to_s):
                seen.add(state)
                colour = _STATE_COLOURS[state]
                axes.barh(row, end_s - begin_s, left=begin_s, height=0.8, color=colour, lw=0)
            nonces = [said.boot_nonce for said in track.said]
            for k in range(1, len(nonces)):
                if nonces[k] != nonces[k - 1]:
                    axes.plot(track.time_s[k], row, marker="|", ms=9, color="k", mew=1.5)
        rows = {track.name: row for row, track in enumerate(trial.tracks)}
        for time_s, robot, *_ in trial.alarms:
            axes.plot(
                time_s, rows[robot], ls="", marker="v", ms=5, color="#d55e00", mec="w", mew=0.5
            )
        for at_s in (0.0, trial.duration_s):
            axes.axvline(at_s, color=_INK, lw=0.6, ls=(0, (4, 2)))
        named = {state.value: c for state, c in _STATE_COLOURS.items() if state in seen}
        # States of one colour share their entry.
        labels = {
            colour: ", ".join(name for name, c in named.items() if c == colour)
            for colour in dict.fromkeys(named.values())
        }
        handles: list[Any] = [Patch(color=colour, label=label) for colour, label in labels.items()]
        if trial.alarms:
            handles.append(
                Line2D([], [], ls="", marker="v", ms=5, color="#d55e00", mec="w", label="new alarm")
            )
        if trial.restarts:
            handles.append(Line2D([], [], ls="", marker="|", ms=9, color="k", label="restart"))
        figure.legend(
            handles=handles, loc="outside upper center", ncols=len(handles), handlelength=1.0,
            handleheight=0.8, columnspacing=1.2,
        )  # fmt: skip
        axes.set(
            xlabel="time (s)", xlim=(trial.from_s, trial.to_s), ylim=(count - 0.4, -0.6),
            yticks=range(count), yticklabels=[track.name for track in trial.tracks],
        )  # fmt: skip
        axes.tick_params(axis="y", length=0)
        axes.spines[["top", "right", "left"]].set_visible(False)
        return figure


def messages(trial: Trial, told: Messages) -> Figure:
    """How old messages were, and how many did not come: pair by pair, and over time."""
    names = [track.name for track in trial.tracks]
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(_WIDTH_IN, 4.6), layout="constrained")
        rows = figure.add_gridspec(2, 1, height_ratios=(1.25, 1.0))
        upper, lower = figure.add_subfigure(rows[0]), figure.add_subfigure(rows[1])
        panels = upper.subplots(1, 2)
        age_ms, loss = 1e3 * told.age_s, 100.0 * told.loss
        _draw_matrix(upper, panels[0], age_ms, names, "median age (ms)", _MUCH_MS)
        _draw_matrix(upper, panels[1], loss, names, "lost (%)", _MUCH_LOSS)
        left, right = lower.subplots(1, 2)
        edges_s = np.linspace(0.0, trial.duration_s, max(2, min(61, int(trial.duration_s) + 1)))
        middles_s = (edges_s[1:] + edges_s[:-1]) / 2.0
        bins = np.digitize(told.heard_at_s, edges_s) - 1
        for share, style, name in ((0.5, "-", "median"), (0.95, "--", "95th percentile")):
            values = [_quantile(told.heard_age_s[bins == b], share) for b in range(len(middles_s))]
            left.plot(middles_s, 1e3 * np.array(values), color="#0072b2", ls=style, label=name)
        left.set(ylabel="message age (ms)")
        left.legend(loc="upper right", ncols=2)
        came = np.histogram(told.heard_at_s, edges_s)[0]
        missing = np.histogram(told.gaps[:, 0], edges_s, weights=told.gaps[:, 1])[0]
        share_lost = 100.0 * missing / np.maximum(came + missing, 1)
        right.stairs(share_lost, edges_s, fill=True, color="#d55e00", alpha=0.4, lw=0, zorder=2)
        right.stairs(share_lost, edges_s, baseline=None, color="#d55e00", lw=1.4, zorder=3)
        right.set(ylabel="lost (%)")
        # That nothing was lost is a line to be seen, too: above the axis.
        for axes, least, below in ((left, 10.0, 0.0), (right, _MUCH_LOSS, 0.05)):
            highest = max(1.25 * axes.get_ylim()[1], least)
            axes.set(
                xlabel="time (s)", xlim=(0.0, trial.duration_s), ylim=(-below * highest, highest)
            )
            _tidy(axes)
        return figure


def loops(trial: Trial) -> Figure:
    """How late the loops' ticks were: over time, and robot by robot at the end."""
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(_WIDTH_IN, 3.6), layout="constrained")
        panels = figure.subplots(2, len(LOOPS), sharey="row")
        for column, loop in enumerate(LOOPS):
            _draw_lateness(panels[0, column], trial, trial.lateness[loop])
            panels[0, column].set_title(f"{loop} loop")
            _draw_robots_lateness(panels[1, column], trial.lateness[loop])
        panels[0, 0].set_ylabel("lateness, 99th\npercentile (ms)")
        panels[1, 0].set_ylabel("lateness at\nthe end (ms)")
        panels[0, 0].legend(loc="upper left", handlelength=1.6, fontsize=7)
        panels[1, 0].legend(
            loc="upper left", handlelength=0.6, ncols=3, columnspacing=0.8, fontsize=7
        )
        for row, room in zip(panels, (1.7, 1.4), strict=True):
            row[0].set_ylim(0.0, room * max(row[0].get_ylim()[1], 1.0))
        return figure


def _draw_lateness(axes: Axes, trial: Trial, robots: Mapping[str, LoopLateness]) -> None:
    for index, late in enumerate(robots.values()):
        label = "each robot" if index == 0 else None
        axes.plot(late.time_s, late.p99_ms, color="#56b4e9", lw=0.6, alpha=0.8, label=label)
    if robots:
        times_s = np.linspace(0.0, trial.duration_s, 200)
        curves = np.array([np.interp(times_s, r.time_s, r.p99_ms) for r in robots.values()])
        axes.plot(times_s, curves.max(axis=0), color="#d55e00", lw=1.2, label="worst robot")
        axes.plot(times_s, np.median(curves, axis=0), color="k", lw=1.2, label="median robot")
    axes.set(xlabel="time (s)", xlim=(0.0, trial.duration_s))
    _tidy(axes)


def _draw_robots_lateness(axes: Axes, robots: Mapping[str, LoopLateness]) -> None:
    places = np.arange(len(robots))
    for key, colour, marker, label in (
        ("max_ms", "#d55e00", "^", "maximum"),
        ("p99_ms", "#0072b2", "s", "99 %"),
        ("p50_ms", "k", "o", "median"),
    ):
        values = [getattr(late, key)[-1] for late in robots.values()]
        axes.plot(places, values, ls="", marker=marker, ms=4, color=colour, label=label)
    step = -(-len(robots) // _MOST_TICKS) or 1
    axes.set(xlim=(-0.6, max(len(robots) - 0.4, 0.6)), xlabel="robot")
    axes.set_xticks(places[::step], list(robots)[::step])
    _tidy(axes)


def _draw_world(axes: Axes, trial: Trial, time_s: float | None = None) -> None:
    """The density; with a time faint where nobody had looked by then, which is outlined."""
    coverage = trial.coverage
    if coverage is None:
        return
    extent = (0.0, coverage.size_m, 0.0, coverage.size_m)
    shown = coverage.importance / max(float(coverage.importance.max()), 1e-9)
    if time_s is not None:
        seen = trial.seen(time_s)
        shown = shown * np.where(seen, 1.0, _UNSEEN_STRENGTH)
        if seen.any() and not seen.all():
            axes.contour(
                seen.T.astype(float), levels=[0.5], extent=extent, colors=_GREY, linewidths=0.4
            )
    axes.imshow(
        shown.T, origin="lower", extent=extent, cmap=_DENSITY, vmin=0.0, vmax=1.0,
        interpolation="bilinear",
    )  # fmt: skip
    axes.add_patch(Rectangle((0.0, 0.0), coverage.size_m, coverage.size_m, fill=False, ec=_FAINT))


def _draw_cells(axes: Axes, trial: Trial, time_s: float) -> None:
    places_m = np.array(list(trial.places_at(time_s).values())).reshape(-1, 2)
    if trial.coverage is None or len(places_m) < 2:
        return
    for cell_m in trial.coverage.cells_m(places_m):
        if cell_m:
            axes.add_patch(Polygon(cell_m, fill=False, ec=_GREY, lw=0.7, joinstyle="round"))


def _draw_path(axes: Axes, track: RobotTrack, begin_s: float, end_s: float) -> None:
    shown = (track.time_s >= begin_s) & (track.time_s <= end_s)
    path_m = np.where(track.flying[shown, None], track.position_m[shown, :2], np.nan)
    axes.plot(*path_m.T, color=_PATH, lw=0.9, solid_capstyle="round")


def _draw_robots(
    axes: Axes, places_m: Mapping[str, tuple[float, float]], *, filled: bool = True,
    names: bool = False,
) -> None:  # fmt: skip
    if not places_m:
        return
    xy_m = np.array(list(places_m.values())).T
    face, edge, width = (_PATH, "k", 0.5) if filled else ("white", _PATH, 1.2)
    size = 5.0 if len(places_m) <= _MOST_NAMES else 3.5
    axes.plot(*xy_m, ls="", marker="o", ms=size, color=face, mec=edge, mew=width, zorder=5)
    if names:
        for name, place_m in places_m.items():
            axes.annotate(
                name, place_m, (4, 4), textcoords="offset points", fontsize=6.5, zorder=6,
                bbox={"boxstyle": "round,pad=0.12", "fc": "white", "ec": "none", "alpha": 0.75},
            )  # fmt: skip


def _frame(panels: Any, trial: Trial, *, margin: bool) -> None:
    """What maps have in common: the world's limits, or with a margin all that was flown in."""
    for axes in panels.ravel():
        axes.set_aspect("equal")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(MaxNLocator(4, integer=True))
    for axes in panels[-1]:
        axes.set_xlabel("x (m)")
    for axes in panels[:, 0]:
        axes.set_ylabel("y (m)")
    points_m = [track.position_m[track.flying, :2] for track in trial.tracks]
    if trial.coverage is not None:
        points_m.append(np.array([(0.0, 0.0), (trial.coverage.size_m, trial.coverage.size_m)]))
    if margin and trial.fence is not None:
        points_m.append(np.array(trial.fence.vertices_m))
    known_m = np.concatenate(points_m)
    known_m = known_m[np.isfinite(known_m[:, 0])]
    if len(known_m) == 0:
        return
    (x_low, y_low), (x_high, y_high) = known_m.min(axis=0) - 0.7, known_m.max(axis=0) + 0.7
    panels[0, 0].set(xlim=(x_low, x_high), ylim=(y_low, y_high))


def _draw_cost_axes(axes: Axes, end_s: float) -> None:
    axes.set(
        xlabel="time (s)", ylabel=r"coverage cost $J(t)\,/\,J(0)$", xlim=(0.0, end_s),
        ylim=(0.0, None),
    )  # fmt: skip
    _tidy(axes)


def _draw_matrix(
    figure: Any, axes: Axes, values: F64, names: list[str], label: str, much: float
) -> None:
    """`much` has the strongest colour, unless there is more."""
    highest = max(values[np.isfinite(values)].max(initial=0.0), much)
    image = axes.imshow(values, cmap=_SCALE, vmin=0.0, vmax=highest)
    step = 1 if len(names) <= _MOST_NAMES else -(-len(names) // _MOST_TICKS)
    ticks = np.arange(0, len(names), step)
    axes.set_xticks(ticks, names[::step])
    axes.set_yticks(ticks, names[::step])
    axes.tick_params(length=0)
    axes.set(xlabel="sender", ylabel="receiver", facecolor="#f0f0f0")
    if len(names) <= _MOST_NAMES:
        for row, column in np.argwhere(np.isfinite(values)):
            value = values[row, column]
            colour = "white" if value > 0.6 * highest else _INK
            axes.text(
                column, row, f"{value:.1f}" if value < 10.0 else f"{value:.0f}", ha="center",
                va="center", fontsize=6.5, color=colour,
            )  # fmt: skip
    figure.colorbar(image, ax=axes, label=label, shrink=0.9)


def _quantile(values: F64, share: float) -> float:
    known = values[np.isfinite(values)]
    return float(np.quantile(known, share)) if len(known) else float("nan")


def _trial_colours(count: int) -> list[str]:
    if count < _MOST_CURVES:  # black is the mean
        return [colour for colour, _ in _CURVES[1 : count + 1]]
    return [to_hex(colour) for colour in mpl.colormaps["viridis"](np.linspace(0.0, 0.9, count))]


def _tidy(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color="#d9d9d9", linewidth=0.4)
