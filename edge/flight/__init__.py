"""Pure: the flight state machine, guidance, limits and preflight checks."""
