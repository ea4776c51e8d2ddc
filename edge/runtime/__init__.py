"""The policy and one robot's steps, built on the core."""
