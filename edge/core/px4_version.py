"""Supported PX4 versions, and how far each was tested.

docs/px4.md lists the features that are relied on.
"""

OLDEST = (1, 14)

# Evidence for each version. "Read" means that all features relied on were checked in its sources.
EVIDENCE = {
    (1, 14): "tested: PX4 SITL 1.14.4",
    (1, 15): "read in its sources, never tried",
    (1, 16): "read in its sources, never tried",
    (1, 17): "tested: PX4 SITL 1.17.0",
}


def in_words(version: str | None) -> str:
    """Text of a vehicle's version, such as "1.17.0", and how far it was tested."""
    if version is None:
        return "PX4 did not report its version"
    number = _number(version)
    newest = ".".join(map(str, max(EVIDENCE)))
    unknown = "too old" if number < OLDEST else f"not tested: newer than {newest}"
    return f"PX4 {version} ({EVIDENCE.get(number, unknown)})"


def is_too_old(version: str | None) -> bool:
    """Whether the version is known to lack required features."""
    return version is not None and _number(version) < OLDEST


def _number(version: str) -> tuple[int, int]:
    major, minor, *_ = version.split(".")
    return int(major), int(minor)
