"""Export of any torch module with `encode` and `step` to a bundle of the family `network`."""

import hashlib
import importlib
import importlib.util
import logging
import sys
import textwrap
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import onnx
import torch
from torch import Tensor, nn

from edge.policy.bundle import Bundle, BundleError, make_bundle
from edge.policy.family import TOLERANCE
from edge.policy.golden import GOLDEN
from edge.policy.graph import Graph
from edge.policy.images import EXPLORED
from edge.policy.network.manifest import (
    ENCODE,
    MAX_TOLERANCE,
    NEIGHBOURS,
    NETWORK,
    STEP,
    NetworkManifest,
)
from edge.policy.network.policy import NetworkPolicy
from export.cases import COUNTS, Case, golden_cases
from export.checkpoint import CheckpointError, read_state_dict
from export.contract import PER_NEIGHBOUR, Contract, ModuleError, with_neighbours
from export.exporter import manifest_of
from export.parameters import PolicyParameters, read_parameters

_OPSET = 20
_MOST_NEIGHBOURS = 1023
_RANDOM = {
    "Bernoulli", "Multinomial", "RandomNormal", "RandomNormalLike", "RandomUniform",
    "RandomUniformLike",
}  # fmt: skip


def export_module(
    reference: str, checkpoint: Path | None, parameters: Path, name: str | None = None
) -> Bundle:
    """Make the bundle of "module:Class" with a checkpoint's weights: see `network_bundle`.

    `parameters` is a file as for `export.exporter.export_bundle`. `name` is the policy's name, by
    default the class's. Raises ModuleError, CheckpointError or ConfigError, one line each.
    """
    trained = read_parameters(parameters)
    module, again = load_module(reference, checkpoint), load_module(reference, checkpoint).eval()
    provenance = {"module": reference.rpartition("/")[2]}
    for source, path in (("checkpoint", checkpoint), ("parameters", parameters)):
        if path is not None:
            provenance[source] = path.name
            provenance[f"{source}_sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    bundle = network_bundle(module, trained, name or type(module).__name__, provenance)
    if golden_cases(again, Contract.of(again), trained).file() != bundle.files[GOLDEN]:
        raise ModuleError(
            f"{reference}: its constructor draws numbers that the checkpoint does not have: "
            "register them as a persistent buffer before training"
        )
    return bundle


def load_module(reference: str, checkpoint: Path | None) -> nn.Module:
    """Make the module of "package.module:Class" or "file.py:Class", with a checkpoint's weights.

    Raises ModuleError, one line, or CheckpointError.
    """
    module = load_class(reference)()
    if checkpoint is not None:
        try:
            state = read_state_dict(checkpoint)
            for name, tensor in state.items():
                if not tensor.isfinite().all():
                    raise CheckpointError(f"{checkpoint}: {name}: has values that are not finite")
            module.load_state_dict(state)
        except RuntimeError as error:
            problem = " ".join(str(error).split())
            raise CheckpointError(f"{checkpoint}: does not fit {reference}: {problem}") from None
    elif any(True for _ in module.parameters()):
        raise ModuleError(f"{reference}: has weights: give --checkpoint")
    return module


def load_class(reference: str) -> Callable[[], nn.Module]:
    """Constructor of "package.module:Class" or "file.py:Class". Raises ModuleError, one line."""
    where, _, name = reference.rpartition(":")
    try:
        made = getattr(_import(where), name)
        module = made()
    except ModuleNotFoundError as error:
        raise ModuleError(f"{reference}: {error}: run it where Python can import it") from None
    except (Exception, SystemExit) as error:  # somebody else's code
        raise ModuleError(f"{reference}: {_in_one_line(error)}") from None
    if not isinstance(module, nn.Module):
        raise ModuleError(f"{reference}: is a {type(module).__name__}: must be a torch.nn.Module")
    constructor: Callable[[], nn.Module] = made
    return constructor


def _import(where: str) -> Any:
    if not where.endswith(".py"):
        sys.path.insert(0, "")
        return importlib.import_module(where)
    path = Path(where)
    if not path.is_file():
        raise ModuleNotFoundError(f"{where} is not a file")
    sys.path.insert(0, str(path.parent))  # as for a script
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def network_bundle(
    module: nn.Module,
    trained: PolicyParameters,
    name: str,
    provenance: Mapping[str, str],
) -> Bundle:
    """Make the verified bundle of a module.

    `module` has `encode(...) -> features` and `step(...) -> action, message[, memory]`, whose
    parameters are named as in `encode_inputs` and `step_inputs`, for one robot, without a batch
    dimension. Its attributes are `message_size`; `memory_size`, by default 0; `channels` and
    `image_size` of the maps, by default the paper's; `depends_on_order`, by default False; and
    `rates_hz`, by default (5.0, 2.5).

    Raises ModuleError, one line, if it cannot be exported, gives a result that robots refuse, or
    depends on the number or the order of the neighbours.
    """
    module = module.eval().requires_grad_(False)
    contract = Contract.of(module)
    cases = golden_cases(module, contract, trained)
    # Of the case with several neighbours.
    traced = COUNTS.index(3)
    graphs = {
        ENCODE: _graph(module, "encode", cases.encode[traced]),
        STEP: _graph(module, "step", cases.step[1 + traced]),
    }
    network = NetworkManifest(
        opset=_OPSET,
        encode=contract.encode,
        step=contract.step,
        features=contract.features,
        message_size=contract.message_size,
        memory_size=contract.memory_size,
        tolerance=MAX_TOLERANCE,
        maps=contract.maps,
        rates=contract.rates,
        order="by robot id" if contract.depends_on_order else "any",
    )
    explores = contract.maps is not None and EXPLORED in contract.maps.channels
    perception = replace(trained.perception, unseen_as_nan=explores)
    manifest = manifest_of(NETWORK, perception, trained, name, provenance, network.parameters)
    files = {**graphs, GOLDEN: cases.file()}
    try:
        policy = NetworkPolicy(make_bundle(manifest, files))
    except BundleError as error:
        raise ModuleError(f"the exported graphs cannot be loaded: {error}") from None
    _try(policy.encode_graph, "encode", cases.encode)
    _try(policy.step_graph, "step", cases.step)
    checks = list(policy.verify())
    worst = max(checks, key=lambda check: check.relative_error)
    # Six times the rounding here, for other processors.
    tolerance = max(TOLERANCE, float(f"{6.0 * worst.relative_error:.0e}"))
    if not tolerance <= MAX_TOLERANCE:
        raise ModuleError(
            f"{worst.name} of the exported graph differs from torch's by "
            f"{worst.relative_error:.1e}: the module decides in Python by values or by the number "
            "of neighbours, which tracing does not see, or float32 is too coarse for it"
        )
    network = replace(network, tolerance=tolerance)
    return make_bundle(replace(manifest, parameters=network.parameters), files)


def _try(graph: Graph, function: str, cases: list[Case]) -> None:
    """Raise ModuleError if onnxruntime cannot run a case, most often one without neighbours."""
    for case in cases:
        try:
            graph.run(case.inputs)
        except Exception as error:  # onnxruntime's exceptions share no base class
            raise ModuleError(
                f"{function}{with_neighbours(case.inputs)}: onnxruntime cannot run it: let the "
                f"robot attend to itself, too ({_in_one_line(error)})"
            ) from None


class _Function(nn.Module):
    """A module whose forward is one of the module's functions, with positional inputs."""

    def __init__(self, module: nn.Module, function: str, names: list[str]) -> None:
        super().__init__()
        self.module, self._function, self._names = module, function, names

    def forward(self, *inputs: Tensor) -> Any:
        named = dict(zip(self._names, inputs, strict=True))
        return getattr(self.module, self._function)(**named)


def _graph(module: nn.Module, function: str, case: Case) -> bytes:
    """The function as an ONNX graph, traced with a case; raises ModuleError."""
    names = list(case.inputs)
    several = torch.export.Dim(NEIGHBOURS, min=0, max=_MOST_NEIGHBOURS)
    shapes = tuple({0: several} if name in PER_NEIGHBOUR else {} for name in names)
    try:
        with _silent():
            program = torch.onnx.export(
                _Function(module, function, names).eval(),
                tuple(torch.from_numpy(case.inputs[name]) for name in names),
                input_names=names,
                output_names=list(case.outputs),
                opset_version=_OPSET,
                dynamo=True,
                external_data=False,
                dynamic_shapes={"inputs": shapes},
            )
        assert program is not None
        graph = program.model_proto
    except Exception as error:  # torch raises many types for what it cannot trace
        text = _in_one_line(error)
        if "DataDependent" in text:
            text = "it decides in Python by the value of a tensor: use torch.where"
        raise ModuleError(f"{function}: torch cannot trace it: {text}") from None
    for value in graph.graph.input:
        if value.name in PER_NEIGHBOUR and not value.type.tensor_type.shape.dim[0].dim_param:
            raise ModuleError(
                f"{function}: works with a fixed number of neighbours: use {value.name}.shape[0] "
                f"in place of len({value.name}), and no Python condition on it"
            )
    if random := {node.op_type for node in graph.graph.node} & _RANDOM:
        raise ModuleError(
            f"{function}: draws random numbers ({min(random)}), which robots cannot repeat: "
            "register the noise as a buffer"
        )
    _strip(graph)
    content: bytes = graph.SerializeToString(deterministic=True)
    return content


def _in_one_line(error: BaseException) -> str:
    """The innermost cause, shortened."""
    while error.__cause__ is not None:
        error = error.__cause__
    return textwrap.shorten(f"{type(error).__name__}: {error}", 240, placeholder=" ...")


def _strip(graph: onnx.ModelProto) -> None:
    """Remove notes of the exporter, which name files of this machine."""
    for part in (graph, graph.graph, *graph.graph.node, *graph.functions):
        part.ClearField("metadata_props")
        part.ClearField("doc_string")
    for function in graph.functions:
        for node in function.node:
            node.ClearField("metadata_props")


@contextmanager
def _silent() -> Iterator[None]:
    """Without the exporter's notes, which are for its own developers."""
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings(), redirect_stdout(StringIO()), redirect_stderr(StringIO()):
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(logging.NOTSET)
