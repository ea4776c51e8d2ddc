"""Files that the project ships beside its code: the policy, and the robots' systemd units."""

from pathlib import Path

# Only an installed wheel has it; see pyproject.toml.
_INSTALLED = Path(__file__).parent / "_shipped"


def shipped(name: str) -> Path:
    """Path of a shipped file, from its path in the repository."""
    root = _INSTALLED if _INSTALLED.is_dir() else Path(__file__).parents[1]
    return root / name


# The policy that flies if no other is named.
SHIPPED_BUNDLE = shipped("policies/field/field")
