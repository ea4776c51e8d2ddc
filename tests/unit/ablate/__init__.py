"""Tests of ablations."""

import torch

# The networks are small: with several threads, synchronisation would cost more than it saves.
torch.set_num_threads(1)
