"""The policy family of the paper: CNN, aggregated graph neural network, action network."""
