"""The paper's experiments, and those that it argues for and did not make, by one command each."""
