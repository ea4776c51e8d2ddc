"""Interface of a policy family that can be trained; nothing here knows a network.

An installed package adds a family by an entry point of the group `lpac_edge.learnable`, named as
the family of its bundles: see `edge.drivers.registry`. `lpac.train.lpac` is the paper's.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Protocol

import numpy as np
import numpy.typing as npt

from edge.core import F32, Bools
from edge.drivers.registry import load_learnable
from edge.policy.bundle import Bundle
from export.parameters import PolicyParameters

if TYPE_CHECKING:  # the processes that fly do without
    import torch

    from lpac.train.task import Task

# Of R robots by name: (R, ...), float16 or float32.
Inputs = Mapping[str, npt.NDArray[np.floating]]
# A torch module's weights, by name.
StateDict = Mapping[str, "torch.Tensor"]


class TrainableModule(Protocol):
    """A torch module of the whole swarm at once, in centralised form."""

    def __call__(
        self, inputs: Mapping[str, "torch.Tensor"], shift: "torch.Tensor", present: "torch.Tensor"
    ) -> "torch.Tensor":
        """Velocities (R, 2), in model units/s, of the R robots of B swarms.

        `present` (B, N) bool says which places of the swarms are taken, R in all, for swarms may
        differ in size; `inputs` are (R, ...) in the order of these places, and `shift` (B, N, N)
        is the graph shift operator, 0 where nobody is.
        """


class Learnable(Protocol):
    """One network of a family: its sizes, without weights."""

    @property
    def task(self) -> "Task":
        """Task that it is trained for."""

    def module(self, actions_mean: F32, actions_std: F32) -> "torch.nn.Module":
        """A new `TrainableModule`, drawn from torch's generator.

        It puts out velocities of that mean (2,) and standard deviation (2,), in model units/s, for
        outputs of mean 0 and deviation 1.
        """

    def initial(self, checkpoint: bytes, name: str) -> StateDict:
        """A module's state dict with the weights of a checkpoint, to train on from them.

        Raises ValueError that begins with `name`, if that is of another network.
        """

    def symmetric(self, inputs: Inputs, velocities: F32, turned: int) -> tuple[Inputs, F32]:
        """All that in a world that is mirrored or turned: `turned` is 0 (as it is) to 7."""

    def checkpoint(self, state: StateDict) -> bytes:
        """Serialise a module's state dict, as the family's files have it."""

    def bundle(
        self,
        checkpoint: bytes,
        parameters: PolicyParameters,
        name: str,
        provenance: Mapping[str, str],
    ) -> Bundle:
        """The verified bundle of a checkpoint. Raises ValueError, one line."""


class LearnableFamily(Protocol):
    """Makes networks that can be trained."""

    def __call__(self, network: Mapping[str, object], where: str) -> Learnable:
        """Of what the configuration's [network] says beside the family.

        Raises ConfigError that begins with `where`.
        """


def learnable(network: Mapping[str, object], where: str) -> Learnable:
    """The network that [network] describes. Raises ConfigError."""
    rest = dict(network)
    name = rest.pop("family", "lpac")
    family: LearnableFamily = load_learnable(str(name))
    return family(rest, where)


def shift_operator(adjacency: Bools, heard: Bools) -> F32:
    """The graph shift operator, normalised by both degrees; (B, N, N) all.

    S_ij = 1/sqrt(d_i d_j) where i hears j, else 0. Degrees are those of `adjacency`, heard or
    not: so it is in flight, where a robot knows its neighbours for longer than a lost message.
    """
    degrees = adjacency.sum(axis=2)
    scale = np.zeros(degrees.shape, np.float32)
    np.divide(1.0, np.sqrt(degrees), out=scale, where=degrees > 0)
    shift: F32 = scale[:, :, None] * (adjacency & heard) * scale[:, None, :]
    return shift
