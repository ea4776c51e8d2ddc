"""Flights as figures and files."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from edge.core.perception import part_in_world, window_corner
from edge.core.world import format_world
from lpac.sim.experiment import SimulatedFlight

SNAPSHOTS = (0.0, 0.25, 0.5, 1.0)  # of the flight's duration

STYLE: dict[Any, Any] = {
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
    "savefig.dpi": 300,
}
_DENSITY = LinearSegmentedColormap.from_list(
    "density", ["#ffffff", "#9ecae1", "#2171b5", "#08306b"]
)
_PATH = "#d95f0e"
_UNSEEN_STRENGTH = 0.25
# Line colour and style by position: told apart in print and by the colour-blind.
_CURVES = (
    ("#000000", "-", 1.6),
    ("#d95f0e", "--", 1.2),
    ("#756bb1", "-.", 1.0),
    ("#2171b5", (0, (5, 1)), 1.0),
    ("#238b45", ":", 1.4),
)


def write_flight(flight: SimulatedFlight, folder: Path) -> None:
    """Write flight.json, flight.npz, world.env and flight.png / flight.pdf into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "flight.json").write_text(json.dumps(flight.summary(), indent=2) + "\n")
    (folder / "world.env").write_text(format_world(flight.features))
    np.savez(
        folder / "flight.npz",
        time_s=flight.time_s,
        positions_m=flight.positions_m,
        cost_time_s=flight.cost_time_s,
        cost=flight.cost,
        importance=flight.importance,
    )
    _save(_figure(flight, {flight.scenario.controller: flight}), folder / "flight")


def write_demo(flights: Mapping[str, SimulatedFlight], folder: Path) -> None:
    """Write demo.json and the figure demo.png / demo.pdf: the first flight beside the others."""
    folder.mkdir(parents=True, exist_ok=True)
    summaries = {name: flight.summary() for name, flight in flights.items()}
    (folder / "demo.json").write_text(json.dumps(summaries, indent=2) + "\n")
    _save(_figure(next(iter(flights.values())), flights), folder / "demo")


def _figure(shown: SimulatedFlight, flights: Mapping[str, SimulatedFlight]) -> Figure:
    """Snapshots of one flight above the cost curves of all."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.16, 4.2), layout="constrained")
        rows = figure.add_gridspec(2, 1, height_ratios=(1.0, 0.95))
        above = figure.add_subfigure(rows[0])
        below = figure.add_subfigure(rows[1])
        for column, share in enumerate(SNAPSHOTS, 1):
            axes = above.add_subplot(1, len(SNAPSHOTS), column)
            _draw_snapshot(axes, shown, share * shown.scenario.duration_s)
            if column == 1:
                axes.set_ylabel("y (m)")
            else:
                axes.set_yticklabels([])
        _draw_costs(below.add_subplot(), flights)
        return figure


def _draw_snapshot(axes: Axes, flight: SimulatedFlight, time_s: float) -> None:
    """Density, faint where nobody has looked yet, with the robots and their paths so far."""
    size_m = flight.perception.world_size / flight.scenario.scale.env_scale
    extent = (0.0, size_m, 0.0, size_m)
    past = flight.time_s <= time_s + 1e-9
    paths_m = flight.positions_m[past]
    seen = _seen(flight, paths_m)
    strength = np.where(seen, 1.0, _UNSEEN_STRENGTH)
    highest = max(float(flight.importance.max()), 1e-9)
    axes.imshow(
        (flight.importance * strength).T / highest,
        origin="lower", extent=extent, cmap=_DENSITY, vmin=0.0, vmax=1.0, interpolation="bilinear",
    )  # fmt: skip
    if not seen.all():
        axes.contour(
            seen.T.astype(float), levels=[0.5], extent=extent, colors="#636363", linewidths=0.4
        )
    for robot in range(paths_m.shape[1]):
        axes.plot(*paths_m[:, robot].T, color=_PATH, linewidth=0.7, solid_capstyle="round")
    axes.plot(
        *paths_m[-1].T,
        linestyle="", marker="o", markersize=4, color=_PATH, markeredgecolor="k",
        markeredgewidth=0.5,
    )  # fmt: skip
    axes.set(
        title=f"$t$ = {time_s:g} s", xlabel="x (m)", xlim=(0.0, size_m), ylim=(0.0, size_m),
        xticks=np.linspace(0.0, size_m, 3), yticks=np.linspace(0.0, size_m, 3), aspect="equal",
    )  # fmt: skip


def _seen(flight: SimulatedFlight, positions_m: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    """Which cells of the world lay in a robot's sensor view at one of `positions_m` (T, N, 2)."""
    world_size, sensor_size = flight.perception.world_size, flight.perception.sensor_size
    seen = np.zeros((world_size, world_size), np.bool_)
    for position in flight.scenario.scale.position_to_model(positions_m.reshape(-1, 2)):
        corner = window_corner(position, sensor_size)
        in_world, _ = part_in_world(corner, sensor_size, world_size)
        seen[in_world] = True
    return seen


def _draw_costs(axes: Axes, flights: Mapping[str, SimulatedFlight]) -> None:
    """Normalised cost over time, each curve labelled with its last value."""
    for (name, flight), (color, style, width) in zip(flights.items(), _CURVES, strict=False):
        cost = flight.normalized_cost
        axes.plot(
            flight.cost_time_s, cost, color=color, linestyle=style, linewidth=width,
            label=f"{cost[-1]:.2f}  {name}",
        )  # fmt: skip
    end_s = max(flight.cost_time_s[-1] for flight in flights.values())
    axes.set(
        xlabel="time (s)",
        ylabel=r"coverage cost $J(t)\,/\,J(0)$",
        xlim=(0.0, end_s),
        ylim=(0, None),
    )
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color="#d9d9d9", linewidth=0.4)
    axes.legend(
        loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False,
        title=f"$J$({end_s:g} s) / $J$(0)", alignment="left", handlelength=2.8,
    )  # fmt: skip


def _save(figure: Figure, path: Path) -> None:
    with mpl.rc_context(STYLE):
        for suffix in (".png", ".pdf"):
            figure.savefig(path.with_suffix(suffix))
