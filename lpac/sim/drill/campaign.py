"""Many flights of many faults: over all cores or a Ray cluster; what was flown is kept on disk.

A campaign that was killed goes on where it was: each flight's outcome is a line of `flights.jsonl`,
below one that says what flew. Another version of the code, or another bundle, begins anew; and what
ended early is flown again.
"""

import hashlib
import json
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from functools import cache
from multiprocessing import active_children, get_context, parent_process
from pathlib import Path
from typing import Any, NamedTuple

import edge
import lpac
from edge.core import log
from edge.policy.bundle import load_bundle
from lpac.sim.drill.bounds import Figure, always, judge
from lpac.sim.drill.faults import FAULTS, Fault
from lpac.sim.drill.simulated import SimulatedDrill
from lpac.sim.drill.truth import FlightTruth

_FLIGHTS = "flights.jsonl"
# Two ticks of control that a robot left out in a flight, or as much of the vehicles' time.
LATE_S = 0.25


class FlightTask(NamedTuple):
    """One flight to be flown: all of it follows from this."""

    fault: str
    seed: int
    robots: int
    bundle: str


@dataclass(frozen=True, slots=True)
class FlightOutcome:
    """What came of one flight. `error` is what ended it early, such as a defect; else "".

    `late_s` is how far the machine was behind real time, if it was flown in that.
    """

    fault: str
    seed: int
    figures: tuple[Figure, ...]
    error: str = ""
    late_s: float = 0.0

    @property
    def broken(self) -> tuple[Figure, ...]:
        """The promises that did not hold."""
        return tuple(figure for figure in self.figures if figure.broken)

    @property
    def held(self) -> bool:
        """Whether all promises held."""
        return not self.error and not self.broken


Pool = Callable[[Sequence[FlightTask]], Iterator[FlightOutcome]]


def outcome_of(fault: Fault, seed: int, flown: Callable[[], FlightTruth]) -> FlightOutcome:
    """Fly and judge. What raises is an outcome, too: no other flight is lost for it.

    Limits are the same in real time. So what breaks one while the machine is late is not judged.
    """
    try:
        truth = flown()
        figures = judge((*always(fault.beyond_fence_m), *fault.bounds), truth)
    except Exception as error:
        return FlightOutcome(fault.name, seed, (), f"{type(error).__name__}: {error}")
    unjudged = ""
    if truth.late_s > LATE_S and any(figure.broken for figure in figures):
        broken = ", ".join(figure.name for figure in figures if figure.broken)
        unjudged = f"not judged ({broken}): this machine was {truth.late_s:.1f} s behind real time"
    return FlightOutcome(fault.name, seed, figures, unjudged, truth.late_s)


def fly_order(order: FlightTask) -> FlightOutcome:
    """One flight on the simulated clock, in whatever process this is."""
    fault, drill = FAULTS[order.fault], _drill(order.robots, order.bundle)
    return outcome_of(fault, order.seed, lambda: drill.fly(fault, order.seed))


@cache
def _drill(robots: int, bundle: str) -> SimulatedDrill:
    # Thousands of flights say more than anybody reads.
    log.listen(log.show_errors)
    return SimulatedDrill(robots, Path(bundle))


def over_cores(tasks: Sequence[FlightTask]) -> Iterator[FlightOutcome]:
    """A process for each core; outcomes as they come."""
    return over_processes(tasks, fly_order, len(os.sched_getaffinity(0)))


def over_processes(
    tasks: Sequence[FlightTask], fly: Callable[[FlightTask], FlightOutcome], at_most: int
) -> Iterator[FlightOutcome]:
    """So many processes at most that fly; outcomes as they come."""
    workers = min(len(tasks), at_most)
    # A fork would inherit threads that do not run there.
    with ProcessPoolExecutor(workers, get_context("spawn"), _end_with_parent) as pool:
        flights = [pool.submit(fly, task) for task in tasks]
        try:
            for flight in as_completed(flights):
                yield flight.result()
        except BaseException:
            # Flights that nobody waits for end now.
            for worker in active_children():
                worker.terminate()
            raise
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _end_with_parent() -> None:
    """A worker would wait for ever for a campaign that was killed."""
    parent = parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=wait, daemon=True).start()


class Campaign:
    """The flights of one set-up, whose outcomes are in `folder`."""

    def __init__(self, folder: Path, vehicle: str, robots: int, bundle: Path) -> None:
        """Raises BundleError, OSError."""
        folder.mkdir(parents=True, exist_ok=True)
        self._path = folder / _FLIGHTS
        self._robots, self._bundle = robots, str(bundle.resolve())
        self._flown_by = {
            "vehicle": vehicle, "robots": robots, "bundle": load_bundle(bundle).id,
            "code": code_digest(),
        }  # fmt: skip
        self.outcomes: dict[tuple[str, int], FlightOutcome] = self._kept()

    def fly(
        self, faults: Iterable[Fault], seeds: Iterable[int], pool: Pool
    ) -> Iterator[FlightOutcome]:
        """Fly what was not flown yet, and give all outcomes asked for: first those that were."""
        faults = list(faults)
        # Flights of a seed, and of the same settings, share their begin.
        wanted = [
            (fault, seed)
            for seed in seeds
            for fault in sorted(faults, key=lambda fault: (fault.exact, fault.settings))
        ]
        flown = [key for fault, seed in wanted if (key := (fault.name, seed)) in self.outcomes]
        yield from (self.outcomes[key] for key in flown)
        orders = [
            FlightTask(fault.name, seed, self._robots, self._bundle)
            for fault, seed in wanted
            if (fault.name, seed) not in self.outcomes
        ]
        if not orders:
            return
        with self._path.open("a") as kept:
            for outcome in pool(orders):
                self.outcomes[outcome.fault, outcome.seed] = outcome
                kept.write(json.dumps(asdict(outcome)) + "\n")
                kept.flush()
                yield outcome

    def _kept(self) -> dict[tuple[str, int], FlightOutcome]:
        if self._path.exists():
            first, *lines = self._path.read_text().splitlines() or [""]
            if _parsed(first) == self._flown_by:
                outcomes = [_outcome(line) for line in lines]
                return {(o.fault, o.seed): o for o in outcomes if o is not None and not o.error}
        self._path.write_text(json.dumps(self._flown_by) + "\n")
        return {}


@cache
def code_digest() -> str:
    """Of all that flies and judges: the sources of `edge` and `lpac`."""
    digest = hashlib.sha256()
    for package in (edge, lpac):
        root = Path(package.__path__[0])
        for path in sorted(root.rglob("*.py")):
            digest.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def _parsed(line: str) -> Any:
    try:
        return json.loads(line)
    except ValueError:
        # Killed while it was written.
        return None


def _outcome(line: str) -> FlightOutcome | None:
    read: Mapping[str, Any] | None = _parsed(line)
    if read is None:
        return None
    figures = tuple(Figure(*figure) for figure in read["figures"])
    return FlightOutcome(**{**read, "figures": figures})
