"""The experiment on rates and asynchrony as files: figures, CSV, JSON, and README.md."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lpac.analysis import style
from lpac.analysis.style import CURVES, WIDTH_IN, tidy
from lpac.paper.asynchrony import FIELD, TIMES_S, Flown, TimingResult, as_json
from lpac.paper.files import table, write_experiment
from lpac.paper.report import EXACT_POINTS

_END = len(TIMES_S) - 1


def write_report(
    flown: Flown,
    results: Sequence[TimingResult],
    folder: Path,
    made_by: Mapping[str, str],
    how: str = EXACT_POINTS,
) -> None:
    """All of it; `how` says how it was flown, `made_by` what made it. Raises OSError."""
    style.save(_rates(flown, results), folder / "rates")
    if _late(results):
        style.save(_staleness(results), folder / "staleness")
    told, text = as_json(flown, results), _text(flown, results, how)
    write_experiment("async", told, _rows(flown, results), text, folder, how, made_by)


def _late(results: Sequence[TimingResult]) -> list[TimingResult]:
    """At the field's rates, over how late messages are; none if none were."""
    of_field = [r for r in results if r.timing._replace(delay_s=0.0) == FIELD]
    return of_field if len(of_field) > 1 else []


def _rows(flown: Flown, results: Sequence[TimingResult]) -> list[list[object]]:
    """A heading, and a row for each timing and world, or mission."""
    times = [f"cost_at_{time_s:g}_s" for time_s in TIMES_S]
    rows: list[list[object]] = [
        ["perception_hz", "policy_hz", "synchronous", "delay_s", "rounds_per_perception",
         "said_kb_s", "world", *times]
    ]  # fmt: skip
    for result in results:
        perception_hz, policy_hz, synchronous, delay_s = result.timing
        of_timing = [perception_hz, policy_hz, int(synchronous), delay_s, result.timing.rounds,
                     flown.said_kb_s(policy_hz)]  # fmt: skip
        its = zip(result.worlds, result.costs.tolist(), strict=True)
        rows += [[*of_timing, world, *costs] for world, costs in its]
    return rows


def _rates(flown: Flown, results: Sequence[TimingResult]) -> Figure:
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
                ylabel=f"cost at {TIMES_S[at]:g} s / with the field's rates",
            )
            tidy(axes)
            # What these rates ask of the radio.
            above = axes.twiny()
            above.set(xscale="log", xlim=axes.get_xlim(), xlabel="said by a robot, kB/s at most")
            said_kb_s = [flown.said_kb_s(hz) for hz in of_policy_hz]
            above.set_xticks(of_policy_hz, [f"{kb_s:.2g}" for kb_s in said_kb_s])
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
        for at, ((colour, _), time_s) in enumerate(zip(CURVES, TIMES_S, strict=False)):
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


def _text(flown: Flown, results: Sequence[TimingResult], how: str) -> str:
    dashed = (
        " Solid lines: each robot at its own moments; dashed: all robots in step."
        if _in_step(results)
        else ""
    )
    if flown.world_set is None:
        missions = "one mission" if flown.worlds == 1 else f"{flown.worlds} missions"
        over = f"{missions}, over whatever worlds and from wherever they began"
        intervals = "the missions of each rate drawn by themselves"
    else:
        first = "one world" if flown.worlds == 1 else f"the first {flown.worlds} worlds"
        over = f"{first} of the {flown.world_set} set, in the set-up of the field"
        intervals = "by worlds in pairs"
    headings = ["perception, Hz", "policy, Hz", "rounds per perception", "said, kB/s", "moments",
                "delay, s",
                *(f"cost at {time_s:g} s" for time_s in TIMES_S),
                "mean cost over the flight"]  # fmt: skip
    parts = [
        f"""# Rates and asynchrony

The paper runs perception, exchange of messages and control asynchronously, each at a rate of its
own, and argues both for an exchange slower than perception (a longer window to hear everybody in)
and for a faster one. It measures neither. Here the policy of bundle `{flown.bundle_id[:16]}`,
trained at the rates of the field alone (perception 5 Hz, policy 2.5 Hz), flies over {over}. {how}

![cost over the rates](rates.png)

*Cost over the policy's rate, relative to that at the field's rates and own moments: above 1 is
worse.{dashed} Bars are 95 % intervals of the ratio of means, {intervals}.*
""",
        f"""{table(headings, [_row(flown, result) for result in results])}

Cost over that at the start, and in brackets the 95 % interval of its ratio to the cost with the
field's timing, the first row (bootstrap, {intervals}; the ratio alone of a single one). A robot
speaks as often as its policy decides: *said* is what that asks of the radio, at most, since
messages are compressed.
""",
    ]
    if flown.world_set is not None:
        parts.append(
            """Messages, images and actions stay valid for two of their periods, or as long as in
the field if that is longer; late messages stay valid for longer, by as much as they may be late.
"""
        )
    if _late(results):
        parts.insert(
            1,
            """![cost over the delay of messages](staleness.png)

*The same policy at the rates of the field, with messages that are late: each by half to one and a
half times the mean delay. The cost is relative to that without delay.*
""",
        )
    return "\n".join(parts)


def _row(flown: Flown, result: TimingResult) -> list[str]:
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
        f"{flown.said_kb_s(timing.policy_hz):.2g}",
        "the same" if timing.synchronous else "own",
        f"{timing.delay_s:g}",
        *costs,
        f"{result.area.mean():.3f}",
    ]
