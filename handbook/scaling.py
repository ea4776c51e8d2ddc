"""`python -m handbook.scaling`: draw docs/scaling.png, print the tables of docs/network.md."""

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from matplotlib.ticker import FuncFormatter

from edge.core.wire import PayloadType
from lpac.analysis import style
from lpac.radio.airtime import (
    MESSAGE_BYTES,
    Traffic,
    Transport,
    Wifi,
    airtime,
    capacity,
    link_quality,
)

FLEETS = (10, 15, 20, 30, 60, 100)
PAYLOADS: tuple[PayloadType, ...] = ("float16", "int8")
MOST = 0.6


@dataclass(frozen=True, slots=True)
class Topology:
    """Transport of a fleet's messages."""

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
    """The model's tables of docs/network.md as Markdown, by topic."""
    robots = [str(n) for n in FLEETS]
    return {
        "airtime": _table(
            ("% of the channel's time", *robots, f"robots at {100.0 * MOST:.0f} %"),
            [
                (*row, _both(partial(_carried, topology)))
                for row, topology in zip(_of_fleets(_percent_of), TOPOLOGIES, strict=True)
            ],
        ),
        "quality": _table(("lost, %; mean delay, ms", *robots), _of_fleets(_quality_of)),
    }


def draw(path: Path) -> None:
    """Draw airtime over the number of robots. Raises OSError."""
    with style.figure(style.WIDTH_IN / 2, 3.0) as figure:
        axes = figure.subplots()
        robots = sorted({round(10 ** (step / 20)) for step in range(6, 41)})
        for topology, (colour, dashes) in zip(TOPOLOGIES, style.CURVES, strict=False):
            of_all = [_total(topology, n, "int8") for n in robots]
            axes.plot(robots, of_all, color=colour, ls=dashes, lw=1.3, label=topology.name)
        axes.axhline(MOST, color=style.GREY, lw=0.8, ls=style.DOTTED)
        axes.axhline(1.0, color=style.GREY, lw=0.8)
        axes.set(
            xscale="log", yscale="log", xlabel="robots", xlim=(2.0, 100.0),
            ylabel="share of the channel's time", ylim=(0.01, 100.0),
        )  # fmt: skip
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{100.0 * value:g} %"))
        style.tidy(axes)
        figure.legend(loc="outside lower center", handlelength=2.8, fontsize=7)
        figure.savefig(path)


def _of_fleets(text: Callable[[Topology, int, PayloadType], str]) -> list[tuple[str, ...]]:
    """A row per topology with a cell per size of a fleet."""
    return [
        (topology.name, *(_both(partial(text, topology, n)) for n in FLEETS))
        for topology in TOPOLOGIES
    ]


def _both(text: Callable[[PayloadType], str]) -> str:
    """Text for each payload type, or once if equal."""
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
        return "> 95"
    return f"{100.0 * quality.loss:.0f}; {1e3 * quality.delay_s:.0f}"


def _carried(topology: Topology, payload: PayloadType) -> str:
    traffic = _traffic(1, payload)
    return str(capacity(topology.transport, topology.wifi, traffic, most=MOST))


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


if __name__ == "__main__":
    draw(Path("docs/scaling.png"))
    sys.stdout.write("\n\n".join(tables().values()) + "\n")
