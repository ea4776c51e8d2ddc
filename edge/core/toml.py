"""Reads TOML files of configurations."""

import tomllib
from pathlib import Path
from typing import Any

from edge.core.file_errors import in_words
from edge.core.schema import ConfigError


def read_toml(path: Path) -> dict[str, Any]:
    """Read the tables of a file. Raises ConfigError that names the file and the line."""
    return parse_toml(read_toml_text(path), path)


def read_toml_text(path: Path) -> str:
    """Read a file's text, with unchanged line ends. Raises ConfigError."""
    try:
        return path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {in_words(error)}") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: is not TOML: {error}") from None


def parse_toml(text: str, where: Path | str) -> dict[str, Any]:
    """Parse a text. Raises ConfigError that begins with `where` and names the line."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{where}: is not TOML: {error}") from None
