"""Faults done to a fleet in flight, and what is promised then, judged by the vehicles' truth."""
