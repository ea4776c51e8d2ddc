"""Ground control: ground."""


def ground() -> None:
    """Not built yet."""
    raise ValueError("not built yet")
