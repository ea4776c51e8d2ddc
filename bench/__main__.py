"""`python -m bench [NAME ...]`: measure, print tables, write out/bench/<name>.json."""

import os
import sys
from importlib import import_module

from bench import ROOT

# One process is one robot on one core. numpy reads these when it is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

BENCHES = (
    "policy",
    "footprint",
    "scaling",
    "simulated",
    "usual",
    "loops",
    "flood",
)


def main() -> None:
    """Run the named benches, or all."""
    names = sys.argv[1:] or BENCHES
    for name in names:
        if name not in BENCHES:
            sys.exit(f"bench: {name}: must be one of {', '.join(BENCHES)}")
    for name in names:
        report = import_module(f"bench.{name}").measure()
        report.show()
        report.write(ROOT / "out" / "bench")


if __name__ == "__main__":
    main()
