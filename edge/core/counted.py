"""Counts as text."""


def counted(count: int, noun: str) -> str:
    """Text such as "1 robot" or "2 robots"; the plural of `noun` ends in s."""
    return f"{count:,} {noun}" if count == 1 else f"{count:,} {noun}s"
