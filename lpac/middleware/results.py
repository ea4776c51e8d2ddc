"""Results of runs: messages sent and heard, and summaries of runs of one kind. Pure."""

import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

Experiment = Literal["restarts", "robots"]
EXPERIMENTS: tuple[Experiment, ...] = ("restarts", "robots")


class Sent(NamedTuple):
    """One message of a robot's `start`th program."""

    robot: int
    start: int
    sequence: int
    at_s: float


class Reception(NamedTuple):
    """That message as another robot's `by_start`th program heard it."""

    by: int
    by_start: int
    robot: int
    start: int
    sequence: int
    sent_s: float
    at_s: float


class CountedTime(NamedTuple):
    """Messages that programs of that start, the fleet's, sent within a time."""

    start: int
    from_s: float
    to_s: float


@dataclass(frozen=True, slots=True)
class Delivery:
    """Fate of messages.

    `delivered` is the share that arrived, of one for each other robot; `ages_s` how old each was
    when it did. `heard_s` has for each window and pair of robots how long after the window began
    the one first heard the other, None if it never did.
    """

    delivered: float | None
    ages_s: tuple[float, ...]
    heard_s: tuple[float | None, ...]


def traffic(
    sent: Iterable[Sent], heard: Iterable[Reception], windows: Sequence[CountedTime], robots: int
) -> Delivery:
    """Of programs that were started together, and of those alone."""
    by_start = {window.start: window for window in windows}

    def counts(start: int, at_s: float) -> bool:
        window = by_start.get(start)
        return window is not None and window.from_s <= at_s <= window.to_s

    expected = (robots - 1) * sum(counts(message.start, message.at_s) for message in sent)
    first: dict[tuple[int, int, int], float] = {}
    ages_s = []
    for message in heard:
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
    """One measurement: so many robots, and so many s of the bulk stream.

    `middleware` is "nothing" where robots have no programs; what tells of messages is None then.
    `began` is in s since 1970. `delivered` is a share, after restarts if the run has some, and
    `age_…_ms` are of what was delivered. `heard_again_…_s` are over all pairs of robots and all
    restarts; `never_heard` is the share of the pairs that had not heard each other when the next
    restart came. `processor` is the share of this machine's processors that was in use. `met` tells
    whether all robots had heard each other before the run began: what they say to those that they
    have not met counts as lost.
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


def of_traffic(told: Delivery, *, restarted: bool) -> dict[str, float | None]:
    """The fields of a `Run` that tell of messages."""
    fields: dict[str, float | None] = {"delivered": told.delivered}
    if told.ages_s:
        p50_s, p99_s = np.quantile(told.ages_s, (0.5, 0.99)).tolist()
        fields |= {"age_p50_ms": 1e3 * p50_s, "age_p99_ms": 1e3 * p99_s}
    if restarted and told.heard_s:
        times_s = [time_s for time_s in told.heard_s if time_s is not None]
        fields["never_heard"] = 1.0 - len(times_s) / len(told.heard_s)
        if times_s:
            fields["heard_again_p50_s"] = statistics.median(times_s)
            fields["heard_again_max_s"] = max(times_s)
    return fields


class Spread(NamedTuple):
    """Of several runs: the mean, and the standard deviation, None of a single one."""

    mean: float
    deviation: float | None
    runs: int


@dataclass(frozen=True, slots=True)
class Summary:
    """Runs with one middleware and so many robots; a measure that no run has is not in it."""

    experiment: Experiment
    middleware: str
    robots: int
    measures: Mapping[str, Spread]


def summaries(runs: Sequence[Run]) -> list[Summary]:
    """Of those in which robots had met, in the order of their first runs."""
    counted = [run for run in runs if run.met]
    kinds = dict.fromkeys((run.experiment, run.middleware, run.robots) for run in counted)
    told = []
    for kind in kinds:
        its = [run for run in counted if (run.experiment, run.middleware, run.robots) == kind]
        measures = {}
        for measure in MEASURES:
            values = [value for run in its if (value := getattr(run, measure)) is not None]
            if values:
                deviation = statistics.stdev(values) if len(values) > 1 else None
                measures[measure] = Spread(statistics.mean(values), deviation, len(values))
        told.append(Summary(*kind, measures))
    return told


def left_out(runs: Sequence[Run]) -> str:
    """How many runs the summaries leave out, and why; "" if none."""
    unmet = sum(not run.met for run in runs)
    if not unmet:
        return ""
    return (
        f"left out: {unmet} of {len(runs)} runs, before which robots had not all heard each other"
    )


def as_json(measured_on: Mapping[str, Any], runs: Sequence[Run]) -> dict[str, Any]:
    """All of it, for other programs."""
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
