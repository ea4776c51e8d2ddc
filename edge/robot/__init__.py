"""One robot: its configuration, its steps, and the process that runs them."""
