"""What a robot's policy process tells `footprint` about itself, ours and torch's alike."""

import json
import os
from collections.abc import Callable

from bench.usage import usage

TICKED = "ticked\n"
TICKS = 20

# Mission frame, m; the neighbours are all in range.
POSITION_M = (16.0, 16.0, 0.0)
NEIGHBOURS_M = tuple((10.0 + i, 12.0, 0.0) for i in range(10))
ENV_SCALE = 16.0


def run(tick: Callable[[], object]) -> None:
    """Print TICKED after the first tick, and the memory, as JSON, after TICKS."""
    tick()
    print(TICKED, end="", flush=True)
    for _ in range(TICKS - 1):
        tick()
    taken = usage(os.getpid())
    print(json.dumps({"rss": taken.resident_mb, "private": taken.private_mb}), flush=True)
