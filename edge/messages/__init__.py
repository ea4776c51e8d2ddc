"""Messages between robots and the ground."""
