"""Resources of a process: processor time by thread, number of threads, memory."""

import os
import re
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple


class Usage(NamedTuple):
    """Usage until now. `cpu_s` is by thread name without numbers; memory in MB, of this process."""

    cpu_s: Mapping[str, float]
    threads: int
    private_mb: float
    resident_mb: float


def usage(pid: int) -> Usage:
    """Measure a process of this machine. Raises OSError if it has ended."""
    cpu_s: defaultdict[str, float] = defaultdict(float)
    tasks = list(Path(f"/proc/{pid}/task").iterdir())
    for task in tasks:
        name, fields = (task / "comm").read_text(), (task / "stat").read_text()
        ticks = fields.rpartition(")")[2].split()[11:13]
        cpu_s[re.sub(r"-\d+$", "", name.strip())] += sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK")
    memory = dict(
        re.findall(r"^(\w+): +(\d+) kB$", Path(f"/proc/{pid}/smaps_rollup").read_text(), re.M)
    )
    private_kb = int(memory["Private_Clean"]) + int(memory["Private_Dirty"])
    return Usage(cpu_s, len(tasks), 1.024e-3 * private_kb, 1.024e-3 * int(memory["Rss"]))
