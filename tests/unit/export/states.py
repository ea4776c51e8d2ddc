"""Random LPAC state dicts of any geometry, with trained batch norms."""

import io
import math
import re
from pathlib import Path

import numpy as np
import torch

from edge.policy.bundle import Bundle
from export.checkpoint import parse_checkpoint
from export.exporter import bundle_of
from export.parameters import read_parameters

ROOT = Path(__file__).parents[3]
State = dict[str, torch.Tensor]

# File names of the paper's authors, one per tensor.
_AUTHORS_FILES = (
    (r"gnn_backbone\.graph_conv_(\d)\.lins\.(\d)\.weight", r"lin_\1_\2"),
    (r"gnn_backbone\.graph_conv_(\d)\.bias", r"bias_\1"),
    (r"gnn_mlp\.lins\.(\d)\.weight", r"mlp_lin_\1"),
    (r"gnn_mlp\.lins\.(\d)\.bias", r"mlp_bias_\1"),
    (r"gnn_mlp\.norms\.(\d)\.module\.(\w+)", r"mlp_norm_\1_\2"),
    (r"output_linear\.weight", "outlayer_wts"),
    (r"output_linear\.bias", "outlayer_bias"),
    (r"(actions_\w+)", r"\1"),
)


def random_state(
    layers: int = 2,
    hops: int = 1,
    latent: int = 16,
    channels: int = 4,
    image_size: int = 16,
    kernel: int = 3,
    convolutions: int = 2,
    cnn_latent: int = 8,
    seed: int = 0,
) -> State:
    """The keys and shapes of CoverageControl's LPAC module."""
    random = np.random.default_rng(seed)
    state: State = {}

    def put(name: str, values: np.ndarray) -> None:
        state[name] = torch.from_numpy(np.asarray(values, np.float32))

    def weight(name: str, *shape: int) -> None:
        bound = 1 / math.sqrt(math.prod(shape[1:]))
        put(name, random.uniform(-bound, bound, shape))

    def bias(name: str, size: int) -> None:
        put(name, random.uniform(-0.1, 0.1, size))

    def norm(name: str, size: int) -> None:
        put(f"{name}.weight", random.uniform(0.5, 1.5, size))
        put(f"{name}.bias", random.uniform(-0.3, 0.3, size))
        put(f"{name}.running_mean", random.uniform(-1, 1, size))
        put(f"{name}.running_var", random.uniform(0.1, 4, size))
        state[f"{name}.num_batches_tracked"] = torch.tensor(1)

    put("actions_mean", random.uniform(-0.1, 0.1, 2))
    put("actions_std", random.uniform(1, 3, 2))
    for i in range(convolutions):
        inputs = cnn_latent if i else channels
        weight(f"cnn_backbone.conv{i}.weight", cnn_latent, inputs, kernel, kernel)
        bias(f"cnn_backbone.conv{i}.bias", cnn_latent)
        norm(f"cnn_backbone.batch_norm{i}", cnn_latent)
    pixels = cnn_latent * (image_size - convolutions * (kernel - 1)) ** 2
    weight("cnn_backbone.linear_1.weight", cnn_latent, pixels)
    bias("cnn_backbone.linear_1.bias", cnn_latent)
    for i in range(layers):
        for k in range(hops + 1):
            inputs = latent if i else cnn_latent + 2
            weight(f"gnn_backbone.graph_conv_{i}.lins.{k}.weight", latent, inputs)
        bias(f"gnn_backbone.graph_conv_{i}.bias", latent)
    weight("gnn_mlp.lins.0.weight", 32, latent)
    bias("gnn_mlp.lins.0.bias", 32)
    norm("gnn_mlp.norms.0.module", 32)
    weight("gnn_mlp.lins.1.weight", 32, 32)
    bias("gnn_mlp.lins.1.bias", 32)
    weight("output_linear.weight", 2, 32)
    bias("output_linear.bias", 2)
    return state


def tap_folder(state: State, folder: Path) -> Path:
    """Write the state's GNN and action network in the form of the paper's authors."""
    folder.mkdir()
    for name, tensor in state.items():
        if not name.startswith("cnn_backbone."):
            [file] = [
                found.expand(to) for was, to in _AUTHORS_FILES if (found := re.fullmatch(was, name))
            ]
            torch.save(tensor, folder / f"{file}.pt")
    return folder


def random_bundle(**sizes: int) -> Bundle:
    """The bundle of a random state, with the shipped policy's perception."""
    content = io.BytesIO()
    torch.save(random_state(**sizes), content)
    parameters = read_parameters(ROOT / "policies" / "lpac_l2_k3_n10_512.toml")
    return bundle_of(parse_checkpoint(content.getvalue(), "random"), parameters, "random", {})
