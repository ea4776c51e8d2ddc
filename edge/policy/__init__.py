"""A learned policy on disk: the bundle, its verification and its replay."""
