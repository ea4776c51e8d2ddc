"""`lpac watch`: the fleet in a terminal."""
