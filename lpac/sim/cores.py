"""Many tasks over all cores of this machine. A Ray cluster does the same: `lpac.sim.cluster`."""

import os
import pickle
import signal
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import active_children, get_context, parent_process, resource_tracker
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any, Protocol, TypeVar

Task = TypeVar("Task")
Outcome = TypeVar("Outcome")


class Pool(Protocol):
    """Run tasks in processes; outcomes come as they are done, in any order.

    `do` must be importable, tasks and outcomes must pickle. Close the generator to end the
    processes early.
    """

    def __call__(
        self, do: Callable[[Task], Outcome], tasks: Sequence[Task]
    ) -> Generator[Outcome, None, None]: ...


def in_this_process(
    do: Callable[[Task], Outcome], tasks: Sequence[Task]
) -> Generator[Outcome, None, None]:
    """A `Pool` without processes of its own: run the tasks here, in their order."""
    for task in tasks:
        yield do(task)


def over_cores(
    do: Callable[[Task], Outcome], tasks: Sequence[Task]
) -> Generator[Outcome, None, None]:
    """A `Pool` of one process for each core."""
    return over_processes(do, tasks, len(os.sched_getaffinity(0)))


def over_processes(
    do: Callable[[Task], Outcome], tasks: Sequence[Task], at_most: int
) -> Generator[Outcome, None, None]:
    """A pool of at most `at_most` processes.

    Raises ChildProcessError if one of them is killed.
    """
    # Workers read the tasks from a file: writing a large task to the pipe of a killed worker
    # would block forever.
    with NamedTemporaryFile(prefix="lpac-tasks-") as file:
        pickle.dump((do, tasks), file)
        file.flush()
        yield from _from_workers(min(len(tasks), at_most), len(tasks), file.name)


def _from_workers(workers: int, tasks: int, path: str) -> Generator[Any, None, None]:
    with _without_interrupts():
        # A fork would inherit threads that do not run there.
        pool = ProcessPoolExecutor(workers, get_context("spawn"), _begin, (path,))
    try:
        with _without_interrupts():
            given: list[Future[Any]] = [pool.submit(_do_nth, n) for n in range(tasks)]
        for done in as_completed(given):
            yield done.result()
    except BrokenProcessPool:
        raise ChildProcessError("a worker process was killed") from None
    except BaseException:
        # End the tasks that nobody waits for any more.
        with _without_interrupts():
            for worker in active_children():
                worker.terminate()
        raise
    finally:
        with _without_interrupts():
            pool.shutdown(cancel_futures=True)


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """Delay Ctrl-C to the end, and keep it from processes that start here.

    A worker that is interrupted, or loses its parent, while it begins prints a traceback. A pool
    whose shutdown is interrupted leaves workers that print one, and names of semaphores with
    multiprocessing's resource tracker, which warns of them after the program's last line.
    """
    # It unblocks the signal when it starts, so start it first.
    resource_tracker.ensure_running()
    in_main = threading.current_thread() is threading.main_thread()
    came: list[int] = []
    # Another thread may take the signal that this one blocks; Python's handler would still run.
    before = (
        signal.signal(signal.SIGINT, lambda number, _: came.append(number)) if in_main else None
    )
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        if in_main:
            signal.signal(signal.SIGINT, before)
    if came:
        signal.raise_signal(signal.SIGINT)


_given: tuple[Callable[[Any], Any], Sequence[Any]]


def _begin(path: str) -> None:
    """Load function and tasks in a new worker."""
    global _given  # noqa: PLW0603
    _obey_parent()
    with Path(path).open("rb") as file:
        _given = pickle.load(file)


def _do_nth(n: int) -> Any:
    do, tasks = _given
    return do(tasks[n])


def _obey_parent() -> None:
    """End with the parent process, and leave Ctrl-C to it."""
    # Not "ignored", which the programs that a worker starts would inherit.
    signal.signal(signal.SIGINT, lambda *_: None)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    parent = parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=wait, daemon=True).start()
