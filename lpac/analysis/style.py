"""Common style of figures: for print, screen, and colour-blind readers.

Colours are by Okabe and Ito. Density is grey, so that all of them stand out on it. In small maps
the swarm has one colour, used by no curve; where lines have to be followed, each robot has its own.
These repeat, so robots are labelled as well.
"""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, to_hex
from matplotlib.figure import Figure

from edge.messages.mission import FlightState

WIDTH_IN = 7.16

BLACK, ORANGE, SKY, GREEN, YELLOW, BLUE, VERMILLION, PURPLE = (
    "#000000", "#e69f00", "#56b4e9", "#009e73", "#f0e442", "#0072b2", "#d55e00", "#cc79a7",
)  # fmt: skip
INK, GREY, FAINT, NOTHING = "#252525", "#636363", "#bdbdbd", "#f0f0f0"
SWARM, SEEN, FENCE, LLOYD = ORANGE, BLUE, VERMILLION, GREY
DENSITY = LinearSegmentedColormap.from_list("density", ["#ffffff", "#c4c8cd", "#5f666e"])
SCALE = LinearSegmentedColormap.from_list("scale", ["#fff7ec", "#fdbb84", "#d7301f", "#7f0000"])
UNSEEN_STRENGTH = 0.3
DOTTED: Any = (0, (1, 1.5))
DASHED: Any = (0, (3, 1.5))
# Line colours and styles by index; without the swarm's colour.
CURVES: tuple[tuple[str, Any], ...] = (
    (BLACK, "-"),
    (BLUE, "--"),
    (GREEN, "-."),
    (PURPLE, (0, (5, 1))),
    (SKY, (0, (3, 1, 1, 1))),
    (VERMILLION, "-"),
)
# More curves, for figures without a map: a policy and all baselines.
MANY_CURVES: tuple[tuple[str, Any], ...] = (
    *CURVES, (ORANGE, "-"), (GREY, "--"), (YELLOW, "-."), (FAINT, "-"),
)  # fmt: skip
_ROBOTS = (BLUE, ORANGE, GREEN, PURPLE, SKY, VERMILLION, YELLOW, BLACK)
# Text on these is white.
DARK = (BLUE, GREEN, VERMILLION, BLACK)
_S = FlightState
STATE_COLOURS = {
    _S.INIT: NOTHING,
    _S.IDLE: NOTHING,
    _S.PREFLIGHT: "#d0d0d0",
    _S.ARMING: "#f6d7a0",
    _S.TAKEOFF: ORANGE,
    _S.HOLD: YELLOW,
    _S.MISSION: GREEN,
    _S.RETURN: SKY,
    _S.LAND: BLUE,
    _S.LANDED: "#d0d0d0",
    _S.PILOT: PURPLE,
    _S.FAULT: BLACK,
}
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
    "legend.handlelength": 2.2,
    "legend.columnspacing": 1.2,
    "savefig.dpi": 200,
}


@contextmanager
def figure(width_in: float, height_in: float) -> Iterator[Figure]:
    """Make a figure; draw into it within this context, in the common style."""
    with mpl.rc_context(_STYLE):
        drawn = Figure(figsize=(width_in, height_in), layout="constrained")
        yield drawn
        # Axes of fixed aspect, and their neighbours, reach their places only in a second layout.
        engine = drawn.get_layout_engine()
        assert engine is not None
        engine.execute(drawn)


def save(drawn: Figure, path: Path) -> bytes:
    """Write `path`.png and .pdf; returns the PNG. Raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context(_STYLE):
        drawn.savefig(path.with_name(f"{path.name}.pdf"))
        # The layout is final; another would take as long as drawing.
        drawn.set_layout_engine("none")
        png = io.BytesIO()
        drawn.savefig(png, format="png")
    path.with_name(f"{path.name}.png").write_bytes(png.getvalue())
    return png.getvalue()


def robot_colour(index: int) -> str:
    """Colour of the robot at this index in its record."""
    return _ROBOTS[index % len(_ROBOTS)]


def colours_of(count: int) -> list[str]:
    """Colours of missions in one figure; black is reserved for their mean."""
    if count < len(CURVES):
        return [colour for colour, _ in CURVES[1 : count + 1]]
    return [to_hex(colour) for colour in mpl.colormaps["viridis"](np.linspace(0.0, 0.9, count))]


def tidy(axes: Axes) -> None:
    """Style axes of a plot over time."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color="#d9d9d9", linewidth=0.4)
