"""How many of something, in words."""


def counted(count: int, noun: str) -> str:
    """Such as "1 robot" or "2 robots"; the plural of `noun` ends in s."""
    return f"{count:,} {noun}" if count == 1 else f"{count:,} {noun}s"
