"""Atomic writes."""

from pathlib import Path


def write_atomically(path: Path, content: bytes) -> None:
    """Replace the file at `path`. Raises OSError, and then the old file is unchanged."""
    path.parent.mkdir(parents=True, exist_ok=True)
    new = path.with_name(f"{path.name}.new")
    new.write_bytes(content)
    new.replace(path)
