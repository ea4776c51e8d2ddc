"""Tests of what is deployed: the image, for both architectures."""
