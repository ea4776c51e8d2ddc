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


def test_a_worker_that_is_killed_before_it_has_its_tasks_ends_the_run(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(KILLED_AT_ONCE)
    told = subprocess.run(
        [sys.executable, script], capture_output=True, text=True, timeout=60.0, check=False
    )
    assert (told.returncode, told.stderr) == (1, "a worker process was killed\n")
