"""Evaluation of recorded flights: numbers, figures and reports."""
