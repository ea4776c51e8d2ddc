"""Contract of a torch module with `encode` and `step`: see `edge.policy.network.manifest`."""

import inspect
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from edge.core import F32
from edge.policy.images import MAP_CHANNELS
from edge.policy.network.manifest import (
    NEIGHBOURS,
    Array,
    Maps,
    TrainingRates,
    encode_inputs,
    step_inputs,
)

Arrays = Mapping[str, F32]
# Inputs with a row for each neighbour.
PER_NEIGHBOUR = {
    name
    for inputs in (encode_inputs(None), step_inputs((1,), 1, 1))
    for name, array in inputs.items()
    if NEIGHBOURS in array.shape
}


class ModuleError(ValueError):
    """The module cannot be exported; the text names the function and the cause."""


@dataclass(frozen=True, slots=True)
class Contract:
    """A module's part of the manifest, from its attributes and its functions' parameters."""

    encode: dict[str, Array]
    step: dict[str, Array]
    features: tuple[int, ...]
    message_size: int
    memory_size: int
    depends_on_order: bool
    maps: Maps | None
    rates: TrainingRates

    @classmethod
    def of(cls, module: nn.Module) -> "Contract":
        """Read a module's contract. Raises ModuleError, one line."""
        message_size, memory_size = _size(module, "message_size"), _size(module, "memory_size", 0)
        maps = None
        try:
            if "maps" in _parameters(module, "encode"):
                channels = tuple(getattr(module, "channels", MAP_CHANNELS[4]))
                maps = Maps(channels, getattr(module, "image_size", 32))
            rates = TrainingRates(*_rates_hz(module))
        except ValueError as error:
            raise ModuleError(f"{type(module).__name__}: {error}") from None
        encode = _chosen(module, "encode", encode_inputs(maps))
        # Any features do to learn which inputs `step` names; their shape follows from `encode`.
        zeros = {name: np.zeros(sizes_of(array, 1), np.float32) for name, array in encode.items()}
        features, *others = call(module, "encode", zeros, torch.float32)
        if others or not features.ndim:
            found = f"{1 + len(others)} tensors" if others else "a number"
            raise ModuleError(f"encode gives {found}: must give a tensor of one dimension or more")
        step = _chosen(
            module, "step", step_inputs(tuple(features.shape), message_size, memory_size)
        )
        if memory_size and "memory" not in step:
            raise ModuleError(f"memory_size = {memory_size}, but step takes no memory")
        return cls(
            encode,
            step,
            tuple(features.shape),
            message_size,
            memory_size,
            bool(getattr(module, "depends_on_order", False)),
            maps,
            rates,
        )


def _size(module: nn.Module, name: str, default: int | None = None) -> int:
    size = getattr(module, name, default)
    if not isinstance(size, int) or size < 0:
        raise ModuleError(
            f"{type(module).__name__}: {name} = {size!r}: must be an attribute with an integer of "
            "at least 0"
        )
    return size


def _rates_hz(module: nn.Module) -> tuple[float, float]:
    rates_hz = getattr(module, "rates_hz", (5.0, 2.5))
    match rates_hz:
        case (int() | float() as encode_hz, int() | float() as step_hz):
            return float(encode_hz), float(step_hz)
    raise ModuleError(f"{type(module).__name__}: rates_hz = {rates_hz!r}: must be two numbers")


def _parameters(module: nn.Module, function: str) -> list[str]:
    method = getattr(module, function, None)
    if not callable(method):
        raise ModuleError(f"{type(module).__name__}: has no {function}(...)")
    return list(inspect.signature(method).parameters)


def _chosen(module: nn.Module, function: str, known: Mapping[str, Array]) -> dict[str, Array]:
    names = _parameters(module, function)
    for name in names:
        if name not in known:
            raise ModuleError(f"{function} takes {name!r}: known are {', '.join(known)}")
    return {name: known[name] for name in names}


def sizes_of(array: Array, neighbours: int) -> tuple[int, ...]:
    """Shape of an array with so many neighbours."""
    return tuple(neighbours if isinstance(size, str) else size for size in array.shape)


def call(
    module: nn.Module, function: str, inputs: Arrays, dtype: torch.dtype
) -> tuple[Tensor, ...]:
    """The outputs of `encode` or `step`, finite and of type `dtype`. Raises ModuleError."""
    where = f"{function}{with_neighbours(inputs)}"
    given = {name: torch.from_numpy(values).to(dtype) for name, values in inputs.items()}
    default = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        with torch.no_grad():
            result = getattr(module, function)(**given)
    except Exception as error:  # somebody else's code
        text = " ".join(f"{type(error).__name__}: {error}".split())
        raise ModuleError(f"{where}: {text}") from None
    finally:
        torch.set_default_dtype(default)
    outputs = result if isinstance(result, tuple) else (result,)
    for output in outputs:
        if not isinstance(output, Tensor):
            raise ModuleError(f"{where}: gives a {type(output).__name__}: must be tensors")
        if output.dtype != dtype:
            raise ModuleError(f"{where}: gives {output.dtype} from {dtype}")
        if not output.isfinite().all():
            raise ModuleError(f"{where}: gives NaN or infinity")
    return outputs


def with_neighbours(inputs: Arrays) -> str:
    """Text of the number of neighbours in a call's inputs, to follow the function's name."""
    counts = [len(inputs[name]) for name in inputs if name in PER_NEIGHBOUR]
    if not counts:
        return ""
    return " with 1 neighbour" if counts[0] == 1 else f" with {counts[0] or 'no'} neighbours"
