"""Files that are never found half written."""

from pathlib import Path


def write_atomically(path: Path, content: bytes) -> None:
    """Replace what is at `path`. Raises OSError, and then what was there is still there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    new = path.with_name(f"{path.name}.new")
    new.write_bytes(content)
    new.replace(path)
