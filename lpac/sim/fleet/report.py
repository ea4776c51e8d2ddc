"""A fleet's flight as a figure and a file."""

import json
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon, Rectangle

from edge.core import F64
from edge.messages.mission import FlightState
from lpac.sim.fleet.flight import FleetFlight, RobotFlight, normalized
from lpac.sim.report import STYLE

_DENSITY = LinearSegmentedColormap.from_list("density", ["#ffffff", "#d0d5db", "#8f99a5"])
_INK, _FAINT = "#252525", "#bdbdbd"

_S = FlightState
_STATE_COLOURS = {
    _S.INIT: "#f0f0f0",
    _S.IDLE: "#f0f0f0",
    _S.PREFLIGHT: "#d9d9d9",
    _S.ARMING: "#fdd0a2",
    _S.TAKEOFF: "#fd8d3c",
    _S.HOLD: "#fee391",
    _S.MISSION: "#41ab5d",
    _S.RETURN: "#6baed6",
    _S.LAND: "#2171b5",
    _S.LANDED: "#d9d9d9",
    _S.PILOT: "#c51b8a",
    _S.FAULT: "#a50f15",
}


def write_fleet_flight(flight: FleetFlight, folder: Path) -> None:
    """Write flight.json and flight.png / flight.pdf into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "flight.json").write_text(json.dumps(flight.summary(), indent=2) + "\n")
    figure = fleet_figure(flight)
    with mpl.rc_context(STYLE):
        for suffix in (".png", ".pdf"):
            figure.savefig((folder / "flight").with_suffix(suffix))


def fleet_figure(flight: FleetFlight) -> Figure:
    """Paths over the importance, beside states, heights and coverage cost over time."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.16, 4.3), layout="constrained")
        columns = figure.add_gridspec(1, 2, width_ratios=(1.08, 1.0))
        left, right = figure.add_subfigure(columns[0]), figure.add_subfigure(columns[1])
        colours = _colours(len(flight.robots))
        _draw_map(left.add_subplot(), flight, colours)
        panels = right.subplots(3, 1, sharex=True, height_ratios=(1.3, 1.0, 1.0))
        _draw_states(panels[0], flight)
        _draw_heights(panels[1], flight, colours)
        _draw_costs(panels[2], flight)
        panels[2].set(xlabel="time (s)", xlim=(0.0, flight.began_s["end"]))
        right.align_ylabels(panels)
        return figure


def _colours(robots: int) -> list[tuple[float, ...]]:
    """One per robot, from the lowest flying to the highest."""
    ramp = mpl.colormaps["turbo"](np.linspace(0.05, 0.95, robots))
    return [tuple(0.85 * np.array(colour[:3])) for colour in ramp]


def _draw_map(axes: Axes, flight: FleetFlight, colours: list[tuple[float, ...]]) -> None:
    extent = (0.0, flight.field_m, 0.0, flight.field_m)
    highest = max(float(flight.importance.max()), 1e-9)
    axes.imshow(
        flight.importance.T / highest,
        origin="lower", extent=extent, cmap=_DENSITY, vmin=0.0, vmax=1.0, interpolation="bilinear",
    )  # fmt: skip
    axes.add_patch(Rectangle((0.0, 0.0), flight.field_m, flight.field_m, fill=False, ec=_FAINT))
    axes.add_patch(
        Polygon(flight.fence.vertices_m, fill=False, ec="#a50f15", lw=0.8, ls=(0, (6, 3)))
    )
    mission_s = flight.began_s.get("return", flight.began_s["end"])
    for robot, colour in zip(flight.robots, colours, strict=True):
        truth = robot.truth
        flown_m = truth.position_m[truth.airborne]
        axes.plot(*flown_m[:, :2].T, color=colour, lw=0.5, ls=(0, (3, 1.5)), alpha=0.6)
        estimated_m = robot.position_m[robot.in_air]
        axes.plot(*estimated_m[:, :2].T, color=colour, lw=0.9, solid_capstyle="round")
        if len(robot.time_s):
            end_m = [
                np.interp(mission_s, robot.time_s, robot.position_m[:, axis]) for axis in (0, 1)
            ]
            axes.plot(*end_m, marker="o", ms=5, color=colour, mec=_INK, mew=0.5, zorder=5, ls="")
    for pad_m, point_m, colour in zip(flight.pads_m, flight.landing_points_m, colours, strict=True):
        axes.plot(*pad_m, ls="", marker="s", ms=4.5, mfc="white", mec=colour, mew=1.0, zorder=4)
        axes.plot(*point_m, ls="", marker="x", ms=4.5, color=colour, mew=1.1, zorder=4)
    corners_m = np.array(flight.fence.vertices_m)
    (x_low, y_low), (x_high, y_high) = corners_m.min(axis=0) - 1.0, corners_m.max(axis=0) + 1.0
    axes.set(
        xlabel="x (m)", ylabel="y (m)", aspect="equal", xlim=(x_low, x_high), ylim=(y_low, y_high),
        xticks=np.linspace(0.0, flight.field_m, 5), yticks=np.linspace(0.0, flight.field_m, 5),
    )  # fmt: skip
    axes.legend(
        handles=[
            Line2D([], [], color=_INK, lw=0.9, label="path, as estimated"),
            Line2D([], [], color=_INK, lw=0.5, ls=(0, (3, 1.5)), label="path, in truth"),
            Line2D([], [], color=_INK, marker="o", ms=5, ls="", label="end of the mission"),
            Line2D([], [], mec=_INK, marker="s", ms=4, mfc="none", ls="", label="pad, in truth"),
            Line2D([], [], color=_INK, marker="x", ms=3.5, ls="", label="landing point"),
            Line2D([], [], color="#a50f15", lw=0.8, ls=(0, (6, 3)), label="fence"),
        ],
        loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=3, frameon=False, fontsize=7,
        handlelength=2.0, columnspacing=1.2, borderpad=0.0,
    )  # fmt: skip


def _draw_states(axes: Axes, flight: FleetFlight) -> None:
    """A bar per robot, coloured by state."""
    end_s = flight.began_s["end"]
    for row, robot in enumerate(flight.robots):
        for state, begin_s, until_s in _intervals(robot, end_s):
            axes.barh(
                row, until_s - begin_s, left=begin_s, height=0.8, color=_STATE_COLOURS[state], lw=0
            )
    seen = {change.state for robot in flight.robots for change in robot.changes}
    named = {state.value: colour for state, colour in _STATE_COLOURS.items() if state in seen}
    # States of one colour share their entry.
    entries = {
        colour: ", ".join(name for name, c in named.items() if c == colour)
        for colour in dict.fromkeys(named.values())
    }
    axes.legend(
        handles=[Patch(color=colour, label=label) for colour, label in entries.items()],
        loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4, frameon=False, fontsize=6.5,
        handlelength=1.0, handleheight=0.8, columnspacing=1.0, borderpad=0.2,
    )  # fmt: skip
    count = len(flight.robots)
    axes.set(ylabel="robot", ylim=(-0.6, count - 0.4), yticks=range(0, count, 1 + count // 6))
    axes.spines[["top", "right"]].set_visible(False)


def _intervals(robot: RobotFlight, end_s: float) -> Iterator[tuple[FlightState, float, float]]:
    ends_s = [after.time_s for _, after in pairwise(robot.changes)] + [end_s]
    for change, until_s in zip(robot.changes, ends_s, strict=False):
        yield change.state, change.time_s, until_s


def _draw_heights(axes: Axes, flight: FleetFlight, colours: list[tuple[float, ...]]) -> None:
    for robot, colour in zip(flight.robots, colours, strict=True):
        heights_m = robot.position_m[:, 2] if len(robot.time_s) else np.zeros(0)
        axes.plot(robot.time_s, heights_m, color=colour, lw=0.9)
    axes.set(ylabel="height (m)", ylim=(0.0, None))
    _tidy(axes)


def _draw_costs(axes: Axes, flight: FleetFlight) -> None:
    time_s = flight.began_s.get("mission", 0.0) + flight.cost_time_s
    curves: list[tuple[F64, str, object, str]] = [
        (flight.cost, "#000000", "-", "as estimated"),
        (flight.true_cost, "#d95f0e", "--", "in truth"),
    ]
    for cost, colour, style, name in curves:
        if np.isfinite(cost).any():
            share = normalized(cost)
            label = f"{name}, {share[-1]:.2f} at the end"
            axes.plot(time_s, share, color=colour, ls=style, lw=1.2, label=label)
            axes.legend(loc="upper right", frameon=False, fontsize=7, handlelength=2.4)
    axes.set(ylabel=r"cost $J\,/\,J_0$", ylim=(0.0, 1.05))
    _tidy(axes)


def _tidy(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color="#d9d9d9", linewidth=0.4)
