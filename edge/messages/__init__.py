"""What robots and ground say to each other."""
