"""Who hears whom, as a picture: the share that came, and how old it was."""

import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize

from edge.core import F64
from lpac.analysis import style
from lpac.radio.pairs import LATE_S, Pair

_MOST_WRITTEN = 16
# In characters.
_TITLE_WIDTH = 90
# Half of what was said: below, it is all the same.
_WORST_MISSING = 0.5


def draw(robots: Sequence[str], pairs: Sequence[Pair], title: str, path: Path) -> None:
    """`path`.png and .pdf. Raises OSError."""
    by_link = {(pair.receiver, pair.sender): pair for pair in pairs}

    def matrix(of_pair: Callable[[Pair], float | None]) -> F64:
        values = np.full((len(robots), len(robots)), np.nan)
        for row, receiver in enumerate(robots):
            for column, sender in enumerate(robots):
                pair = by_link.get((receiver, sender))
                value = None if pair is None else of_pair(pair)
                values[row, column] = np.nan if value is None else value
        return values

    with style.figure(style.WIDTH_IN, 0.6 * style.WIDTH_IN) as figure:
        left, right = figure.subplots(1, 2)
        missing = matrix(lambda pair: 1.0 - pair.delivered)
        _panel(left, robots, missing, 100.0 * (1.0 - missing), ".0f", _WORST_MISSING)
        left.set_title("arrived, %")
        ages_s = matrix(lambda pair: pair.age_p99_s)
        _panel(right, robots, ages_s, ages_s, ".2f", 2.0 * LATE_S)
        right.set_title(f"age, 99th percentile, s (late at {LATE_S:g})")
        left.set_ylabel("heard by")
        figure.suptitle(textwrap.fill(title, _TITLE_WIDTH), fontsize=9)
        style.save(figure, path)


def _panel(
    axes: Axes, robots: Sequence[str], colours: F64, told: F64, number: str, worst: float
) -> None:
    axes.set_facecolor(style.NOTHING)
    axes.imshow(colours, cmap=style.SCALE, norm=Normalize(0.0, worst))
    places = range(len(robots))
    axes.set_xticks(places, robots, rotation=90 if len(robots) > _MOST_WRITTEN else 0)
    axes.set_yticks(places, robots)
    axes.set_xlabel("said by")
    axes.tick_params(length=0)
    if len(robots) > _MOST_WRITTEN:
        return
    for (row, column), value in np.ndenumerate(told):
        if row != column:
            dark = colours[row, column] > 0.6 * worst
            axes.text(
                column, row, format(value, number) if np.isfinite(value) else "-",
                ha="center", va="center", fontsize=6, color="#ffffff" if dark else style.INK,
            )  # fmt: skip
