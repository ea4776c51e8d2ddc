"""Many tasks over all cores of this machine. A Ray cluster does the same: `lpac.sim.cluster`."""

import os
import signal
import threading
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import active_children, get_context, parent_process
from typing import Protocol, TypeVar

Task = TypeVar("Task")
Outcome = TypeVar("Outcome")


class Pool(Protocol):
    """Does the tasks in processes; outcomes come as they are done, in any order.

    What to do is a function that other processes can import; tasks and outcomes can be pickled.
    Who does not take all outcomes closes the generator: the processes end then.
    """

    def __call__(
        self, do: Callable[[Task], Outcome], tasks: Sequence[Task]
    ) -> Generator[Outcome, None, None]: ...


def over_cores(
    do: Callable[[Task], Outcome], tasks: Sequence[Task]
) -> Generator[Outcome, None, None]:
    """A `Pool` of a process for each core."""
    return over_processes(do, tasks, len(os.sched_getaffinity(0)))


def over_processes(
    do: Callable[[Task], Outcome], tasks: Sequence[Task], at_most: int
) -> Generator[Outcome, None, None]:
    """So many processes at most; outcomes as they come.

    Raises ChildProcessError if one of them is killed.
    """
    workers = min(len(tasks), at_most)
    # A fork would inherit threads that do not run there.
    with ProcessPoolExecutor(workers, get_context("spawn"), _end_with_parent) as pool:
        try:
            given = [pool.submit(do, task) for task in tasks]
            for done in as_completed(given):
                yield done.result()
        except BrokenProcessPool:
            pool.shutdown()
            raise ChildProcessError("a worker process was killed") from None
        except BaseException:
            # What nobody waits for ends now.
            for worker in active_children():
                worker.terminate()
            raise
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _end_with_parent() -> None:
    """A worker would wait for ever for a parent that was killed."""
    parent = parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=wait, daemon=True).start()
