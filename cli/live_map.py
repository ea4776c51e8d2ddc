"""Ground control: live_map."""


def live_map() -> None:
    """Not built yet."""
    raise ValueError("not built yet")
