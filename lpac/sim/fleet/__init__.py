"""A fleet of real robot programs as processes, each with a vehicle of its own."""
