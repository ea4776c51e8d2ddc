"""Golden cases of a torch module: drawn inputs, and the module's outputs.

Robots at random places exchange messages, so that the messages and memories of a case are
ones that the network makes. The module is tried with 0, 1, 3 and 30 neighbours.
"""

import copy
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from edge.core import F32
from edge.policy.graph import Shape
from edge.policy.network.manifest import step_outputs
from export.contract import (
    PER_NEIGHBOUR,
    Arrays,
    Contract,
    ModuleError,
    call,
    with_neighbours,
)
from export.golden import flight_images
from export.parameters import PolicyParameters

COUNTS = (0, 1, 3, 30)
_SEED = 14
# Of messages, so that one that grows with each is noticed.
_EXCHANGES = 10
_MAX_AGE_S = 0.8
_FLOAT16_MAX = 65504.0
# Relative change by another order of a sum.
_REORDERED = {torch.float64: 1e-9, torch.float32: 1e-4}


@dataclass(frozen=True, slots=True)
class Case:
    """Inputs and outputs of a graph by name, float32."""

    inputs: dict[str, F32]
    outputs: dict[str, F32]


@dataclass(frozen=True, slots=True)
class Cases:
    """Cases of both graphs; those of `step` begin with a robot's first step."""

    encode: list[Case]
    step: list[Case]

    def file(self) -> bytes:
        """The npz file that `edge.policy.network.golden` reads, deterministic."""
        buffer = io.BytesIO()
        arrays = {
            f"{graph}/{number}/{name}": values
            for graph, cases in (("encode", self.encode), ("step", self.step))
            for number, case in enumerate(cases)
            for name, values in (case.inputs | case.outputs).items()
        }
        np.savez(buffer, allow_pickle=False, **arrays)  # numpy dates all entries to 1980
        return buffer.getvalue()


def golden_cases(module: nn.Module, contract: Contract, trained: PolicyParameters) -> Cases:
    """Run the module in float64, or in float32 if it computes in nothing else.

    Raises ModuleError for outputs that robots refuse, and if the result is not the same for the
    same inputs, or depends on the order of the neighbours and the contract does not say so.
    """
    cases = _Swarm(module, torch.float32, contract, trained).cases()
    try:
        # A golden output in float64 has no rounding of its own.
        return _Swarm(copy.deepcopy(module).double(), torch.float64, contract, trained).cases()
    except ModuleError:
        return cases


class _Swarm:
    def __init__(
        self,
        module: nn.Module,
        dtype: torch.dtype,
        contract: Contract,
        trained: PolicyParameters,
    ) -> None:
        self._module, self._dtype, self._contract = module, dtype, contract
        self._range = trained.perception.communication_range
        self._max_speed = trained.training.max_speed
        messages = trained.messages
        self._payload_limit = messages.payload_limit or (
            _FLOAT16_MAX if "float16" in messages.payload_types else math.inf
        )
        self._random = np.random.Generator(np.random.PCG64(_SEED))

    def cases(self) -> Cases:
        encode = [self._encoded(count) for count in (*COUNTS, *COUNTS)]
        nobody = np.zeros((0, self._contract.message_size), np.float32)
        memory = np.zeros(self._contract.memory_size, np.float32)
        features = [
            encode[robot % len(encode)].outputs["features"] for robot in range(max(COUNTS) + 1)
        ]
        steps = [self._stepped(each, nobody, memory) for each in features]
        first = steps[0]
        for exchange in range(_EXCHANGES + 1):
            # In the end, the numbers of neighbours that are kept.
            counts = COUNTS if exchange == _EXCHANGES else [(3 * i) % 7 for i in range(len(steps))]
            steps = [
                self._stepped(
                    features[robot],
                    self._received(steps, robot, count),
                    steps[robot].outputs.get("new_memory", memory),
                )
                for robot, count in enumerate(counts)
            ]
        return Cases(encode, [first, *steps])

    def _received(self, steps: Sequence[Case], robot: int, count: int) -> F32:
        """Messages (count, message_size) of the robots after this one."""
        senders = [(robot + 1 + i) % len(steps) for i in range(count)]
        messages = np.array([steps[sender].outputs["message"] for sender in senders], np.float32)
        if (largest := np.abs(messages).max(initial=0.0)) > self._payload_limit:
            raise ModuleError(
                f"step: a message has the value {largest:.3g}: robots refuse more than "
                f"{self._payload_limit:g}: scale it, or change payload_limit or payload_types of "
                "[messages] in the parameter file"
            )
        return messages.reshape(count, self._contract.message_size)

    def _encoded(self, count: int) -> Case:
        maps, uniform = self._contract.maps, self._random.uniform
        drawn = {
            "position": uniform(0.0, 1.0, 2),
            "velocity": uniform(-self._max_speed, self._max_speed, 2),
            "neighbours": uniform(-self._range, self._range, (count, 2)),
        }
        if maps:
            [drawn["maps"]] = flight_images(len(maps.channels), maps.size, 1, self._random)
        outputs: dict[str, Shape] = {"features": self._contract.features}
        return self._case("encode", self._contract.encode, drawn, outputs)

    def _stepped(self, features: F32, messages: F32, memory: F32) -> Case:
        count, uniform = len(messages), self._random.uniform
        drawn: dict[str, npt.NDArray[Any]] = {
            "features": features,
            "messages": messages,
            "positions": uniform(-self._range, self._range, (count, 2)),
            "velocities": uniform(-self._max_speed, self._max_speed, (count, 2)),
            "ages": uniform(0.0, _MAX_AGE_S, count),
            "degree": np.array(count),
            "memory": memory,
        }
        outputs = step_outputs(self._contract.message_size, self._contract.memory_size)
        return self._case("step", self._contract.step, drawn, outputs)

    def _case(
        self,
        function: str,
        names: Iterable[str],
        drawn: Mapping[str, npt.NDArray[Any]],
        shapes: Mapping[str, Shape],
    ) -> Case:
        inputs = {name: drawn[name].astype(np.float32) for name in names}
        outputs = self._run(function, inputs, shapes)
        again = self._run(function, inputs, shapes)
        if any(not torch.equal(outputs[name], again[name]) for name in shapes):
            raise ModuleError(
                f"{function}: gives another result for the same inputs: what it keeps belongs into "
                "memory, and noise into a persistent buffer"
            )
        if PER_NEIGHBOUR & inputs.keys() and not self._contract.depends_on_order:
            self._check_order(function, inputs, outputs)
        return Case(inputs, {name: values.float().numpy() for name, values in outputs.items()})

    def _run(self, function: str, inputs: Arrays, shapes: Mapping[str, Shape]) -> dict[str, Tensor]:
        results = call(self._module, function, inputs, self._dtype)
        if [tuple(result.shape) for result in results] != list(shapes.values()):
            found = ", ".join(str(tuple(result.shape)) for result in results)
            expected = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
            raise ModuleError(
                f"{function}{with_neighbours(inputs)}: gives shapes {found}: must be {expected}"
            )
        return dict(zip(shapes, results, strict=True))

    def _check_order(self, function: str, inputs: Arrays, outputs: Mapping[str, Tensor]) -> None:
        """Raise ModuleError if another order of the neighbours changes an output."""
        reordered = {
            name: np.roll(values[::-1], 1, axis=0).copy() if name in PER_NEIGHBOUR else values
            for name, values in inputs.items()
        }
        shapes: dict[str, Shape] = {name: tuple(values.shape) for name, values in outputs.items()}
        for name, values in self._run(function, reordered, shapes).items():
            former = outputs[name]
            change = float((values - former).abs().sum())
            if change > _REORDERED[self._dtype] * float(former.abs().sum()):
                raise ModuleError(
                    f"{function}{with_neighbours(inputs)}: the order of the neighbours changes the "
                    f"{name}: make it independent, or set depends_on_order = True"
                )
