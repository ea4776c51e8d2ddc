"""A policy with memory: a gated graph network (Li et al., ICLR 2016) whose state outlives a step.

A robot's memory takes in what it sees and the mean of its neighbours' messages; the message and
the action follow from it.
"""

from collections.abc import Mapping

import torch
from torch import Tensor, nn

WIDTH = 32
# In training, a swarm exchanges messages so often before its actions are judged.
EXCHANGES = 4


def images_network(features: int) -> nn.Sequential:
    """Features (R, features) of images (R, 6, 32, 32)."""
    return nn.Sequential(
        nn.Conv2d(6, 16, 3), nn.BatchNorm2d(16), nn.LeakyReLU(),
        nn.Conv2d(16, 16, 3, stride=2), nn.BatchNorm2d(16), nn.LeakyReLU(),
        nn.Flatten(), nn.Linear(16 * 14 * 14, features), nn.LeakyReLU(),
    )  # fmt: skip


class GatedGraph(nn.Module):
    channels = ("importance", "neighbours_x", "neighbours_y", "explored", "own_cell", "obstacles")
    message_size = WIDTH
    memory_size = WIDTH
    actions_mean: Tensor
    actions_std: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("actions_mean", torch.zeros(2))
        self.register_buffer("actions_std", torch.ones(2))
        self.images = images_network(WIDTH)
        self.memory = nn.GRUCell(WIDTH + 2 + WIDTH, WIDTH)
        self.message = nn.Linear(WIDTH, WIDTH)
        self.action = nn.Sequential(nn.Linear(WIDTH, WIDTH), nn.ReLU(), nn.Linear(WIDTH, 2))

    def encode(self, maps: Tensor, position: Tensor) -> Tensor:
        return torch.cat([self.images(maps[None])[0], position - 0.5])

    def step(
        self, features: Tensor, messages: Tensor, degree: Tensor, memory: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        received = messages.sum(dim=0) / degree.clamp(min=1.0)
        memory = self.memory(torch.cat([features, received])[None], memory[None])[0]
        return self.velocity(memory), torch.tanh(self.message(memory)), memory

    def forward(self, inputs: Mapping[str, Tensor], shift: Tensor, present: Tensor) -> Tensor:
        """Velocities (R, 2) of whole swarms in training: see `lpac.train.family`."""
        features = torch.cat([self.images(inputs["maps"]), inputs["position"] - 0.5], dim=1)
        received = (shift > 0.0).to(features.dtype)
        received = received / received.sum(dim=2, keepdim=True).clamp(min=1.0)
        memory = features.new_zeros(len(features), WIDTH)
        for _ in range(EXCHANGES):
            messages = features.new_zeros(*present.shape, WIDTH)
            messages[present] = torch.tanh(self.message(memory)).to(features.dtype)
            mean = (received @ messages)[present]
            memory = self.memory(torch.cat([features, mean], dim=1), memory)
        return self.velocity(memory)

    def velocity(self, memory: Tensor) -> Tensor:
        action: Tensor = self.action(memory).to(self.actions_std.dtype)
        return action * self.actions_std + self.actions_mean
