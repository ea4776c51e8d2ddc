"""Simulators: point robots, a PX4-like vehicle, fleets of processes, robot computers."""
