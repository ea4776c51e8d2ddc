"""Messages between robots and ground."""
