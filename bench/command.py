"""How long a person waits for `lpac` to say something, beside Python's own start."""

import subprocess
import sys
from time import perf_counter

from bench import ROOT
from bench.report import Report, Table, Target, progress
from bench.timing import quartiles, with_quartiles

_LPAC = [sys.executable, "-P", "-m", "lpac.cli.main"]
_COMMANDS = {
    "python -c pass": [sys.executable, "-c", "pass"],
    "lpac --help": [*_LPAC, "--help"],
    "lpac --version": [*_LPAC, "--version"],
    "lpac sim --help": [*_LPAC, "sim", "--help"],
    "lpac fleet --help": [*_LPAC, "fleet", "--help"],
}


def measure(runs: int = 10) -> Report:
    """Processes of their own, in turn; one of each before, so that files come from the cache."""
    times_s: dict[str, list[float]] = {name: [] for name in _COMMANDS}
    for run in range(runs + 1):
        progress(f"command: {f'run {run} of {runs}' if run else 'warm-up'}")
        for name, command in _COMMANDS.items():
            began_s = perf_counter()
            subprocess.run(command, cwd=ROOT, stdout=subprocess.DEVNULL, check=True)
            if run:
                times_s[name].append(perf_counter() - began_s)
    figures = {name: quartiles(times) for name, times in times_s.items()}
    rows = [(name, with_quartiles(figure, 3)) for name, figure in figures.items()]
    return Report(
        "command",
        figures,
        [Table("From Enter to the prompt", ("", "s"), rows)],
        [Target("lpac --help, s", figures["lpac --help"]["median"], 0.3, False)],
    )
