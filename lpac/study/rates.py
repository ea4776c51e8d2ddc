"""Effects of the rates of perception and message exchange, and of late messages.

One policy flies over the same worlds with several rates of perception and of the policy, which is
also the rate of exchange; with unsynchronised or synchronised robots; and with late messages. With
synchronised robots, messages cross one hop per step, as in the synchronous graph neural network,
and are never older than a period. Results are relative to those at the field's rates.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from edge.core import F64
from lpac.analysis import style
from lpac.analysis.flight import FlightRecord
from lpac.analysis.statistics import (
    Interval95,
    bootstrap,
    mean_over_time,
    paired_bootstrap,
    ratio_of_means,
)
from lpac.analysis.style import CURVES, WIDTH_IN, tidy
from lpac.sim.scenario import Scenario
from lpac.study.report import Picture, Table
from lpac.study.results import MethodResult
from lpac.study.sections import Section
from lpac.study.study import Condition

# Costs are reported at these shares of the flight.
_SHARES = (0.25, 0.5, 1.0)
# Evaluated duration of logged flights, s.
LOGGED_S = 60.0
_END = len(_SHARES) - 1


class Timing(NamedTuple):
    """Rates of perception and policy, synchronisation, and mean delay of messages."""

    perception_hz: float
    policy_hz: float
    synchronous: bool = False
    delay_s: float = 0.0

    @classmethod
    def of(cls, scenario: Scenario) -> "Timing":
        """Timing of a scenario."""
        clocks = scenario.clocks
        return cls(
            1.0 / clocks.perception_s, 1.0 / clocks.policy_s, clocks.synchronous, scenario.delay_s
        )

    @property
    def rounds(self) -> float:
        """Exchanges of messages per perception."""
        return self.policy_hz / self.perception_hz


FIELD = Timing.of(Scenario())


@dataclass(frozen=True, slots=True, eq=False)
class TimingResult:
    """Results of a timing over K worlds: `curves` (K, C) at `time_s`, over the initial cost.

    `worlds` names the worlds, or missions. `over_field` has, for each of `times_s`, the ratio of
    the mean cost to that with the field's timing, with its interval: paired by world, or for
    missions, which may differ, unpaired.
    """

    timing: Timing
    worlds: tuple[str, ...]
    time_s: F64
    curves: F64
    over_field: tuple[Interval95, ...] = ()

    @property
    def times_s(self) -> tuple[float, ...]:
        """Times of the reported costs."""
        return tuple(share * float(self.time_s[-1]) for share in _SHARES)

    @property
    def costs(self) -> F64:
        """Costs (K, 3) at `times_s`."""
        return np.array([np.interp(self.times_s, self.time_s, curve) for curve in self.curves])

    @property
    def area(self) -> F64:
        """Mean costs (K,) over the flight."""
        return mean_over_time(self.time_s, self.curves)

    @property
    def means(self) -> tuple[Interval95, ...]:
        """Mean cost at each of `times_s`, with its interval over worlds."""
        return tuple(bootstrap(costs[None]) for costs in self.costs.T)


def results_of(
    flown: Mapping[Condition, Sequence[MethodResult]], worlds: Sequence[str]
) -> list[TimingResult]:
    """Results of the first policy under each condition, the field's timing first.

    Raises ValueError if no condition has it.
    """
    timings = {Timing.of(condition.scenario): results[0] for condition, results in flown.items()}
    if FIELD not in timings:
        raise ValueError(
            "rates: no condition has the field's rates, with which others are compared"
        )
    results = [
        TimingResult(timing, tuple(worlds), result.time_s, result.curves.mean(axis=0))
        for timing, result in timings.items()
    ]
    return _over_field(results, paired=True)


def results_of_logs(records: Mapping[str, FlightRecord]) -> list[TimingResult]:
    """Results of missions, by name, grouped by their rates; the field's first.

    Skips missions that are not `is_comparable`. Raises ValueError if none has the field's rates.
    """
    time_s = np.linspace(0.0, LOGGED_S, 1 + int(LOGGED_S))
    timings: dict[Timing, dict[str, F64]] = {}
    for name, record in records.items():
        if record.rates is not None and is_comparable(record):
            curve = np.interp(time_s, record.curve_time_s, record.normalized)
            timings.setdefault(Timing(*record.rates), {})[name] = curve
    if FIELD not in timings:
        raise ValueError(
            f"no mission of {LOGGED_S:g} s has perception at {FIELD.perception_hz:g} Hz and policy "
            f"at {FIELD.policy_hz:g} Hz, with which others are compared"
        )
    results = [
        TimingResult(timing, tuple(curves), time_s, np.array(list(curves.values())))
        for timing, curves in timings.items()
    ]
    return _over_field(results, paired=False)


def is_comparable(record: FlightRecord) -> bool:
    """Whether its rates are known, and it lasted for about the evaluated duration."""
    return record.rates is not None and bool(record.curve_time_s[-1] > LOGGED_S - 1.0)


def _over_field(results: Sequence[TimingResult], *, paired: bool) -> list[TimingResult]:
    """Add ratios to the results with the field's timing, which comes first."""
    in_order = sorted(results, key=lambda result: result.timing != FIELD)
    field = in_order[0].costs

    def ratio(own: F64, theirs: F64) -> Interval95:
        if paired:
            return paired_bootstrap(own[None], theirs[None], ratio_of_means, same_trainings=True)
        # As trainings in one world, both sides are resampled independently.
        return paired_bootstrap(own[:, None], theirs[:, None], ratio_of_means)

    return [
        replace(result, over_field=tuple(map(ratio, result.costs.T, field.T)))
        for result in in_order
    ]


def sent_kb_s(message_bytes: int, policy_hz: float) -> float:
    """Maximum data rate of a robot's messages, kB/s."""
    return policy_hz * message_bytes / 1000.0


def rates(
    results: Sequence[TimingResult], message_bytes: int, folder: Path, *, paired: bool = True
) -> Section:
    """Section with the result of each timing; `message_bytes` is a message's maximum size.

    `paired` results are over the same worlds, others over missions that may differ. Raises OSError.
    """
    style.save(_rates(message_bytes, results), folder / "rates")
    shown = [Picture("rates.png", _RATES + (_IN_STEP if _in_step(results) else ""))]
    if _late(results):
        style.save(_staleness(results), folder / "staleness")
        shown.append(Picture("staleness.png", "Cost with late messages over cost without, at the "
                             "field's rates."))  # fmt: skip
    times_s = results[0].times_s
    headings = ["perception, Hz", "policy, Hz", "rounds per perception", "sent, kB/s", "steps",
                "delay, s", *(f"cost at {time_s:g} s" for time_s in times_s),
                "mean cost over the flight"]  # fmt: skip
    intervals = "paired by world" if paired else "unpaired missions"
    note = (
        "Cost over the initial cost; in brackets the 95 % interval of its ratio to the cost with "
        f"the field's timing, the first row (bootstrap, {intervals}; only the ratio for a single "
        "one). A robot sends as often as its policy decides: *sent* is the maximum data rate: "
        "messages are compressed."
    )
    rows = [_row(message_bytes, result) for result in results]
    return Section(
        {"times_s": list(times_s), "timings": [_json(message_bytes, each) for each in results]},
        [Table(headings, rows, "Rate by rate", note)],
        shown,
        _rows(message_bytes, results),
    )


_RATES = (
    "Cost over the policy's rate, relative to that at the field's unsynchronised rates: above 1 "
    "is worse. Bars are 95 % intervals of the ratio of means."
)
_IN_STEP = " Solid lines: unsynchronised robots; dashed: synchronised."


def _json(message_bytes: int, result: TimingResult) -> dict[str, object]:
    """All numbers for scripts; intervals as [value, low, high]."""
    return {
        **result.timing._asdict(),
        "rounds_per_perception": result.timing.rounds,
        "said_kb_s": sent_kb_s(message_bytes, result.timing.policy_hz),
        "means": [list(mean) for mean in result.means],
        "over_field": [list(ratio) for ratio in result.over_field],
        "area": list(bootstrap(result.area[None])),
        "over": list(result.worlds),
        "by_world": result.costs.tolist(),
    }


def _late(results: Sequence[TimingResult]) -> list[TimingResult]:
    """Results at the field's rates with any delay; empty if none has one."""
    of_field = [r for r in results if r.timing._replace(delay_s=0.0) == FIELD]
    return of_field if len(of_field) > 1 else []


def _rows(message_bytes: int, results: Sequence[TimingResult]) -> list[list[object]]:
    """CSV rows: a heading, then one per timing and world, or mission."""
    times = [f"cost_at_{time_s:g}_s" for time_s in results[0].times_s]
    rows: list[list[object]] = [
        ["perception_hz", "policy_hz", "synchronous", "delay_s", "rounds_per_perception",
         "said_kb_s", "world", *times]
    ]  # fmt: skip
    for result in results:
        perception_hz, policy_hz, synchronous, delay_s = result.timing
        of_timing = [perception_hz, policy_hz, int(synchronous), delay_s, result.timing.rounds,
                     sent_kb_s(message_bytes, policy_hz)]  # fmt: skip
        by_world = zip(result.worlds, result.costs.tolist(), strict=True)
        rows += [[*of_timing, world, *costs] for world, costs in by_world]
    return rows


def _rates(message_bytes: int, results: Sequence[TimingResult]) -> Figure:
    """Cost over the policy's rate, a curve for each rate of perception; early, and at the end."""
    by_timing = {result.timing: result for result in results}
    of_perception_hz = sorted({timing.perception_hz for timing in by_timing})
    of_policy_hz = sorted({timing.policy_hz for timing in by_timing})
    with style.figure(WIDTH_IN, 2.8) as figure:
        for axes, at in zip(figure.subplots(1, 2), (0, _END), strict=True):
            for (colour, _), perception_hz in zip(CURVES, of_perception_hz, strict=False):
                for synchronous in (False, True):
                    timings = [
                        FIELD._replace(
                            perception_hz=perception_hz, policy_hz=hz, synchronous=synchronous
                        )
                        for hz in of_policy_hz
                    ]
                    row = [by_timing[timing] for timing in timings if timing in by_timing]
                    if not row:
                        continue
                    label = None if synchronous else f"{perception_hz:g} Hz"
                    x = [result.timing.policy_hz for result in row]
                    _curve(axes, x, row, at, colour, label, dashed=synchronous)
            axes.set_xscale("log")
            axes.set_xticks(of_policy_hz, [f"{hz:g}" for hz in of_policy_hz])
            axes.minorticks_off()
            axes.set(
                xlabel="policy and exchange of messages, Hz",
                ylabel=f"cost at {results[0].times_s[at]:g} s / with the field's rates",
            )
            tidy(axes)
            # Data rates at these policy rates.
            above = axes.twiny()
            above.set(xscale="log", xlim=axes.get_xlim(), xlabel="sent by a robot, kB/s at most")
            kb_s = [sent_kb_s(message_bytes, hz) for hz in of_policy_hz]
            above.set_xticks(of_policy_hz, [f"{each:.2g}" for each in kb_s])
            above.minorticks_off()
            above.spines[["right"]].set_visible(False)
        if _in_step(results):
            axes.plot([], [], ls=style.DASHED, color=style.INK, lw=1.0, label="synchronised")
        handles, labels = axes.get_legend_handles_labels()
        figure.legend(
            handles, labels, loc="outside upper center", ncols=len(labels), title="perception"
        )
        return figure


def _in_step(results: Sequence[TimingResult]) -> bool:
    """Whether any flights had synchronised robots."""
    return any(result.timing.synchronous for result in results)


def _staleness(results: Sequence[TimingResult]) -> Figure:
    """Cost over the mean delay of messages, at the field's rates."""
    late = _late(results)
    delays_s = [result.timing.delay_s for result in late]
    with style.figure(WIDTH_IN / 2, 2.6) as figure:
        axes = figure.subplots()
        for at, ((colour, _), time_s) in enumerate(zip(CURVES, late[0].times_s, strict=False)):
            _curve(axes, delays_s, late, at, colour, f"at {time_s:g} s", dashed=False)
        axes.set(xlabel="mean delay of messages, s", ylabel="cost / without delay")
        tidy(axes)
        axes.legend()
        return figure


def _curve(
    axes: Axes,
    x: Sequence[float],
    row: Sequence[TimingResult],
    at: int,
    colour: str,
    label: str | None,
    *,
    dashed: bool,
) -> None:
    values, lows, highs = zip(*(result.over_field[at] for result in row), strict=True)
    line = style.DASHED if dashed else "-"
    axes.plot(x, values, ls=line, marker="o", ms=3, mfc="w" if dashed else colour, color=colour,
              lw=1.0, label=label)  # fmt: skip
    axes.vlines(x, lows, highs, color=colour, lw=0.6)
    axes.axhline(1.0, color=style.FAINT, lw=0.8, zorder=0)


def _row(message_bytes: int, result: TimingResult) -> list[str]:
    timing = result.timing
    # A single world or mission has no interval.
    is_one = len(result.worlds) == 1
    costs = [
        f"{mean:.3f} (x {value:.2f})" if is_one else f"{mean:.3f} (x {low:.2f} to {high:.2f})"
        for (mean, _, _), (value, low, high) in zip(result.means, result.over_field, strict=True)
    ]
    return [
        f"{timing.perception_hz:g}",
        f"{timing.policy_hz:g}",
        f"{timing.rounds:.2g}",
        f"{sent_kb_s(message_bytes, timing.policy_hz):.2g}",
        "synchronised" if timing.synchronous else "own",
        f"{timing.delay_s:g}",
        *costs,
        f"{result.area.mean():.3f}",
    ]
