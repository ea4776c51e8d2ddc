"""A robot's log when its process is killed, and on a full disk."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from edge.drivers.log_reader import read
from tests.conftest import ROOT
from tests.unit.drivers.test_flight_log import NOW, flight_log, logged

CHILD = """
import sys
from pathlib import Path
from edge.drivers.flight_log import FlightLog
from tests.unit.drivers.test_flight_log import METADATA, NOISE

log = FlightLog(Path(sys.argv[1]), METADATA, sync_period_s=0)
number = 0
while True:
    for _ in range(10):
        log.record("policy", float(number), {"number": number, "array": NOISE[:1000]})
        number += 1
    log.flush()
    print(number, flush=True)
"""


def test_what_was_flushed_survives_sigkill(tmp_path: Path) -> None:
    child = subprocess.Popen(
        [sys.executable, "-c", CHILD, str(tmp_path)],
        cwd=ROOT, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    with child:
        assert child.stdout is not None
        flushed = [int(child.stdout.readline()) for _ in range(20)][-1]
        child.send_signal(signal.SIGKILL)
    found = [message["number"] for _, _, message in logged(tmp_path)]
    assert found[:flushed] == list(range(flushed))
    with flight_log(tmp_path) as log:  # the next start
        log.record("policy", NOW, {"number": "next"})
    assert [m["number"] for _, _, m in read(tmp_path / "robot-3-0002.mcap")] == ["next"]


@pytest.mark.parametrize(("limit_bytes", "least"), [(300_000, 5), (50, 0)])
def test_a_full_disk_stops_the_log_and_nothing_else(
    tmp_path: Path, limit_bytes: int, least: int
) -> None:
    code = """
import resource, sys
from pathlib import Path
from edge.drivers.flight_log import FlightLog
from tests.unit.drivers.test_flight_log import METADATA, NOISE

resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), int(sys.argv[2])))
log = FlightLog(Path(sys.argv[1]), METADATA, sync_period_s=0)
for number in range(20):
    log.record("policy", 1.0, {"number": number, "array": NOISE})
    log.flush()
assert not log.recording
log.close()
"""
    result = subprocess.run(
        [sys.executable, "-X", "dev", "-c", code, str(tmp_path), str(limit_bytes)],
        cwd=ROOT, capture_output=True, text=True, check=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    first, *others = result.stderr.splitlines()
    assert "flight log stopped" in first and "File too large" in first
    # It goes on in a new file, where that can be.
    assert all(line.startswith("flight log ") for line in others)
    found = [message["number"] for _, _, message in logged(tmp_path)]
    # What could not be written is dropped, and counted; the rest comes in its order.
    assert found[:least] == list(range(least)) and found == sorted(set(found))
