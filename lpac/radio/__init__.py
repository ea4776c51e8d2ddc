"""What a fleet's radio can carry."""
