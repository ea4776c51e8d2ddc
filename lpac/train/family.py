"""Interfaces of a trainable policy family, independent of any network.

A package adds a family with an entry point of the group `lpac_edge.learnable`, under the name of
its bundles' family: see `edge.drivers.registry`. `lpac.train.lpac` is the paper's family.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Protocol

import numpy as np
import numpy.typing as npt

from edge.core import F32, Bools
from edge.drivers.registry import load_learnable
from edge.policy.bundle import Bundle
from export.parameters import PolicyParameters

if TYPE_CHECKING:  # processes that fly do not import torch
    import torch

    from lpac.train.task import Task

# Inputs of R robots by name, (R, ...), float16 or float32.
Inputs = Mapping[str, npt.NDArray[np.floating]]
# Weights of a torch module, by name.
StateDict = Mapping[str, "torch.Tensor"]


class TrainableModule(Protocol):
    """A torch module that computes the whole swarm, in centralised form."""

    def __call__(
        self, inputs: Mapping[str, "torch.Tensor"], shift: "torch.Tensor", present: "torch.Tensor"
    ) -> "torch.Tensor":
        """Velocities (R, 2), in model units/s, of the R robots of B swarms.

        `present` (B, N) bool marks the occupied places of the swarms, R in total, since swarms
        differ in size. `inputs` are (R, ...) in the order of these places. `shift` (B, N, N) is the
        graph shift operator, 0 at empty places.
        """


class Learnable(Protocol):
    """One network of a family: its sizes, without weights."""

    @property
    def task(self) -> "Task":
        """Task for which the network is trained."""

    def module(self, actions_mean: F32, actions_std: F32) -> "torch.nn.Module":
        """Make a `TrainableModule` with random weights from torch's generator.

        Its velocities have the mean `actions_mean` (2,) and the standard deviation `actions_std`
        (2,), in model units/s, where the network's outputs have mean 0 and standard deviation 1.
        """

    def initial(self, checkpoint: bytes, name: str) -> StateDict:
        """State dict of a module with a checkpoint's weights, to continue training.

        Raises ValueError that begins with `name` if the checkpoint has another network.
        """

    def symmetric(self, inputs: Inputs, velocities: F32, turned: int) -> tuple[Inputs, F32]:
        """Inputs and velocities in a mirrored or turned world; `turned` is 0 (unchanged) to 7."""

    def checkpoint(self, state: StateDict) -> bytes:
        """Serialise a module's state dict in the family's file format."""

    def bundle(
        self,
        checkpoint: bytes,
        parameters: PolicyParameters,
        name: str,
        provenance: Mapping[str, str],
    ) -> Bundle:
        """Make the verified bundle of a checkpoint. Raises ValueError, one line."""


class LearnableFamily(Protocol):
    """Constructor of a family's trainable networks."""

    def __call__(self, network: Mapping[str, object], where: str) -> Learnable:
        """Make a network from the keys of [network] other than `family`.

        Raises ConfigError that begins with `where`.
        """


def learnable(network: Mapping[str, object], where: str) -> Learnable:
    """Make the network described by [network]. Raises ConfigError."""
    rest = dict(network)
    name = rest.pop("family", "lpac")
    family: LearnableFamily = load_learnable(str(name))
    return family(rest, where)


def shift_operator(adjacency: Bools, received: Bools) -> F32:
    """Graph shift operator, normalised by both degrees; all (B, N, N).

    S_ij = 1/sqrt(d_i d_j) where i received j's message, else 0. Degrees are those of `adjacency`:
    in flight, too, a robot keeps a neighbour when a message is lost.
    """
    degrees = adjacency.sum(axis=2)
    scale = np.zeros(degrees.shape, np.float32)
    np.divide(1.0, np.sqrt(degrees), out=scale, where=degrees > 0)
    shift: F32 = scale[:, :, None] * (adjacency & received) * scale[:, None, :]
    return shift
