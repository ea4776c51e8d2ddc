"""The paper's experiments, and those that it argues for without making them, one command each."""
