"""Ablations: policies trained, or flown, without a part of the method."""
