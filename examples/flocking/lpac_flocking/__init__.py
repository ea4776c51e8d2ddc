"""Flocking: a second family of policies, and the second task, beside coverage."""
