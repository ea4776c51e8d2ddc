"""The runs: fleets of programs, a bulk stream between the first two places, and what is counted.

Middlewares take turns, run by run, so that whatever drifts meanwhile drifts for all of them.
"""

import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import NamedTuple, Self

from lpac.middleware.kinds import NOTHING
from lpac.middleware.places import NetworkPlace, News, Program
from lpac.middleware.results import (
    CountedTime,
    Experiment,
    Reception,
    Run,
    Sent,
    of_traffic,
    traffic,
)
from lpac.sim.ports import free_ports

# The ends of the stream; a fleet of one has a second place, too, where no program runs.
STREAM_PLACES = 2
# How often all programs restart, and for how long then each message counts that arrives or not.
RESTART_EVERY_S, AFTER_S = 15.0, 10.0
# Of a short run's only round the last part is no window: what is said there could not arrive.
_COUNTED_PART = 0.8
_READY_WITHIN_S, _ACQUAINTED_WITHIN_S = 120.0, 20.0
# TCP has found its rate, which a short run would count as slowness.
_STREAM_BEGINS_S = 1.0
# What is on its way may arrive.
_ARRIVES_WITHIN_S = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """One experiment's runs: each middleware with each number of robots, so often."""

    experiment: Experiment
    middlewares: tuple[str, ...]
    robots: tuple[int, ...]
    repetitions: int
    seconds: float

    @property
    def places(self) -> int:
        """How many it needs."""
        return max(STREAM_PLACES, *self.robots)

    def runs(self) -> Iterator[tuple[int, int, str]]:
        """Repetition, robots, middleware, in the order in which they are made."""
        for repetition in range(1, self.repetitions + 1):
            for robots in self.robots:
                for middleware in self.middlewares:
                    yield repetition, robots, middleware


class _Count(NamedTuple):
    received: int
    at_s: float


@dataclass(slots=True)
class _Robot:
    """One place's, and what it has said since it was last asked."""

    program: Program
    sent: list[Sent] = field(default_factory=list)
    heard: list[Reception] = field(default_factory=list)


class MiddlewareFleet:
    """A robot at each place. A context; its processes end with it.

    What robots are told, and what they say, is in `lpac.middleware.robot`.
    """

    def __init__(self, places: Sequence[NetworkPlace]) -> None:
        self._news = News()
        self._lock = Lock()
        self._answers = 0
        self._robots: list[_Robot] = []
        ports = free_ports(len(places))
        endpoints = [f"{s.address}:{port}" for s, port in zip(places, ports, strict=True)]
        with ExitStack() as stack:
            for index, place in enumerate(places):
                stack.enter_context(self._program(index, place, endpoints))
            self._stack = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for robot in self._robots:
            robot.program.leave()
        self._stack.close()

    def load(self, middleware: str) -> None:
        """Before anything is measured: what programs need is read from the disk. Raises OSError."""
        self._ask_all(len(self._robots), "load", middleware)

    def start(self, middleware: str, robots: int, start: int) -> None:
        """Start, or restart, the programs of the first so many. Raises OSError."""
        for robot in self._robots[:robots]:
            robot.program.tell("start", middleware, robots, start)

    def meet(self, robots: int, start: int) -> bool:
        """Wait until all of that start have heard each other: whether they have. Raises OSError."""
        pairs = robots * (robots - 1)

        def met() -> bool:
            self.check()
            with self._lock:
                return pairs == len(
                    {
                        (message.robot, message.by)
                        for robot in self._robots
                        for message in robot.heard
                        if message.start == message.by_start == start
                    }
                )

        return self._news.wait(met, _ACQUAINTED_WITHIN_S)

    def stop(self, robots: int) -> tuple[list[Sent], list[Reception]]:
        """End their programs, and give all that was said. Raises OSError."""
        self._ask_all(robots, "stop")
        sent: list[Sent] = []
        heard: list[Reception] = []
        with self._lock:
            for robot in self._robots:
                sent += robot.sent
                heard += robot.heard
                robot.sent.clear()
                robot.heard.clear()
        return sent, heard

    def check(self) -> None:
        """Raises OSError if a program has failed."""
        for robot in self._robots:
            robot.program.check()

    def _program(self, index: int, place: NetworkPlace, endpoints: Sequence[str]) -> Program:
        def hear(line: str) -> None:
            word, *numbers = line.split()
            values = [int(number) for number in numbers]
            with self._lock:
                if word == "sent":
                    start, sequence, at_ns = values
                    robot.sent.append(Sent(index, start, sequence, 1e-9 * at_ns))
                elif word == "heard":
                    by_start, other, start, sequence, sent_ns, at_ns = values
                    times_s = 1e-9 * sent_ns, 1e-9 * at_ns
                    robot.heard.append(Reception(index, by_start, other, start, sequence, *times_s))
                else:
                    self._answers += 1

        command = ("lpac.middleware.robot", str(index), *endpoints)
        robot = _Robot(Program(place, self._news, hear, *command))
        self._robots.append(robot)
        return robot.program

    def _ask_all(self, robots: int, *words: object) -> None:
        """Raises OSError if not all have answered within a long time."""
        with self._lock:
            self._answers = 0
        for robot in self._robots[:robots]:
            robot.program.tell(*words)

        def answered() -> bool:
            self.check()
            return self._answers >= robots

        if not self._news.wait(answered, _READY_WITHIN_S):
            raise OSError(
                f"{robots - self._answers} of {robots} robots' programs do not answer to "
                f"{words[0]}: does this machine carry so many?"
            )


class Stream:
    """As much as TCP carries from one place to another. A context; its processes end with it."""

    def __init__(self, sender: NetworkPlace, receiver: NetworkPlace) -> None:
        """Raises OSError if the one does not reach the other."""
        self._news = News()
        self._port: int | None = None
        self._counts: list[_Count] = []
        with ExitStack() as stack:
            module = "lpac.middleware.stream"
            self._receiver = stack.enter_context(
                Program(receiver, self._news, self._hear, module, "receive", receiver.address)
            )
            self._wait(self._receiver, lambda: self._port is not None)
            address = receiver.address, str(self._port)
            self._sender = stack.enter_context(
                Program(sender, self._news, self._hear, module, "send", *address)
            )
            while not self.count().received:
                time.sleep(0.05)
            self._stack = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def count(self) -> _Count:
        """All bytes so far. Raises OSError if the stream has broken."""
        asked = len(self._counts) + 1
        self._receiver.tell("count")
        self._wait(self._receiver, lambda: len(self._counts) >= asked)
        self._sender.check()
        return self._counts[-1]

    def _wait(self, program: Program, until: Callable[[], bool]) -> None:
        def checked() -> bool:
            program.check()
            return until()

        if not self._news.wait(checked, _READY_WITHIN_S):
            raise OSError("the bulk stream's program does not answer")

    def _hear(self, line: str) -> None:
        match line.split():
            case ["listening", port]:
                self._port = int(port)
            case ["received", count, at_ns]:
                self._counts.append(_Count(int(count), 1e-9 * int(at_ns)))


def measure(
    plan: Plan, places: Sequence[NetworkPlace], tell: Callable[[int, int, str], None]
) -> Generator[Run, None, None]:
    """Each run as it is made; `tell` hears of each before. Who does not take all of them closes it.

    Raises OSError, one line, if a program fails.
    """
    with MiddlewareFleet(places[: plan.places]) as fleet:
        for middleware in plan.middlewares:
            if middleware != NOTHING:
                fleet.load(middleware)
        for repetition, robots, middleware in plan.runs():
            tell(repetition, robots, middleware)
            yield _run(plan, fleet, places, repetition, robots, middleware)


def _run(
    plan: Plan,
    fleet: MiddlewareFleet,
    places: Sequence[NetworkPlace],
    repetition: int,
    robots: int,
    middleware: str,
) -> Run:
    speaks = middleware != NOTHING
    restarted = plan.experiment == "restarts"
    met = True
    if speaks:
        fleet.start(middleware, robots, 0)
        met = fleet.meet(robots, 0)
    with Stream(*places[:STREAM_PLACES]) as stream:
        time.sleep(_STREAM_BEGINS_S)
        began, used = time.time(), _ProcessorUse()
        first = stream.count()
        windows: list[CountedTime] = []
        for start, lasts_s in _rounds(plan):
            from_s = time.monotonic()
            counted_s = lasts_s
            if restarted:
                counted_s = min(AFTER_S, _COUNTED_PART * lasts_s)
                if speaks:
                    fleet.start(middleware, robots, start)
            windows.append(CountedTime(start, from_s, from_s + counted_s))
            time.sleep(max(0.0, from_s + lasts_s - time.monotonic()))
            fleet.check()
        last = stream.count()
        processor = used.share()
    told: dict[str, float | None] = {}
    if speaks:
        time.sleep(_ARRIVES_WITHIN_S)
        sent, heard = fleet.stop(robots)
        told = of_traffic(traffic(sent, heard, windows, robots), restarted=restarted)
    return Run(
        experiment=plan.experiment,
        middleware=middleware,
        robots=robots,
        repetition=repetition,
        began=began,
        seconds=last.at_s - first.at_s,
        throughput_mbit_s=8e-6 * (last.received - first.received) / (last.at_s - first.at_s),
        processor=processor,
        met=met,
        **told,
    )


def _rounds(plan: Plan) -> Iterator[tuple[int, float]]:
    """The start of which programs are heard meanwhile, and how long, s."""
    if plan.experiment == "robots":
        yield 0, plan.seconds
        return
    rounds = max(1, round(plan.seconds / RESTART_EVERY_S))
    for number in range(1, rounds + 1):
        yield number, plan.seconds / rounds


class _ProcessorUse:
    """The share of this machine's processors that is in use, from now on."""

    def __init__(self) -> None:
        self._before = _jiffies()

    def share(self) -> float:
        idle, total = (now - then for now, then in zip(_jiffies(), self._before, strict=True))
        return 1.0 - idle / max(total, 1)


def _jiffies() -> tuple[int, int]:
    """Idle ones, and all."""
    words = Path("/proc/stat").read_text().partition("\n")[0].split()
    counts = [int(word) for word in words[1:9]]
    return counts[3] + counts[4], sum(counts)
