"""Rates of perception and of the exchange of messages, and late messages: what they cost.

One policy flies over the same worlds with several rates of perception, and of the policy, which are
those of the exchange: every robot at its own moments, or all at the same ones; and with messages
that are late. With all robots at the same moments messages cross one hop from one moment to the
next, as they do in the synchronous graph neural network, and what a robot says is never older than
a period. Results are held against those at the field's rates.
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

# Costs are told at these shares of the flight.
_SHARES = (0.25, 0.5, 1.0)
# How long flights of logs are looked at, s.
LOGGED_S = 60.0
_END = len(_SHARES) - 1


class Timing(NamedTuple):
    """When robots perceive, and decide and speak; and how late what they say is, on average."""

    perception_hz: float
    policy_hz: float
    synchronous: bool = False
    delay_s: float = 0.0

    @classmethod
    def of(cls, scenario: Scenario) -> "Timing":
        """That of a scenario."""
        clocks = scenario.clocks
        return cls(
            1.0 / clocks.perception_s, 1.0 / clocks.policy_s, clocks.synchronous, scenario.delay_s
        )

    @property
    def rounds(self) -> float:
        """How often messages are exchanged for each perception."""
        return self.policy_hz / self.perception_hz


FIELD = Timing.of(Scenario())


@dataclass(frozen=True, slots=True, eq=False)
class TimingResult:
    """What a timing came to over K worlds: `curves` (K, C) at `time_s`, over the cost at the start.

    `worlds` names them, or the missions. `over_field` is, at each of `times_s`, the ratio of the
    mean cost to that with the field's timing, with its interval: over the same worlds in pairs, and
    of missions over these and those, which may differ.
    """

    timing: Timing
    worlds: tuple[str, ...]
    time_s: F64
    curves: F64
    over_field: tuple[Interval95, ...] = ()

    @property
    def times_s(self) -> tuple[float, ...]:
        """When costs are told."""
        return tuple(share * float(self.time_s[-1]) for share in _SHARES)

    @property
    def costs(self) -> F64:
        """(K, 3): at `times_s`."""
        return np.array([np.interp(self.times_s, self.time_s, curve) for curve in self.curves])

    @property
    def area(self) -> F64:
        """(K,): the mean cost over the flight."""
        return mean_over_time(self.time_s, self.curves)

    @property
    def means(self) -> tuple[Interval95, ...]:
        """At each of `times_s`, with the interval over other worlds."""
        return tuple(bootstrap(costs[None]) for costs in self.costs.T)


def results_of(
    flown: Mapping[Condition, Sequence[MethodResult]], worlds: Sequence[str]
) -> list[TimingResult]:
    """Of the first policy, under each condition: those at the field's timing first.

    Raises ValueError if none is.
    """
    timings = {Timing.of(condition.scenario): its[0] for condition, its in flown.items()}
    if FIELD not in timings:
        raise ValueError("rates: no condition has the field's, with which others are compared")
    results = [
        TimingResult(timing, tuple(worlds), its.time_s, its.curves.mean(axis=0))
        for timing, its in timings.items()
    ]
    return _over_field(results, paired=True)


def results_of_logs(records: Mapping[str, FlightRecord]) -> list[TimingResult]:
    """Of missions by name, by the rates that they were flown at; the field's first.

    Those that are not in `is_comparable` are left out. Raises ValueError if none of the others has
    the field's rates.
    """
    time_s = np.linspace(0.0, LOGGED_S, 1 + int(LOGGED_S))
    timings: dict[Timing, dict[str, F64]] = {}
    for name, record in records.items():
        if record.rates is not None and is_comparable(record):
            curve = np.interp(time_s, record.curve_time_s, record.normalized)
            timings.setdefault(Timing(*record.rates), {})[name] = curve
    if FIELD not in timings:
        raise ValueError(
            f"no mission of {LOGGED_S:g} s was flown with perception at "
            f"{FIELD.perception_hz:g} Hz and policy at {FIELD.policy_hz:g} Hz, with which the "
            "others are compared"
        )
    results = [
        TimingResult(timing, tuple(its), time_s, np.array(list(its.values())))
        for timing, its in timings.items()
    ]
    return _over_field(results, paired=False)


def is_comparable(record: FlightRecord) -> bool:
    """Whether its rates are known, and it lasted as long as costs are looked at, or nearly."""
    return record.rates is not None and bool(record.curve_time_s[-1] > LOGGED_S - 1.0)


def _over_field(results: Sequence[TimingResult], *, paired: bool) -> list[TimingResult]:
    """Each held against that with the field's timing, which comes first."""
    in_order = sorted(results, key=lambda result: result.timing != FIELD)
    field = in_order[0].costs

    def ratio(own: F64, theirs: F64) -> Interval95:
        if paired:
            return paired_bootstrap(own[None], theirs[None], ratio_of_means, same_trainings=True)
        # As many trainings of one world: each side's are drawn by themselves.
        return paired_bootstrap(own[:, None], theirs[:, None], ratio_of_means)

    return [
        replace(result, over_field=tuple(map(ratio, result.costs.T, field.T)))
        for result in in_order
    ]


def said_kb_s(message_bytes: int, policy_hz: float) -> float:
    """What a robot says at most in a second, kB."""
    return policy_hz * message_bytes / 1000.0


def rates(
    results: Sequence[TimingResult], message_bytes: int, folder: Path, *, paired: bool = True
) -> Section:
    """What each timing came to; `message_bytes` is the most that a robot says at a time.

    With `paired` the results are over the same worlds, and else over missions that may differ.
    Raises OSError.
    """
    style.save(_rates(message_bytes, results), folder / "rates")
    shown = [Picture("rates.png", _RATES + (_IN_STEP if _in_step(results) else ""))]
    if _late(results):
        style.save(_staleness(results), folder / "staleness")
        shown.append(Picture("staleness.png", "The cost with messages that are late, over that "
                             "without, at the field's rates."))  # fmt: skip
    times_s = results[0].times_s
    headings = ["perception, Hz", "policy, Hz", "rounds per perception", "said, kB/s", "moments",
                "delay, s", *(f"cost at {time_s:g} s" for time_s in times_s),
                "mean cost over the flight"]  # fmt: skip
    intervals = "by worlds in pairs" if paired else "the missions of each rate drawn by themselves"
    note = (
        "Cost over that at the start, and in brackets the 95 % interval of its ratio to the cost "
        f"with the field's timing, the first row (bootstrap, {intervals}; the ratio alone of a "
        "single one). A robot speaks as often as its policy decides: *said* is what that asks of "
        "the radio, at most, since messages are compressed."
    )
    rows = [_row(message_bytes, result) for result in results]
    return Section(
        {"times_s": list(times_s), "timings": [_json(message_bytes, each) for each in results]},
        [Table(headings, rows, "Rate by rate", note)],
        shown,
        _rows(message_bytes, results),
    )


_RATES = (
    "Cost over the policy's rate, relative to that at the field's rates and own moments: above 1 "
    "is worse. Bars are 95 % intervals of the ratio of means."
)
_IN_STEP = " Solid lines: each robot at its own moments; dashed: all robots in step."


def _json(message_bytes: int, result: TimingResult) -> dict[str, object]:
    """All numbers, for scripts; intervals as [value, low, high]."""
    return {
        **result.timing._asdict(),
        "rounds_per_perception": result.timing.rounds,
        "said_kb_s": said_kb_s(message_bytes, result.timing.policy_hz),
        "means": [list(mean) for mean in result.means],
        "over_field": [list(ratio) for ratio in result.over_field],
        "area": list(bootstrap(result.area[None])),
        "over": list(result.worlds),
        "by_world": result.costs.tolist(),
    }


def _late(results: Sequence[TimingResult]) -> list[TimingResult]:
    """At the field's rates, over how late messages are; none if none were."""
    of_field = [r for r in results if r.timing._replace(delay_s=0.0) == FIELD]
    return of_field if len(of_field) > 1 else []


def _rows(message_bytes: int, results: Sequence[TimingResult]) -> list[list[object]]:
    """A heading, and a row for each timing and world, or mission."""
    times = [f"cost_at_{time_s:g}_s" for time_s in results[0].times_s]
    rows: list[list[object]] = [
        ["perception_hz", "policy_hz", "synchronous", "delay_s", "rounds_per_perception",
         "said_kb_s", "world", *times]
    ]  # fmt: skip
    for result in results:
        perception_hz, policy_hz, synchronous, delay_s = result.timing
        of_timing = [perception_hz, policy_hz, int(synchronous), delay_s, result.timing.rounds,
                     said_kb_s(message_bytes, policy_hz)]  # fmt: skip
        its = zip(result.worlds, result.costs.tolist(), strict=True)
        rows += [[*of_timing, world, *costs] for world, costs in its]
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
            # What these rates ask of the radio.
            above = axes.twiny()
            above.set(xscale="log", xlim=axes.get_xlim(), xlabel="said by a robot, kB/s at most")
            kb_s = [said_kb_s(message_bytes, hz) for hz in of_policy_hz]
            above.set_xticks(of_policy_hz, [f"{each:.2g}" for each in kb_s])
            above.minorticks_off()
            above.spines[["right"]].set_visible(False)
        if _in_step(results):
            axes.plot(
                [], [], ls=style.DASHED, color=style.INK, lw=1.0, label="all at the same moments"
            )
        handles, labels = axes.get_legend_handles_labels()
        figure.legend(
            handles, labels, loc="outside upper center", ncols=len(labels), title="perception"
        )
        return figure


def _in_step(results: Sequence[TimingResult]) -> bool:
    """Whether some flew with all robots at the same moments."""
    return any(result.timing.synchronous for result in results)


def _staleness(results: Sequence[TimingResult]) -> Figure:
    """Cost over the mean delay of messages, at the rates of the field."""
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
    # One world, or one mission, says nothing of others.
    is_one = len(result.worlds) == 1
    costs = [
        f"{mean:.3f} (x {value:.2f})" if is_one else f"{mean:.3f} (x {low:.2f} to {high:.2f})"
        for (mean, _, _), (value, low, high) in zip(result.means, result.over_field, strict=True)
    ]
    return [
        f"{timing.perception_hz:g}",
        f"{timing.policy_hz:g}",
        f"{timing.rounds:.2g}",
        f"{said_kb_s(message_bytes, timing.policy_hz):.2g}",
        "the same" if timing.synchronous else "own",
        f"{timing.delay_s:g}",
        *costs,
        f"{result.area.mean():.3f}",
    ]
