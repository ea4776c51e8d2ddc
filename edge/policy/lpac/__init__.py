"""The paper's policy family: CNN, aggregated graph neural network, action network."""
