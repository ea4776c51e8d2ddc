"""The paper's experiments, and others that its arguments call for, one command each."""
