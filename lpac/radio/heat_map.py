"""Heat map of links: share of lost messages, and age of the others."""

import textwrap
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lpac.analysis import style
from lpac.analysis.figures import draw_matrix
from lpac.radio.pairs import LATE_S, Pair

# Characters on a line.
_TITLE_WIDTH = 90
_MUCH_LOST = 50.0


def draw(robots: Sequence[str], pairs: Sequence[Pair], title: str, path: Path) -> None:
    """Draw `path`.png and .pdf. Raises OSError."""
    lost, age_ms = np.full((2, len(robots), len(robots)), np.nan)
    for pair in pairs:
        link = robots.index(pair.receiver), robots.index(pair.sender)
        lost[link] = 100.0 * (1.0 - pair.delivered)
        if pair.age_p99_s is not None:
            age_ms[link] = 1e3 * pair.age_p99_s
    with style.figure(style.WIDTH_IN, 0.5 * style.WIDTH_IN) as figure:
        left, right = figure.subplots(1, 2)
        draw_matrix(figure, left, lost, robots, "lost (%)", _MUCH_LOST)
        label = f"age, 99th percentile (ms; late at {1e3 * LATE_S:g})"
        draw_matrix(figure, right, age_ms, robots, label, 2e3 * LATE_S)
        figure.suptitle(textwrap.fill(title, _TITLE_WIDTH), fontsize=9)
        style.save(figure, path)
