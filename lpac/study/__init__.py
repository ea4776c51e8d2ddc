"""Studies: policies and baselines flown over many worlds and compared."""
