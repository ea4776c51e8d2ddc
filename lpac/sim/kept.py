"""Outcomes kept on disk as they come, so that an interrupted run can resume."""

import hashlib
import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any


class KeptOutcomes:
    """Lines of JSON in a file, after a header line that identifies their source.

    Lines under another header, such as another version of the code, are discarded. `lines` are the
    valid ones.
    """

    def __init__(self, path: Path, source: Mapping[str, Any]) -> None:
        """Create or read the file. Raises OSError."""
        self._path = path
        self.lines: list[dict[str, Any]] = []
        path.parent.mkdir(parents=True, exist_ok=True)
        text = path.read_text() if path.exists() else ""
        first, *lines = [*map(_parsed, text.splitlines())] or [None]
        if first == source:
            self.lines = [line for line in lines if line is not None]
        if first == source and None not in lines:
            return
        # Another version, or a partial last line that the next one would continue.
        new = path.with_name(f"{path.name}.new")
        new.write_text("".join(json.dumps(line) + "\n" for line in (source, *self.lines)))
        new.replace(path)

    def add(self, line: dict[str, Any]) -> None:
        """Append a line. Raises OSError."""
        with self._path.open("a") as file:
            file.write(json.dumps(line) + "\n")
        self.lines.append(line)


@cache
def code_digest(*packages: ModuleType) -> str:
    """SHA-256 of the sources of these packages."""
    digest = hashlib.sha256()
    for package in packages:
        root = Path(package.__path__[0])
        for path in sorted(root.rglob("*.py")):
            digest.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def _parsed(line: str) -> Any:
    try:
        return json.loads(line)
    except ValueError:
        return None
