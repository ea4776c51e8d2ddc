"""What this process holds in memory."""

import re
from pathlib import Path


def memory_mb() -> dict[str, float]:
    """Resident set size in MB, and the proportional set size where the kernel tells it."""
    sizes_mb = {"rss": _kilobytes("status", "VmRSS") / 1e3}
    if Path("/proc/self/smaps_rollup").exists():
        sizes_mb["pss"] = _kilobytes("smaps_rollup", "Pss") / 1e3
    return sizes_mb


def _kilobytes(file: str, key: str) -> float:
    text = Path(f"/proc/self/{file}").read_text()
    match = re.search(rf"^{key}:\s+(\d+) kB$", text, re.MULTILINE)
    assert match
    return 1.024 * int(match[1])
