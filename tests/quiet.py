"""Tell whether this machine is quiet enough for robots that fly in real time.

`python -m tests.quiet` ends with one line and exit code 1 if it is not.
"""

import subprocess
import sys

# Flights and their vehicles keep up as long as two processes get most of a core each.
CORES = 2
LEAST_SHARE = 0.6
# Programs that just ended may still be cleaning up.
TRIES = 10

_BUSY_LOOP = """
import time
began_s, began_cpu_s = time.monotonic(), time.process_time()
while time.monotonic() < began_s + 1.0:
    pass
print((time.process_time() - began_cpu_s) / (time.monotonic() - began_s))
"""


def processor_share() -> float:
    """Share of a core that the slower of two busy processes gets during one second, 0 to 1."""
    loops = [
        subprocess.Popen([sys.executable, "-c", _BUSY_LOOP], stdout=subprocess.PIPE, text=True)
        for _ in range(CORES)
    ]
    return min(float(loop.communicate()[0]) for loop in loops)


def main() -> None:
    share = 0.0
    for _ in range(TRIES):
        share = max(share, processor_share())
        if share >= LEAST_SHARE:
            return
    sys.exit(
        f"this machine is too busy: of {CORES} processor cores, tests get {share:.0%} each, and "
        f"need {LEAST_SHARE:.0%}; end other programs, and run it again"
    )


if __name__ == "__main__":
    main()
