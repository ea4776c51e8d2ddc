"""The `lpac` command."""
