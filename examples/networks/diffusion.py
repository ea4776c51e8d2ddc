"""A small diffusion policy (Chi et al., RSS 2023): a few denoising steps give the action.

The denoiser predicts the expert's action from a noisy one, as in Ho et al. (NeurIPS 2020); steps
are deterministic (DDIM, Song et al., ICLR 2021), so that robots can verify them. The condition is
what the robot sees and the mean of its neighbours' messages.
"""

import math
from collections.abc import Mapping

import torch
from memory import images_network
from torch import Tensor, nn

WIDTH = 32
STEPS = 4


class Diffusion(nn.Module):
    channels = ("importance", "neighbours_x", "neighbours_y", "explored", "own_cell", "obstacles")
    message_size = WIDTH
    actions_mean: Tensor
    actions_std: Tensor
    noise: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("actions_mean", torch.zeros(2))
        self.register_buffer("actions_std", torch.ones(2))
        # Where denoising begins, the same for all robots.
        self.register_buffer("noise", torch.zeros(2))
        self.images = images_network(WIDTH)
        self.message = nn.Linear(WIDTH + 2, WIDTH)
        self.denoiser = nn.Sequential(
            nn.Linear(WIDTH + 2 + WIDTH + 2 + 1, 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU(),
            nn.Linear(64, 2),
        )  # fmt: skip

    def encode(self, maps: Tensor, position: Tensor) -> Tensor:
        return torch.cat([self.images(maps[None])[0], position - 0.5])

    def step(self, features: Tensor, messages: Tensor, degree: Tensor) -> tuple[Tensor, Tensor]:
        received = messages.sum(dim=0) / degree.clamp(min=1.0)
        condition = torch.cat([features, received])
        noisy = self.noise
        for number in range(STEPS, 0, -1):
            level, lower = number / STEPS, (number - 1) / STEPS
            action = self.denoised(condition, noisy, noisy.new_tensor([level]))
            noise = (noisy - _kept(level) * action) / _added(level)
            noisy = _kept(lower) * action + _added(lower) * noise
        return noisy * self.actions_std + self.actions_mean, self.message(features)

    def loss(
        self,
        inputs: Mapping[str, Tensor],
        shift: Tensor,
        present: Tensor,
        velocities: Tensor,
    ) -> Tensor:
        """Error of the actions that the denoiser makes of noisy ones: see `lpac.train.network`."""
        features = torch.cat([self.images(inputs["maps"]), inputs["position"] - 0.5], dim=1)
        messages = features.new_zeros(*present.shape, WIDTH)
        messages[present] = self.message(features).to(features.dtype)
        received = (shift > 0.0).to(features.dtype)
        received = received / received.sum(dim=2, keepdim=True).clamp(min=1.0)
        condition = torch.cat([features, (received @ messages)[present]], dim=1)
        actions = (velocities - self.actions_mean) / self.actions_std
        level = torch.rand(len(actions), 1, device=actions.device)
        angle = level * (math.pi / 2.0)
        noisy = angle.cos() * actions + angle.sin() * torch.randn_like(actions)
        return (self.denoised(condition, noisy, level) - actions).square().mean()

    def denoised(self, condition: Tensor, noisy: Tensor, level: Tensor) -> Tensor:
        """The action, in the expert's deviations; `level` is from 0, no noise, to 1."""
        action: Tensor = self.denoiser(torch.cat([condition, noisy, level], dim=-1))
        return action.to(noisy.dtype)


def _kept(level: float) -> float:
    """Share of the action in a noisy one of this level."""
    return math.cos(level * math.pi / 2.0)


def _added(level: float) -> float:
    """Share of noise in a noisy action of this level."""
    return math.sin(level * math.pi / 2.0)
