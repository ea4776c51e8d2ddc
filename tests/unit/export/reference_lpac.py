"""The reference implementation of the network, for tests only: CoverageControl's LPAC (GPL)."""

import gc
import sys
import warnings
from collections.abc import Mapping
from importlib import import_module
from importlib.machinery import PathFinder
from pathlib import Path
from types import ModuleType

import pytest
import torch

_PACKAGE = "tests_reference_lpac"

# Imported before any test runs: it opens a socket and leaves it to the garbage collector.
with warnings.catch_warnings(action="ignore", category=ResourceWarning):
    if PathFinder.find_spec("torch_geometric") is not None:
        import_module("torch_geometric")
    gc.collect()


def reference_lpac(state: Mapping[str, torch.Tensor], image_size: int) -> torch.nn.Module:
    """`coverage_control.nn.LPAC` with these weights, in evaluation mode; skips if not installed.

    Only the model's own files are imported, under another name: the package around them needs
    torchvision, and other tests import parts of it differently.
    """
    spec = PathFinder.find_spec("coverage_control")
    if spec is None or spec.origin is None:
        pytest.skip("coverage_control is not installed (Python 3.11 on x86-64 only)")
    pytest.importorskip("torch_geometric")
    if _PACKAGE not in sys.modules:
        package = ModuleType(_PACKAGE)
        package.__path__ = [str(Path(spec.origin).parent / "nn" / "models")]
        sys.modules[_PACKAGE] = package
    convolution = state["cnn_backbone.conv0.weight"]
    tap = state["gnn_backbone.graph_conv_0.lins.0.weight"]
    cnn = {
        "InputDim": convolution.shape[1],
        "LatentSize": convolution.shape[0],
        "KernelSize": convolution.shape[2],
        "NumLayers": _count(state, "cnn_backbone.conv{}.weight"),
        "ImageSize": image_size,
        "OutputDim": 7,
    }
    gnn = {
        "InputDim": tap.shape[1],
        "LatentSize": tap.shape[0],
        "NumHops": _count(state, "gnn_backbone.graph_conv_0.lins.{}.weight") - 1,
        "NumLayers": _count(state, "gnn_backbone.graph_conv_{}.bias"),
        "OutputDim": 2,
    }
    lpac = import_module(f"{_PACKAGE}.lpac").LPAC
    model: torch.nn.Module = lpac({"CNNBackBone": cnn, "GNNBackBone": gnn})
    model.load_state_dict(state)
    return model.eval()


def _count(state: Mapping[str, torch.Tensor], name: str) -> int:
    return sum(name.format(number) in state for number in range(len(state)))
