"""`lpac map`: the fleet in a browser."""
