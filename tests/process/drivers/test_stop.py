"""A program that waits for a signal ends by it, at whatever instant that comes."""

import subprocess
import sys

from edge.drivers.stop import Stop
from tests.conftest import ROOT

# Each round ends only if its signal is taken. With an Event some handler soon waits for a lock that
# the thread holds which it interrupts.
SIGNALLED = """
import random, signal
from edge.drivers.stop import Stop
stops = [Stop() for _ in range(400)]
signal.signal(signal.SIGALRM, lambda *_: stop.set())
for stop in stops:
    for _ in range(3):
        signal.setitimer(signal.ITIMER_REAL, random.uniform(1e-6, 1e-4))
        while signal.getitimer(signal.ITIMER_REAL)[0] or not stop.wait(1e-9):
            stop.wait(1e-9)
        assert stop.is_set() and stop.wait(0.0)
"""


def test_a_signal_in_the_midst_of_waiting_is_taken() -> None:
    subprocess.run([sys.executable, "-c", SIGNALLED], cwd=ROOT, check=True, timeout=60.0)


def test_it_waits_no_longer_than_it_is_to() -> None:
    stop = Stop()
    assert not stop.wait(0.01) and not stop.is_set()
    stop.set()
    stop.set()
    assert stop.is_set() and stop.wait() and stop.wait(0.0)
