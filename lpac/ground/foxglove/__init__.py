"""The fleet in Foxglove: live, and from the ground's logs."""
