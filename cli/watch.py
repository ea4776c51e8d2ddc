"""Ground control: watch."""


def watch() -> None:
    """Not built yet."""
    raise ValueError("not built yet")
