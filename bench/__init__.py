"""Measurements of this project against torch and against the baselines (`make bench`)."""
