"""Trainings, and what they are worth."""

import torch

# The networks are small: several threads would wait for each other more than they compute.
torch.set_num_threads(1)
