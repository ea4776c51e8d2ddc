"""One robot: its steps, its configuration, and the process around them."""
