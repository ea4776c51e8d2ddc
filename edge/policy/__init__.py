"""Learned policies on disk: the bundle, its verification and its replay."""
