"""One thing is not "1 things"."""

import re

from edge.core.counted import counted
from tests.conftest import ROOT

# What is counted with a number that may be one.
NOUNS = "robots|flight logs|satellites|checks|flights|alarms|restarts"


def test_one_is_singular() -> None:
    assert counted(1, "flight log") == "1 flight log"
    assert counted(0, "robot") == "0 robots" and counted(12_000, "robot") == "12,000 robots"


def test_lengths_are_never_put_before_a_plural_unseen() -> None:
    """A length may be one, and then it is "1 robot": `counted` says so."""
    loose = re.compile(rf"\{{len\([^{{}}]*\)\}} ({NOUNS})\b(?! and)")
    found = [
        f"{path.relative_to(ROOT)}: {line.strip()}"
        for package in ("edge", "lpac", "export")
        for path in (ROOT / package).rglob("*.py")
        for line in path.read_text().splitlines()
        if loose.search(line)
    ]
    assert found == [], "\n".join(found)
