"""The most common value."""

from collections import Counter
from collections.abc import Hashable, Iterable
from typing import TypeVar

T = TypeVar("T", bound=Hashable)


def commonest(values: Iterable[T | None]) -> T | None:
    """The most common of the truthy values, the first one in a tie; None if there are none."""
    counts = Counter(value for value in values if value)
    return max(counts, key=counts.__getitem__, default=None)
