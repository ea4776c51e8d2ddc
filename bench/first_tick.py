"""A robot's policy process, ours or torch's: prints a line after the first tick, one after twenty.

`python -m bench.first_tick edge|torch`; each imports only what that robot would.
"""

import json
import sys
from collections.abc import Callable
from pathlib import Path

from bench.report import BUNDLE, CHECKPOINT

TICKS = 20
_NEIGHBOURS = 10


def main() -> None:
    """Tick, and say so."""
    tick = {"edge": _edge, "torch": _torch}[sys.argv[1]]()
    tick()
    print("ticked", flush=True)
    for _ in range(TICKS - 1):
        tick()
    print(json.dumps(memory_mb()), flush=True)
