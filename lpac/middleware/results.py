"""Results of runs: messages sent and received, and summaries of equal runs. Pure functions."""

import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

Experiment = Literal["restarts", "robots"]
EXPERIMENTS: tuple[Experiment, ...] = ("restarts", "robots")


class Sent(NamedTuple):
    """A message of a robot's program number `start`."""

    robot: int
    start: int
    sequence: int
    at_s: float


class Reception(NamedTuple):
    """Reception of such a message by program number `by_start` of robot `by`."""

    by: int
    by_start: int
    robot: int
    start: int
    sequence: int
    sent_s: float
    at_s: float


class CountedTime(NamedTuple):
    """A time in which messages of programs with number `start` count."""

    start: int
    from_s: float
    to_s: float


@dataclass(frozen=True, slots=True)
class Delivery:
    """Deliveries of the messages that count.

    `delivered` is the share that arrived, where each message counts once per other robot. `ages_s`
    are ages on arrival. `heard_s` has, for each window and pair of robots, the time from the
    window's begin to the first reception, None if there was none.
    """

    delivered: float | None
    ages_s: tuple[float, ...]
    heard_s: tuple[float | None, ...]


def traffic(
    sent: Iterable[Sent], received: Iterable[Reception], windows: Sequence[CountedTime], robots: int
) -> Delivery:
    """Evaluate the messages between programs of the same start."""
    by_start = {window.start: window for window in windows}

    def counts(start: int, at_s: float) -> bool:
        window = by_start.get(start)
        return window is not None and window.from_s <= at_s <= window.to_s

    expected = (robots - 1) * sum(counts(message.start, message.at_s) for message in sent)
    first: dict[tuple[int, int, int], float] = {}
    ages_s = []
    for message in received:
        if message.by_start != message.start or message.start not in by_start:
            continue
        pair = (message.start, message.robot, message.by)
        first[pair] = min(first.get(pair, message.at_s), message.at_s)
        if counts(message.start, message.sent_s):
            ages_s.append(message.at_s - message.sent_s)
    heard_s = [
        first[pair] - window.from_s if (pair := (window.start, robot, by)) in first else None
        for window in windows
        for robot in range(robots)
        for by in range(robots)
        if robot != by
    ]
    delivered = len(ages_s) / expected if expected else None
    return Delivery(delivered, tuple(ages_s), tuple(heard_s))


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """One measurement.

    `middleware` is "nothing" for robots without programs; fields about messages are None then.
    `began` is Unix time in s. `delivered` is a share; in runs with restarts, of the messages after
    a restart. `age_…_ms` are ages of delivered messages. `heard_again_…_s` are over all pairs of
    robots and all restarts; `never_heard` is the share of pairs without a reception before the next
    restart. `processor` is the used share of this machine's processors. `met` is whether all robots
    had received from each other before the run; if not, messages between those pairs count as lost.
    """

    experiment: Experiment
    middleware: str
    robots: int
    repetition: int
    began: float
    seconds: float
    throughput_mbit_s: float
    processor: float
    met: bool
    delivered: float | None = None
    age_p50_ms: float | None = None
    age_p99_ms: float | None = None
    heard_again_p50_s: float | None = None
    heard_again_max_s: float | None = None
    never_heard: float | None = None


MEASURES = (
    "throughput_mbit_s", "processor", "delivered", "age_p50_ms", "age_p99_ms",
    "heard_again_p50_s", "heard_again_max_s", "never_heard",
)  # fmt: skip


def of_traffic(delivery: Delivery, *, restarted: bool) -> dict[str, float | None]:
    """Fields of a `Run` about messages."""
    fields: dict[str, float | None] = {"delivered": delivery.delivered}
    if delivery.ages_s:
        p50_s, p99_s = np.quantile(delivery.ages_s, (0.5, 0.99)).tolist()
        fields |= {"age_p50_ms": 1e3 * p50_s, "age_p99_ms": 1e3 * p99_s}
    if restarted and delivery.heard_s:
        times_s = [time_s for time_s in delivery.heard_s if time_s is not None]
        fields["never_heard"] = 1.0 - len(times_s) / len(delivery.heard_s)
        if times_s:
            fields["heard_again_p50_s"] = statistics.median(times_s)
            fields["heard_again_max_s"] = max(times_s)
    return fields


class Spread(NamedTuple):
    """Mean and standard deviation of several runs; the deviation of a single run is None."""

    mean: float
    deviation: float | None
    runs: int


@dataclass(frozen=True, slots=True)
class Summary:
    """Runs with one middleware and number of robots; measures without values are left out."""

    experiment: Experiment
    middleware: str
    robots: int
    measures: Mapping[str, Spread]


def summaries(runs: Sequence[Run]) -> list[Summary]:
    """Summaries of the runs with `met`, in the order of their first runs."""
    counted = [run for run in runs if run.met]
    kinds = dict.fromkeys((run.experiment, run.middleware, run.robots) for run in counted)
    found = []
    for kind in kinds:
        same = [run for run in counted if (run.experiment, run.middleware, run.robots) == kind]
        measures = {}
        for measure in MEASURES:
            values = [value for run in same if (value := getattr(run, measure)) is not None]
            if values:
                deviation = statistics.stdev(values) if len(values) > 1 else None
                measures[measure] = Spread(statistics.mean(values), deviation, len(values))
        found.append(Summary(*kind, measures))
    return found


def left_out(runs: Sequence[Run]) -> str:
    """Number of runs left out of the summaries, and why; "" if there are none."""
    unmet = sum(not run.met for run in runs)
    if not unmet:
        return ""
    return (
        f"left out: {unmet} of {len(runs)} runs that began before all robots had heard each other"
    )


def as_json(measured_on: Mapping[str, Any], runs: Sequence[Run]) -> dict[str, Any]:
    """All results, for scripts."""
    return {
        "measured_on": dict(measured_on),
        "summaries": [
            {
                "experiment": summary.experiment,
                "middleware": summary.middleware,
                "robots": summary.robots,
                **{name: spread._asdict() for name, spread in summary.measures.items()},
            }
            for summary in summaries(runs)
        ],
        "runs": [asdict(run) for run in runs],
    }
