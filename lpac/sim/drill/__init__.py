"""Faults injected into a fleet in flight, and promises judged by the vehicles' true state."""
