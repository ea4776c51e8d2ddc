"""A real PX4, built by whoever has one, as the vehicles of a simulated fleet."""
