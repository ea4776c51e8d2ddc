"""Data that others published, for which this repository has no licence.

Tests make folders of the same layout. An environment variable may name the real one.
"""

import os

AUTHORS_TAPS = "LPAC_TEST_AUTHORS_TAPS"
AUTHORS_PARAMETERS = "LPAC_TEST_AUTHORS_PARAMETERS"
MADE = "made"


def sources(variable: str) -> list[str]:
    """Return the cases of a fixture: a folder that it makes, and the real one if it is at hand."""
    return [MADE, *filter(None, [os.environ.get(variable)])]
