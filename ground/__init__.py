"""Ground control: the process that speaks to the fleet, and its clients."""
