"""The robot's program."""
