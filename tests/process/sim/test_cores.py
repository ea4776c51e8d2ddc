"""Tasks over processes, whatever becomes of these."""

import subprocess
import sys
from pathlib import Path

# As soon as there is a worker, it is killed: it has read nothing by then.
KILLED_AT_ONCE = """
import os, signal, sys, threading
from pathlib import Path
from lpac.sim.cores import over_processes

def workers():
    for children in Path("/proc/self/task").glob("*/children"):
        for pid in children.read_text().split():
            if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes():
                yield int(pid)

def kill():
    while not (found := list(workers())):
        pass
    os.kill(found[0], signal.SIGKILL)

if __name__ == "__main__":
    threading.Thread(target=kill, daemon=True).start()
    try:
        list(over_processes(len, [b"x" * 100_000] * 4, 2))
    except ChildProcessError as error:
        sys.exit(str(error))
"""

# Each time that a name of the pool has gone, and is not yet noted as gone.
INTERRUPTED_AS_IT_ENDS = """
import signal, sys
from multiprocessing import resource_tracker, synchronize
from lpac.sim.cores import over_processes

def clean_up(name):
    synchronize.sem_unlink(name)
    signal.raise_signal(signal.SIGINT)
    resource_tracker.unregister(name, "semaphore")

if __name__ == "__main__":
    synchronize.SemLock._cleanup = clean_up
    try:
        list(over_processes(len, [b"x"], 1))
    except KeyboardInterrupt:
        sys.exit("interrupted")
"""


def end_of(script: str, folder: Path) -> tuple[int, str]:
    """Exit code and stderr."""
    path = folder / "script.py"
    path.write_text(script)
    told = subprocess.run(
        [sys.executable, path], capture_output=True, text=True, timeout=60.0, check=False
    )
    return told.returncode, told.stderr


def test_ctrl_c_while_a_pool_ends_is_told_once_it_has(tmp_path: Path) -> None:
    assert end_of(INTERRUPTED_AS_IT_ENDS, tmp_path) == (1, "interrupted\n")


def test_a_worker_that_is_killed_before_it_has_its_tasks_ends_the_run(tmp_path: Path) -> None:
    assert end_of(KILLED_AT_ONCE, tmp_path) == (1, "a worker process was killed\n")
