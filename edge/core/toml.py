"""Configurations as TOML files."""

import tomllib
from pathlib import Path
from typing import Any

from edge.core.file_errors import in_words
from edge.core.schema import ConfigError


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a file. Raises ConfigError that names the file, and the line."""
    return parse_toml(read_toml_text(path), path)


def read_toml_text(path: Path) -> str:
    """The text of a file, its ends of lines as they are. Raises ConfigError."""
    try:
        return path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {in_words(error)}") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: is not TOML: {error}") from None


def parse_toml(text: str, where: Path | str) -> dict[str, Any]:
    """The tables of a text. Raises ConfigError that begins with `where`, and names the line."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{where}: is not TOML: {error}") from None
