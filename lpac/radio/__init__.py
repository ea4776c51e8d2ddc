"""Capacity of a fleet's radio."""
