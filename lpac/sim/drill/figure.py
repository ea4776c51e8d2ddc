"""Figure of a fault's flight: the vehicles' true paths and heights, and PX4's modes."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from lpac.analysis import style
from lpac.analysis.flight import FlightRecord
from lpac.sim.drill.bounds import LANDING
from lpac.sim.drill.faults import Fault
from lpac.sim.px4.modes import Px4Mode

_MODES = (
    ((Px4Mode.OFFBOARD,), "offboard", style.GREEN),
    ((Px4Mode.HOLD,), "hold", style.YELLOW),
    (LANDING, "land", style.BLUE),
)
_OTHER_MODE = style.PURPLE


def write_figure(fault: Fault, flight: FlightRecord, folder: Path) -> None:
    """drill.png and drill.pdf in `folder`."""
    with style.figure(style.WIDTH_IN, 4.0) as figure:
        columns = figure.add_gridspec(1, 2, width_ratios=(1.0, 1.1))
        _draw_map(figure.add_subplot(columns[0]), flight)
        rows = columns[1].subgridspec(2, 1, height_ratios=(1.0, 1.4))
        modes = figure.add_subplot(rows[0])
        _draw_modes(modes, flight)
        _draw_heights(figure.add_subplot(rows[1], sharex=modes), flight)
        figure.suptitle(f"{fault.name}: {fault.what}", x=0.01, ha="left")
    style.save(figure, folder / "drill")


def _draw_map(axes: Axes, flight: FlightRecord) -> None:
    assert flight.fence is not None
    corners = np.array([*flight.fence.vertices_m, flight.fence.vertices_m[0]])
    axes.plot(*corners.T, color=style.INK, linewidth=0.8, linestyle="--", label="fence")
    for robot, vehicle in enumerate(flight.vehicles):
        colour = style.robot_colour(robot)
        hit = robot in flight.fault.hit
        label = f"r{robot}, hit" if hit else f"r{robot}"
        path_m = vehicle.position_m[:, :2]
        axes.plot(*path_m.T, color=colour, linewidth=1.6 if hit else 0.7, label=label)
        axes.plot(*flight.fault.pads_m[robot], "s", color=colour, markersize=4, fillstyle="none")
        axes.plot(*path_m[-1], "v", color=colour, markersize=4)
        at = min(int(np.searchsorted(vehicle.time_s, flight.fault.begin_s)), len(path_m) - 1)
        axes.plot(*path_m[at], "o", color=colour, markersize=4)
    axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
    axes.set_title("square: pad; dot: at the fault; triangle: in the end", fontsize=6)
    axes.legend(fontsize=6, loc="best")


def _draw_modes(axes: Axes, flight: FlightRecord) -> None:
    for robot, vehicle in enumerate(flight.vehicles):
        drawn = ~vehicle.armed
        for modes, _, colour in _MODES:
            chosen = vehicle.armed & vehicle.is_in(*modes)
            drawn |= chosen
            _bar(axes, vehicle.time_s, chosen, robot, colour)
        _bar(axes, vehicle.time_s, ~drawn, robot, _OTHER_MODE)
    for _, name, colour in (*_MODES, ((), "other", _OTHER_MODE)):
        axes.fill_between([], [], [], color=colour, label=name)
    axes.axvline(flight.fault.begin_s, color=style.VERMILLION, linewidth=0.8)
    axes.set(ylabel="PX4's mode", ylim=(len(flight.vehicles) - 0.5, -0.5))
    axes.set_yticks(range(len(flight.vehicles)), [f"r{i}" for i in range(len(flight.vehicles))])
    axes.legend(fontsize=6, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))


def _bar(axes: Axes, time_s: np.ndarray, chosen: np.ndarray, robot: int, colour: str) -> None:
    axes.fill_between(
        time_s, robot - 0.35, robot + 0.35, where=chosen.tolist(), color=colour, linewidth=0.0
    )


def _draw_heights(axes: Axes, flight: FlightRecord) -> None:
    for robot, vehicle in enumerate(flight.vehicles):
        axes.plot(
            vehicle.time_s, vehicle.position_m[:, 2], color=style.robot_colour(robot),
            linewidth=1.6 if robot in flight.fault.hit else 0.8,
        )  # fmt: skip
    axes.axvline(flight.fault.begin_s, color=style.VERMILLION, linewidth=0.8)
    axes.set(xlabel="time (s)", ylabel="true height (m)")
