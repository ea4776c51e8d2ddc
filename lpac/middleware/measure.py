"""Makes the runs: fleets of programs, a bulk stream between the first two places, and counts.

Middlewares alternate run by run, so that slow drifts affect all of them equally.
"""

import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import NamedTuple, Self

from lpac.middleware.kinds import NOTHING
from lpac.middleware.places import NetworkPlace, Notifier, Program
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

# Ends of the stream. A fleet of one also has a second place, without a program.
STREAM_PLACES = 2
# Period of restarts, and the time after each in which messages count.
RESTART_EVERY_S, AFTER_S = 15.0, 10.0
# In a short run, the last part of its only round does not count: messages could not arrive in time.
_COUNTED_PART = 0.8
_READY_WITHIN_S, _ACQUAINTED_WITHIN_S = 120.0, 20.0
# TCP settles at its rate first, which would lower the result of a short run.
_STREAM_BEGINS_S = 1.0
# Messages in transit may still arrive.
_ARRIVES_WITHIN_S = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """The runs of one experiment: each middleware and number of robots, `repetitions` times."""

    experiment: Experiment
    middlewares: tuple[str, ...]
    robots: tuple[int, ...]
    repetitions: int
    seconds: float

    @property
    def places(self) -> int:
        """Number of places needed."""
        return max(STREAM_PLACES, *self.robots)

    def runs(self) -> Iterator[tuple[int, int, str]]:
        """Repetition, robots and middleware of each run, in order."""
        for repetition in range(1, self.repetitions + 1):
            for robots in self.robots:
                for middleware in self.middlewares:
                    yield repetition, robots, middleware


class _Count(NamedTuple):
    received: int
    at_s: float


@dataclass(slots=True)
class _Robot:
    """The program at one place, and its messages since the last stop."""

    program: Program
    sent: list[Sent] = field(default_factory=list)
    received: list[Reception] = field(default_factory=list)


class MiddlewareFleet:
    """A robot at each place; a context manager that ends its processes.

    `lpac.middleware.robot` describes the lines exchanged with them.
    """

    def __init__(self, places: Sequence[NetworkPlace]) -> None:
        self._notifier = Notifier()
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
        """Load from disk before measuring. Raises OSError."""
        self._ask_all(len(self._robots), "load", middleware)

    def start(self, middleware: str, robots: int, start: int) -> None:
        """Start or restart the programs of the first `robots` robots. Raises OSError."""
        for robot in self._robots[:robots]:
            robot.program.send("start", middleware, robots, start)

    def meet(self, robots: int, start: int) -> bool:
        """Wait until all programs have met; False after a timeout. Raises OSError."""
        pairs = robots * (robots - 1)

        def met() -> bool:
            self.check()
            with self._lock:
                return pairs == len(
                    {
                        (message.robot, message.by)
                        for robot in self._robots
                        for message in robot.received
                        if message.start == message.by_start == start
                    }
                )

        return self._notifier.wait(met, _ACQUAINTED_WITHIN_S)

    def stop(self, robots: int) -> tuple[list[Sent], list[Reception]]:
        """End the programs and return all messages. Raises OSError."""
        self._ask_all(robots, "stop")
        sent: list[Sent] = []
        received: list[Reception] = []
        with self._lock:
            for robot in self._robots:
                sent += robot.sent
                received += robot.received
                robot.sent.clear()
                robot.received.clear()
        return sent, received

    def check(self) -> None:
        """Raise OSError if a program has failed."""
        for robot in self._robots:
            robot.program.check()

    def _program(self, index: int, place: NetworkPlace, endpoints: Sequence[str]) -> Program:
        def on_line(line: str) -> None:
            word, *numbers = line.split()
            values = [int(number) for number in numbers]
            with self._lock:
                if word == "sent":
                    start, sequence, at_ns = values
                    robot.sent.append(Sent(index, start, sequence, 1e-9 * at_ns))
                elif word == "received":
                    by_start, other, start, sequence, sent_ns, at_ns = values
                    times_s = 1e-9 * sent_ns, 1e-9 * at_ns
                    robot.received.append(
                        Reception(index, by_start, other, start, sequence, *times_s)
                    )
                else:
                    self._answers += 1

        command = ("lpac.middleware.robot", str(index), *endpoints)
        robot = _Robot(Program(place, self._notifier, on_line, *command))
        self._robots.append(robot)
        return robot.program

    def _ask_all(self, robots: int, *words: object) -> None:
        """Send a command and wait for the answers. Raises OSError after a timeout."""
        with self._lock:
            self._answers = 0
        for robot in self._robots[:robots]:
            robot.program.send(*words)

        def answered() -> bool:
            self.check()
            return self._answers >= robots

        if not self._notifier.wait(answered, _READY_WITHIN_S):
            raise OSError(
                f"no answer to {words[0]} from {robots - self._answers} of {robots} robots' "
                "programs: this machine may be too slow for so many"
            )


class Stream:
    """A TCP stream at full rate; a context manager that ends its processes."""

    def __init__(self, sender: NetworkPlace, receiver: NetworkPlace) -> None:
        """Raises OSError if the sender does not reach the receiver."""
        self._notifier = Notifier()
        self._port: int | None = None
        self._counts: list[_Count] = []
        with ExitStack() as stack:
            module = "lpac.middleware.stream"
            self._receiver = stack.enter_context(
                Program(
                    receiver, self._notifier, self._on_line, module, "receive", receiver.address
                )
            )
            self._wait(self._receiver, lambda: self._port is not None)
            address = receiver.address, str(self._port)
            self._sender = stack.enter_context(
                Program(sender, self._notifier, self._on_line, module, "send", *address)
            )
            while not self.count().received:
                time.sleep(0.05)
            self._stack = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def count(self) -> _Count:
        """Bytes received until now. Raises OSError if the stream has broken."""
        asked = len(self._counts) + 1
        self._receiver.send("count")
        self._wait(self._receiver, lambda: len(self._counts) >= asked)
        self._sender.check()
        return self._counts[-1]

    def _wait(self, program: Program, until: Callable[[], bool]) -> None:
        def checked() -> bool:
            program.check()
            return until()

        if not self._notifier.wait(checked, _READY_WITHIN_S):
            raise OSError("the bulk stream's program does not answer")

    def _on_line(self, line: str) -> None:
        match line.split():
            case ["listening", port]:
                self._port = int(port)
            case ["received", count, at_ns]:
                self._counts.append(_Count(int(count), 1e-9 * int(at_ns)))


def measure(
    plan: Plan, places: Sequence[NetworkPlace], report: Callable[[int, int, str], None]
) -> Generator[Run, None, None]:
    """Yield each run; `report` is called before each. Close the generator to stop early.

    Raises OSError, one line, if a program fails.
    """
    with MiddlewareFleet(places[: plan.places]) as fleet:
        for middleware in plan.middlewares:
            if middleware != NOTHING:
                fleet.load(middleware)
        for repetition, robots, middleware in plan.runs():
            report(repetition, robots, middleware)
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
    fields: dict[str, float | None] = {}
    if speaks:
        time.sleep(_ARRIVES_WITHIN_S)
        sent, received = fleet.stop(robots)
        fields = of_traffic(traffic(sent, received, windows, robots), restarted=restarted)
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
        **fields,
    )


def _rounds(plan: Plan) -> Iterator[tuple[int, float]]:
    """Start number of the programs in each round, and its duration in s."""
    if plan.experiment == "robots":
        yield 0, plan.seconds
        return
    rounds = max(1, round(plan.seconds / RESTART_EVERY_S))
    for number in range(1, rounds + 1):
        yield number, plan.seconds / rounds


class _ProcessorUse:
    """Share of this machine's processors that is in use, since construction."""

    def __init__(self) -> None:
        self._before = _jiffies()

    def share(self) -> float:
        idle, total = (now - then for now, then in zip(_jiffies(), self._before, strict=True))
        return 1.0 - idle / max(total, 1)


def _jiffies() -> tuple[int, int]:
    """Idle and total jiffies of all processors."""
    words = Path("/proc/stat").read_text().partition("\n")[0].split()
    counts = [int(word) for word in words[1:9]]
    return counts[3] + counts[4], sum(counts)
