"""Ground control: the process that speaks to the fleet, its clients, scripts and records."""
