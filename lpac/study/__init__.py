"""How well policies cover, over many worlds, and how surely one is better than another."""
