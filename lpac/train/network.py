"""Training of any torch module with `encode` and `step`, exported as family `network`.

Beside these, which robots compute, the module has a `forward` of whole swarms: `TrainableModule`.
With a function `loss(inputs, shift, present, velocities)` it is trained by that in place of the
squared error of the velocities. Buffers `actions_mean` and `actions_std` get those of the expert.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import nn

from edge.core import F32
from edge.core.schema import Bounded, ConfigError, from_mapping
from edge.policy.bundle import Bundle
from export.checkpoint import parse_state_dict, write_state_dict
from export.contract import PER_NEIGHBOUR, Contract
from export.module import load_class, network_bundle
from export.parameters import PolicyParameters
from lpac.train.family import Inputs, StateDict
from lpac.train.symmetry import turned_images, turned_vectors
from lpac.train.task import CoverageTask


class ModuleNetwork:
    """A module without weights: see `Learnable`."""

    def __init__(self, make: Callable[[], nn.Module]) -> None:
        """`make` gives a module with random weights. Raises ValueError, one line."""
        self._make = make
        self._contract = Contract.of(make().eval())
        if ragged := PER_NEIGHBOUR & self._contract.encode.keys():
            raise ValueError(f"encode takes {min(ragged)!r}: training needs inputs of one shape")

    @property
    def task(self) -> CoverageTask:
        """See `Learnable`."""
        return CoverageTask()

    def module(self, actions_mean: F32, actions_std: F32) -> nn.Module:
        """See `Learnable`."""
        module = self._make()
        buffers = dict(module.named_buffers())
        for name, values in (("actions_mean", actions_mean), ("actions_std", actions_std)):
            if name in buffers:
                buffers[name].copy_(torch.from_numpy(values))
        return module

    def initial(self, checkpoint: bytes, name: str) -> StateDict:
        """See `Learnable`."""
        state = parse_state_dict(checkpoint, name)
        try:
            self._make().load_state_dict(state)
        except RuntimeError as error:
            raise ValueError(f"{name}: {' '.join(str(error).split())}") from None
        return state

    def symmetric(self, inputs: Inputs, velocities: F32, turned: int) -> tuple[Inputs, F32]:
        """See `Learnable`; bit 0 mirrors x, bit 1 mirrors y, bit 2 swaps the two."""
        changed = dict(inputs)
        if self._contract.maps:
            changed["maps"] = turned_images(inputs["maps"], self._contract.maps.channels, turned)
        if "position" in inputs:
            changed["position"] = turned_vectors(inputs["position"] - 0.5, turned) + 0.5
        if "velocity" in inputs:
            changed["velocity"] = turned_vectors(inputs["velocity"], turned)
        return changed, turned_vectors(velocities, turned)

    def checkpoint(self, state: StateDict) -> bytes:
        """See `Learnable`; a file for `torch.load`."""
        return write_state_dict(state)

    def bundle(
        self,
        checkpoint: bytes,
        parameters: PolicyParameters,
        name: str,
        provenance: Mapping[str, str],
    ) -> Bundle:
        """See `Learnable`."""
        module = self._make()
        module.load_state_dict(self.initial(checkpoint, name))
        return network_bundle(module, parameters, name, provenance)


@dataclass(frozen=True, slots=True, kw_only=True)
class ModuleSource(Bounded):
    """[network] of the family `network`: `module` is "package.module:Class" or "file.py:Class"."""

    module: str


def module_network(network: Mapping[str, object], where: str) -> ModuleNetwork:
    """See `LearnableFamily`."""
    source = from_mapping(ModuleSource, network, where)
    try:
        return ModuleNetwork(load_class(source.module))
    except ValueError as error:
        raise ConfigError(f"{where}: module = {source.module!r}: {error}") from None
