"""Real PX4 builds (SITL) as the vehicles of a simulated fleet."""
