"""Reads a trained LPAC network from disk and checks every tensor.

Two sources: a state dict of CoverageControl's LPAC module, and a folder with one file per tensor,
the form in which the paper's authors published their graph neural network and action network.
"""

import hashlib
import io
import math
import pickle
import re
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from edge.core import F32
from edge.core.aggregation import Geometry
from edge.core.file_errors import in_words
from edge.policy.images import MAP_CHANNELS

# Not stored in a state dict: torch's default for batch norms, and CoverageControl's slope.
BATCH_NORM_EPS = 1e-5
LEAKY_RELU_SLOPE = 0.01

ACTION_SIZE = 2
# The robot's position, appended to the CNN's features.
POSITION_SIZE = 2

_COMPILED_PREFIX = "_orig_mod."
_STATE_DICT_KEYS = ("state_dict", "model_state_dict")
_NORM_PARTS = ("weight", "bias", "running_mean", "running_var")
_IGNORED_PART = "num_batches_tracked"

# File names in the folder, and the names of the same tensors in a state dict.
_FOLDER_NAMES = (
    ("lin_{}_{}.pt", "gnn_backbone.graph_conv_{}.lins.{}.weight"),
    ("bias_{}.pt", "gnn_backbone.graph_conv_{}.bias"),
    ("mlp_lin_{}.pt", "gnn_mlp.lins.{}.weight"),
    ("mlp_bias_{}.pt", "gnn_mlp.lins.{}.bias"),
    *(
        (f"mlp_norm_{{}}_{part}.pt", f"gnn_mlp.norms.{{}}.module.{part}")
        for part in (*_NORM_PARTS, _IGNORED_PART)
    ),
    ("outlayer_wts.pt", "output_linear.weight"),
    ("outlayer_bias.pt", "output_linear.bias"),
    ("actions_mean.pt", "actions_mean"),
    ("actions_std.pt", "actions_std"),
)


class CheckpointError(ValueError):
    """The checkpoint is not a usable LPAC network. The text names the tensor and the cause."""


@dataclass(frozen=True, slots=True, eq=False)
class Linear:
    """weight (out, in), bias (out,)."""

    weight: F32
    bias: F32


@dataclass(frozen=True, slots=True, eq=False)
class BatchNorm:
    """weight, bias, mean and variance, each (features,)."""

    weight: F32
    bias: F32
    mean: F32
    variance: F32


@dataclass(frozen=True, slots=True, eq=False)
class Convolution:
    """weight (out, in, kernel, kernel), bias (out,); no padding, stride 1."""

    weight: F32
    bias: F32
    norm: BatchNorm


@dataclass(frozen=True, slots=True, eq=False)
class Cnn:
    """Convolutions with batch norm and leaky ReLU, then `linear` and a leaky ReLU."""

    convolutions: tuple[Convolution, ...]
    linear: Linear
    channels: int
    image_size: int


@dataclass(frozen=True, slots=True, eq=False)
class GnnLayer:
    """taps (K + 1, F_{l-1}, F_l), H_lk in the paper; bias (F_l,). A ReLU follows."""

    taps: F32
    bias: F32


@dataclass(frozen=True, slots=True, eq=False)
class ActionNetwork:
    """Hidden layers with batch norm and ReLU, then two linear layers without activation.

    The velocity is the output times `std` (2,) plus `mean` (2,), in model units/s.
    """

    hidden: tuple[tuple[Linear, BatchNorm], ...]
    last: Linear
    output: Linear
    mean: F32
    std: F32


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoint:
    """A trained network, all weights float32 and finite. `cnn` is None if the source has none.

    `sha256` is the file's; for a folder, the output of `sha256sum *.pt | sha256sum`.
    """

    geometry: Geometry
    cnn: Cnn | None
    gnn: tuple[GnnLayer, ...]
    action: ActionNetwork
    sha256: str


@dataclass(frozen=True, slots=True)
class _Source:
    """Tensors by their names in a state dict; `name` maps these to the source's own names."""

    path: Path
    tensors: Mapping[str, torch.Tensor]
    name: Callable[[str], str]
    has_cnn: bool
    sha256: str

    def error(self, name: str, found: str, expected: str) -> CheckpointError:
        return CheckpointError(
            f"{self.path}: {self.name(name)}: found {found}, expected {expected}"
        )


def read_checkpoint(path: Path) -> Checkpoint:
    """Read a state dict file or a folder of tensors. All sizes follow from the tensors.

    Raises CheckpointError, one line with the file and the tensor's name in the source, if a tensor
    is missing, unknown, misshapen or not of finite floating point numbers, or if the file holds no
    LPAC network.
    """
    return _checkpoint(
        _read_folder(path) if path.is_dir() else _state_dict(path, _read_bytes(path))
    )


def parse_checkpoint(content: bytes, name: str) -> Checkpoint:
    """Like `read_checkpoint` for a file's content; `name` stands for the file in errors."""
    return _checkpoint(_state_dict(Path(name), content))


def checkpoint_tensors(content: bytes, name: str) -> dict[str, torch.Tensor]:
    """Check a state dict file and return its tensors by name. Raises CheckpointError."""
    source = _state_dict(Path(name), content)
    _checkpoint(source)
    return dict(source.tensors)


def _checkpoint(source: _Source) -> Checkpoint:
    layers = max(_count(source, r"gnn_backbone\.graph_conv_(\d+)\..*"), 1)
    taps = _count_taps(source)
    convolutions = max(_count(source, r"cnn_backbone\.conv(\d+)\..*"), 1) if source.has_cnn else 0
    mlp_layers = max(_count(source, r"gnn_mlp\.lins\.(\d+)\..*"), 1)

    layout = _layout(layers, taps, convolutions, mlp_layers)
    sizes = _sizes(layout, source.tensors)
    weights = _arrays(source, layout, sizes)

    def linear(name: str) -> Linear:
        return Linear(weights[f"{name}.weight"], weights[f"{name}.bias"])

    def norm(name: str) -> BatchNorm:
        return BatchNorm(*(weights[f"{name}.{part}"] for part in _NORM_PARTS))

    cnn = None
    if source.has_cnn:
        cnn = Cnn(
            convolutions=tuple(
                Convolution(
                    weights[f"cnn_backbone.conv{i}.weight"],
                    weights[f"cnn_backbone.conv{i}.bias"],
                    norm(f"cnn_backbone.batch_norm{i}"),
                )
                for i in range(convolutions)
            ),
            linear=linear("cnn_backbone.linear_1"),
            channels=_channels(source, sizes),
            image_size=_image_size(source, sizes, convolutions),
        )
    gnn = tuple(
        GnnLayer(
            np.stack(
                [weights[f"gnn_backbone.graph_conv_{i}.lins.{k}.weight"].T for k in range(taps)]
            ),
            weights[f"gnn_backbone.graph_conv_{i}.bias"],
        )
        for i in range(layers)
    )
    action = ActionNetwork(
        hidden=tuple(
            (linear(f"gnn_mlp.lins.{i}"), norm(f"gnn_mlp.norms.{i}.module"))
            for i in range(mlp_layers - 1)
        ),
        last=linear(f"gnn_mlp.lins.{mlp_layers - 1}"),
        output=linear("output_linear"),
        mean=weights["actions_mean"],
        std=weights["actions_std"],
    )
    features = (gnn[0].taps.shape[1], *(layer.taps.shape[2] for layer in gnn))
    return Checkpoint(Geometry(taps - 1, features), cnn, gnn, action, source.sha256)


def read_state_dict(path: Path) -> dict[str, torch.Tensor]:
    """Read a state dict of any module, alone or beside an optimiser's. Raises CheckpointError."""
    return _tensors(path, _read_bytes(path))


def write_state_dict(state: Mapping[str, torch.Tensor]) -> bytes:
    """Content of a state dict's file, for `torch.load`."""
    buffer = io.BytesIO()
    torch.save({name: tensor.detach().cpu() for name, tensor in state.items()}, buffer)
    return buffer.getvalue()


def parse_state_dict(content: bytes, name: str) -> dict[str, torch.Tensor]:
    """Like `read_state_dict` for a file's content; `name` stands for the file in errors."""
    return _tensors(Path(name), content)


def _tensors(path: Path, content: bytes) -> dict[str, torch.Tensor]:
    state = _load(content, path)
    if isinstance(state, dict):
        # Training programs often store it beside the optimiser and the epoch.
        wrapped = [state[key] for key in _STATE_DICT_KEYS if isinstance(state.get(key), dict)]
        state = wrapped[0] if wrapped else state
    if not isinstance(state, dict):
        raise CheckpointError(
            f"{path}: found a {type(state).__name__}, expected a state dict (tensors by name)"
        )
    for name, value in state.items():
        if not isinstance(name, str) or not isinstance(value, torch.Tensor):
            raise CheckpointError(
                f"{path}: {name}: found a {type(value).__name__}, expected tensors by name: "
                "save model.state_dict() alone"
            )
    return state


def _state_dict(path: Path, content: bytes) -> _Source:
    state = _tensors(path, content)
    # torch.compile prefixes the names of compiled parts, which may be all or some.
    prefix = _COMPILED_PREFIX if all(name.startswith(_COMPILED_PREFIX) for name in state) else ""
    source_names = {name.replace(_COMPILED_PREFIX, ""): name for name in state}
    if len(source_names) < len(state):
        (twice, _), *_ = Counter(name.replace(_COMPILED_PREFIX, "") for name in state).most_common(
            1
        )
        raise CheckpointError(
            f"{path}: {twice}: found with and without {_COMPILED_PREFIX}, expected once"
        )
    tensors = {name: state[source] for name, source in source_names.items()}
    if not any(name.startswith("gnn_backbone.") for name in tensors):
        inside = [found for name in tensors if (found := re.match(r"(.+\.)gnn_backbone\.", name))]
        if inside:
            raise CheckpointError(
                f"{path}: the tensors' names begin with {inside[0][1]!r}, so the network was part "
                "of another module: save the state dict of the network alone"
            )
        raise CheckpointError(
            f"{path}: found {len(state)} tensors ({', '.join([*state][:3])}, ...), expected those "
            "of an LPAC network, such as gnn_backbone.graph_conv_0.lins.0.weight"
        )
    sha256 = hashlib.sha256(content).hexdigest()
    return _Source(
        path,
        tensors,
        lambda name: source_names.get(name, prefix + name),
        has_cnn=True,
        sha256=sha256,
    )


def _read_folder(path: Path) -> _Source:
    tensors: dict[str, torch.Tensor] = {}
    listing = ""
    for file in sorted(path.iterdir(), key=lambda file: file.name):
        if file.name == "README.md":
            continue
        name = _translate(file.name, _FOLDER_NAMES)
        if name is None:
            raise CheckpointError(
                f"{path}: {file.name}: expected only tensors of an LPAC network "
                "(lin_<layer>_<hop>.pt, bias_<layer>.pt, mlp_lin_<layer>.pt, ...)"
            )
        content = _read_bytes(file)
        tensor = _load(content, file)
        if not isinstance(tensor, torch.Tensor):
            raise CheckpointError(f"{file}: found a {type(tensor).__name__}, expected a tensor")
        tensors[name] = tensor
        listing += f"{hashlib.sha256(content).hexdigest()}  {file.name}\n"

    def file_name(name: str) -> str:
        return _translate(name, ((there, here) for here, there in _FOLDER_NAMES)) or name

    sha256 = hashlib.sha256(listing.encode()).hexdigest()
    return _Source(path, tensors, file_name, has_cnn=False, sha256=sha256)


def _translate(name: str, templates: Iterable[tuple[str, str]]) -> str | None:
    for template, translation in templates:
        pattern = re.escape(template).replace(r"\{\}", "([0-9]+)")
        if match := re.fullmatch(pattern, name):
            return translation.format(*match.groups())
    return None


def _read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise CheckpointError(f"{path}: {in_words(error)}") from None


def _load(content: bytes, path: Path) -> object:
    """Load tensors and plain containers, nothing else."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the error below says the same
            loaded: object = torch.load(io.BytesIO(content), "cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        kind = re.search(r"GLOBAL (\S+)", str(error))
        if kind is None:
            raise CheckpointError(f"{path}: found no torch file, expected a state dict") from None
        raise CheckpointError(
            f"{path}: found a pickled {kind[1]}, expected tensors: save model.state_dict() alone"
        ) from None
    except Exception:  # torch raises many types for unreadable files
        raise CheckpointError(f"{path}: found no torch file, expected a state dict") from None
    return loaded


def _count(source: _Source, pattern: str) -> int:
    """One more than the highest number matched by `pattern`. A gap shows as a missing tensor."""
    matches = (re.fullmatch(pattern, name, re.ASCII) for name in source.tensors)
    numbers = [int(match[1]) for match in matches if match and len(match[1]) < 9]
    # Numbers beyond the number of tensors also leave a gap below it.
    return min(max(numbers, default=-1) + 1, len(source.tensors))


def _count_taps(source: _Source) -> int:
    """K + 1 of most layers (the larger one in a tie), at least 2."""
    matches = (re.fullmatch(r"gnn_backbone\.(\w+)\.lins\..*", name) for name in source.tensors)
    taps_of_layer = Counter(match[1] for match in matches if match)
    layers_with = Counter(taps_of_layer.values())
    usual = max(layers_with, key=lambda taps: (layers_with[taps], taps), default=0)
    return max(usual, 2)


_Layout = dict[str, tuple[str | int, ...]]


def _layout(layers: int, taps: int, convolutions: int, mlp_layers: int) -> _Layout:
    """All tensors with their shapes: numbers, names of sizes, or a name plus a number."""
    layout: _Layout = {}

    def norm(name: str, size: str) -> None:
        layout.update({f"{name}.{part}": (size,) for part in _NORM_PARTS})

    for i in range(convolutions):
        inputs = f"conv{i - 1}" if i else "channels"
        layout[f"cnn_backbone.conv{i}.weight"] = (f"conv{i}", inputs, "kernel", "kernel")
        layout[f"cnn_backbone.conv{i}.bias"] = (f"conv{i}",)
        norm(f"cnn_backbone.batch_norm{i}", f"conv{i}")
    if convolutions:
        layout["cnn_backbone.linear_1.weight"] = ("features", "pixels")
        layout["cnn_backbone.linear_1.bias"] = ("features",)
    for i in range(layers):
        inputs = f"gnn{i - 1}" if i else f"features+{POSITION_SIZE}"
        for k in range(taps):
            layout[f"gnn_backbone.graph_conv_{i}.lins.{k}.weight"] = (f"gnn{i}", inputs)
        layout[f"gnn_backbone.graph_conv_{i}.bias"] = (f"gnn{i}",)
    for i in range(mlp_layers):
        inputs = f"mlp{i - 1}" if i else f"gnn{layers - 1}"
        layout[f"gnn_mlp.lins.{i}.weight"] = (f"mlp{i}", inputs)
        layout[f"gnn_mlp.lins.{i}.bias"] = (f"mlp{i}",)
        if i < mlp_layers - 1:
            norm(f"gnn_mlp.norms.{i}.module", f"mlp{i}")
    layout["output_linear.weight"] = (ACTION_SIZE, f"mlp{mlp_layers - 1}")
    layout["output_linear.bias"] = (ACTION_SIZE,)
    layout["actions_mean"] = (ACTION_SIZE,)
    layout["actions_std"] = (ACTION_SIZE,)
    return layout


def _sizes(layout: _Layout, tensors: Mapping[str, torch.Tensor]) -> dict[str, int]:
    """The value of each named size in most of its tensors, so that errors name the odd one out."""
    votes: dict[str, Counter[int]] = {}
    for name, shape in layout.items():
        if name in tensors and tensors[name].dim() == len(shape):
            for size, number in zip(shape, tensors[name].shape, strict=True):
                if isinstance(size, str):
                    symbol, _, extra = size.partition("+")
                    votes.setdefault(symbol, Counter())[number - int(extra or 0)] += 1
    return {symbol: counter.most_common(1)[0][0] for symbol, counter in votes.items()}


def _shape(shape: tuple[str | int, ...], sizes: Mapping[str, int]) -> list[int | None]:
    """`shape` in numbers; None where no tensor of the right rank gives the number."""
    numbers: list[int | None] = []
    for size in shape:
        if isinstance(size, int):
            numbers.append(size)
        else:
            symbol, _, extra = size.partition("+")
            numbers.append(sizes[symbol] + int(extra or 0) if symbol in sizes else None)
    return numbers


def _arrays(source: _Source, layout: _Layout, sizes: Mapping[str, int]) -> dict[str, F32]:
    shapes = {name: _shape(shape, sizes) for name, shape in layout.items()}
    for name, shape in shapes.items():
        if name not in source.tensors:
            raise source.error(name, "no such tensor", f"one of shape {_shape_text(shape)}")
    norms = {name.rpartition(".")[0] for name in layout if name.endswith("running_var")}
    ignored = {f"{norm}.{_IGNORED_PART}" for norm in norms}
    for name in sorted(source.tensors.keys() - layout.keys() - ignored):
        found = f"a tensor of shape {_shape_text(source.tensors[name].shape)}"
        raise source.error(name, found, "no tensor of that name in this LPAC network")
    return {name: _array(source, name, shape) for name, shape in shapes.items()}


def _array(source: _Source, name: str, shape: list[int | None]) -> F32:
    tensor = source.tensors[name].detach()
    if not tensor.is_floating_point() or tensor.layout != torch.strided or tensor.is_meta:
        found = f"{tensor.dtype}, {tensor.layout}, on {tensor.device}"
        raise source.error(name, found, "dense floating point numbers")
    if list(tensor.shape) != shape or 0 in shape:
        raise source.error(name, f"shape {_shape_text(tensor.shape)}", _shape_text(shape))
    array: F32 = tensor.to(torch.float32).contiguous().numpy()
    if not np.isfinite(array).all():
        found = "NaN" if np.isnan(array).any() else "infinity (in float32)"
        raise source.error(name, found, "finite numbers")
    if name.endswith("running_var") and array.min() < 0:
        raise source.error(name, f"{array.min():g}", "variances of at least 0")
    return array


def _shape_text(shape: Iterable[int | None]) -> str:
    return f"[{', '.join('*' if size is None else str(size) for size in shape)}]"


def _channels(source: _Source, sizes: Mapping[str, int]) -> int:
    if sizes["channels"] not in MAP_CHANNELS:
        allowed = " or ".join(map(str, MAP_CHANNELS))
        raise source.error(
            "cnn_backbone.conv0.weight", f"{sizes['channels']} map channels", allowed
        )
    return sizes["channels"]


def _image_size(source: _Source, sizes: Mapping[str, int], convolutions: int) -> int:
    """Side of the square input images: each convolution removes a border of kernel - 1."""
    channels = sizes[f"conv{convolutions - 1}"]
    side = math.isqrt(sizes["pixels"] // channels)
    if channels * side**2 != sizes["pixels"]:
        shape = source.tensors["cnn_backbone.linear_1.weight"].shape
        expected = f"[{sizes['features']}, {channels} * n * n] for square images"
        raise source.error("cnn_backbone.linear_1.weight", f"shape {_shape_text(shape)}", expected)
    return side + convolutions * (sizes["kernel"] - 1)
