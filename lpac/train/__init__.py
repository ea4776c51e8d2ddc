"""Trains a policy from a configuration: generate, fit, DAgger rounds, select, export."""
