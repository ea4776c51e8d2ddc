"""Ground control: report."""


def record() -> None:
    """Not built yet."""
    raise ValueError("not built yet")


def report() -> None:
    """Not built yet."""
    raise ValueError("not built yet")
