"""Imports done before flight, since each reads the disk and may fail."""

import subprocess
import sys

from tests.conftest import ROOT

_FLIGHT = """
import sys
from lpac.ground.station.protocol import SafetyCommand, Start, Takeoff
from tests.sim.ground.field import a_field
field = a_field(2, "ready", secure=True)
assert "numpy.ma" not in sys.modules, "the test would not notice it"
before = set(sys.modules)
assert field.do(Takeoff()).done and field.do(Start()).done
# So long that the battery's drain is measured, too.
field.run(120.0)
assert field.do(SafetyCommand("return")).done
field.until(lambda: not any(robot.vehicle.armed for robot in field.robots), 120.0)
print("\\n".join(sorted(name for name in set(sys.modules) - before if "lpac" not in name)))
"""


def test_nothing_is_imported_in_flight() -> None:
    flown = subprocess.run(
        [sys.executable, "-c", _FLIGHT], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert flown.returncode == 0, flown.stderr[-1000:]
    assert flown.stdout.split() == []
