"""`python -m handbook.scaling`: docs/scaling.png, and the tables of docs/scaling.md to print."""

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter

from edge.core.wire import PayloadType
from lpac.analysis import style
from lpac.radio.airtime import (
    MESSAGE_BYTES,
    Traffic,
    Transport,
    Wifi,
    airtime,
    carries,
    cells,
    link_quality,
)

FLEETS = (10, 30, 100, 300, 1000)
PAYLOADS: tuple[PayloadType, ...] = ("float16", "int8")
# The example's field: ten robots in 32 x 32 m, whose messages are of use within 16 m.
PER_M2, RANGE_M = 10 / 32**2, 16.0
MOST = 0.6


@dataclass(frozen=True, slots=True)
class Topology:
    """How a fleet's messages travel."""

    name: str
    transport: Transport
    wifi: Wifi


_WIRED = Wifi()
TOPOLOGIES = (
    Topology("mesh", "mesh", _WIRED),
    Topology("multicast at 6 Mbit/s", "multicast", _WIRED),
    Topology("multicast at 24 Mbit/s", "multicast", Wifi(multicast_rate_mbit_s=24.0)),
)


def tables() -> dict[str, str]:
    """The tables of docs/scaling.md, as Markdown, by what they are about."""
    robots = [str(n) for n in FLEETS]
    return {
        "airtime": _table(
            ("% of the channel's time", *robots, f"robots at {100.0 * MOST:.0f} %"),
            [
                (*row, _both(partial(_carried, topology)))
                for row, topology in zip(_of_fleets(_percent_of), TOPOLOGIES, strict=True)
            ],
        ),
        "quality": _table(("lost, mean delay", *robots), _of_fleets(_quality_of)),
        "cells": _table(
            ("", *(f"cells for {n}" for n in robots[2:])),
            [
                (topology.name, *(_both(partial(_cells_of, topology, n)) for n in FLEETS[2:]))
                for topology in TOPOLOGIES
                if topology.transport != "mesh"
            ],
        ),
    }


def draw(path: Path) -> None:
    """Airtime over the number of robots, and the cells that it takes. Raises OSError."""
    with style.figure(style.WIDTH_IN, 3.0) as figure:
        left, right = figure.subplots(1, 2)
        robots = sorted({round(10 ** (step / 20)) for step in range(6, 61)})
        for topology, (colour, dashes) in zip(TOPOLOGIES, style.CURVES, strict=False):
            of_all = [_total(topology, n, "int8") for n in robots]
            left.plot(robots, of_all, color=colour, ls=dashes, lw=1.3, label=topology.name)
            if topology.transport != "mesh":
                parted = [_cells(topology, n, "int8") or math.nan for n in robots]
                right.plot(robots, parted, color=colour, ls=dashes, lw=1.3, drawstyle="steps-mid")
        left.axhline(MOST, color=style.GREY, lw=0.8, ls=style.DOTTED)
        left.axhline(1.0, color=style.GREY, lw=0.8)
        left.set(ylabel="share of the channel's time", ylim=(0.01, 100.0))
        right.set(
            ylabel=f"cells, each of {100.0 * MOST:.0f} % of a channel at most", ylim=(0.9, 120.0)
        )
        for axes, number in ((left, _percent), (right, _plain)):
            _log_axes(axes, number)
        figure.legend(loc="outside lower center", ncols=3, handlelength=2.8, fontsize=7)
        figure.savefig(path)


def _log_axes(axes: Axes, number: Callable[[float], str]) -> None:
    axes.set(xscale="log", yscale="log", xlabel="robots", xlim=(2.0, 1000.0))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: _plain(value)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: number(value)))
    style.tidy(axes)


def _of_fleets(text: Callable[[Topology, int, PayloadType], str]) -> list[tuple[str, ...]]:
    """A row for each topology, and in it a cell for each size of a fleet."""
    return [
        (topology.name, *(_both(partial(text, topology, n)) for n in FLEETS))
        for topology in TOPOLOGIES
    ]


def _both(text: Callable[[PayloadType], str]) -> str:
    """Of each payload type, or once if they are the same."""
    texts = [text(payload) for payload in PAYLOADS]
    return texts[0] if len(set(texts)) == 1 else " / ".join(texts)


def _traffic(robots: int, payload: PayloadType) -> Traffic:
    return Traffic(robots=robots, message_bytes=MESSAGE_BYTES[payload])


def _total(topology: Topology, robots: int, payload: PayloadType) -> float:
    traffic = _traffic(robots, payload)
    return airtime(topology.transport, topology.wifi, traffic).total


def _percent_of(topology: Topology, robots: int, payload: PayloadType) -> str:
    total = 100.0 * _total(topology, robots, payload)
    return f"{total:.0f}" if total < 1000.0 else "> 1000"


def _quality_of(topology: Topology, robots: int, payload: PayloadType) -> str:
    traffic = _traffic(robots, payload)
    quality = link_quality(topology.transport, topology.wifi, traffic)
    if quality.loss > 0.95:
        return "> 95 %"
    return f"{100.0 * quality.loss:.0f} %, {1e3 * quality.delay_s:.0f} ms"


def _carried(topology: Topology, payload: PayloadType) -> str:
    traffic = _traffic(1, payload)
    return str(carries(topology.transport, topology.wifi, traffic, most=MOST))


def _cells(topology: Topology, robots: int, payload: PayloadType) -> int | None:
    return cells(
        topology.transport,
        topology.wifi,
        _traffic(robots, payload),
        per_m2=PER_M2,
        range_m=RANGE_M,
        most=MOST,
    )


def _cells_of(topology: Topology, robots: int, payload: PayloadType) -> str:
    return str(_cells(topology, robots, payload) or "none do")


def _percent(value: float) -> str:
    return f"{100.0 * value:g} %"


def _plain(value: float) -> str:
    return f"{value:g}"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


if __name__ == "__main__":
    draw(Path("docs/scaling.png"))
    sys.stdout.write("\n\n".join(tables().values()) + "\n")
