"""Simulated fleets of whole robots: as processes, or on a simulated clock."""
