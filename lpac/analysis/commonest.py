"""The value that most have."""

from collections import Counter
from collections.abc import Hashable, Iterable
from typing import TypeVar

T = TypeVar("T", bound=Hashable)


def commonest(values: Iterable[T | None]) -> T | None:
    """Value of most of those that have one; of equals the first."""
    counts = Counter(value for value in values if value)
    return max(counts, key=counts.__getitem__, default=None)
