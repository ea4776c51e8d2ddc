"""From a torch checkpoint to a bundle (the only user of torch)."""
