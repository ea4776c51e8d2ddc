"""docs/px4.md lists all that the code relies on in PX4, and says the same of versions."""

import re

from edge.core.px4_version import EVIDENCE, OLDEST
from edge.drivers.px4.telemetry import Px4Telemetry
from edge.flight.failsafe import PARAMETERS
from tests.conftest import ROOT

TEXT = (ROOT / "docs" / "px4.md").read_text()


def test_every_message_and_parameter_is_listed() -> None:
    listed = {
        word for line in TEXT.splitlines() if line[:2] == "| " for word in re.findall(r"\w+", line)
    }
    assert listed >= {*Px4Telemetry().messages, *PARAMETERS, "MAV_SYS_ID"}
    named = {word for word in listed if re.fullmatch(r"(COM|NAV|GF|BAT|CBRK|EKF2)_\w+", word)}
    assert named - {"NAV_LAND"} == set(PARAMETERS)


def test_versions_are_those_of_the_code() -> None:
    oldest, newest = (".".join(map(str, version)) for version in (OLDEST, max(EVIDENCE)))
    assert min(EVIDENCE) == OLDEST
    assert f"older than {oldest} is refused" in TEXT
    assert f"one newer than {newest} is reported as untested" in TEXT
    seen = {version for version, evidence in EVIDENCE.items() if evidence.startswith("tested")}
    assert seen == {(1, 14), (1, 17)}
