"""A downward camera for lpac-edge: images in, importance out."""
