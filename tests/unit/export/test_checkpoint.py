"""Reading checkpoints: accepted forms, and one-line errors for all others."""

import hashlib
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from export.checkpoint import Checkpoint, CheckpointError, read_checkpoint
from export.graphs import build_graphs
from tests.unit.export.states import State, random_state, tap_folder

TAP = "gnn_backbone.graph_conv_1.lins.1.weight"
NORM = "cnn_backbone.batch_norm0"


@pytest.fixture
def state() -> State:
    return random_state()


def read(content: object, folder: Path) -> Checkpoint:
    torch.save(content, folder / "model.pt")
    return read_checkpoint(folder / "model.pt")


def error_of(content: object, folder: Path) -> str:
    with pytest.raises(CheckpointError) as error:
        read(content, folder)
    text = str(error.value)
    assert "\n" not in text
    assert text.startswith(f"{folder / 'model.pt'}: ")
    return text.removeprefix(f"{folder / 'model.pt'}: ")


def test_every_size_is_read_from_the_tensors(tmp_path: Path) -> None:
    shape = {"channels": 2, "image_size": 20, "kernel": 5, "convolutions": 3, "cnn_latent": 6}
    checkpoint = read(random_state(layers=3, hops=2, latent=12, **shape), tmp_path)
    assert checkpoint.geometry.hops == 2
    assert checkpoint.geometry.feature_sizes == (8, 12, 12, 12)
    assert checkpoint.cnn
    assert (checkpoint.cnn.channels, checkpoint.cnn.image_size) == (2, 20)
    assert [layer.weight.shape[1:] for layer in checkpoint.cnn.convolutions] == [
        (2, 5, 5),
        (6, 5, 5),
        (6, 5, 5),
    ]
    content = (tmp_path / "model.pt").read_bytes()
    assert checkpoint.sha256 == hashlib.sha256(content).hexdigest()


def test_prefix_of_torch_compile_is_taken_off(state: State, tmp_path: Path) -> None:
    plain = read(state, tmp_path)
    compiled = read({f"_orig_mod.{name}": tensor for name, tensor in state.items()}, tmp_path)
    assert build_graphs(plain) == build_graphs(compiled)


def test_a_compiled_part_is_read_too(state: State, tmp_path: Path) -> None:
    compiled = {
        name.replace("gnn_backbone.", "gnn_backbone._orig_mod."): tensor
        for name, tensor in state.items()
    }
    np.testing.assert_array_equal(
        read(compiled, tmp_path).gnn[0].taps, read(state, tmp_path).gnn[0].taps
    )
    both = {**state, "_orig_mod.actions_mean": state["actions_mean"]}
    assert "actions_mean: found with and without _orig_mod." in error_of(both, tmp_path)


def test_errors_use_the_names_of_the_source(state: State, tmp_path: Path) -> None:
    compiled = {f"_orig_mod.{name}": tensor for name, tensor in state.items()}
    del compiled[f"_orig_mod.{TAP}"]
    assert error_of(compiled, tmp_path).startswith(f"_orig_mod.{TAP}: found no such tensor")


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16, torch.bfloat16])
def test_other_floating_types_become_float32(
    dtype: torch.dtype, state: State, tmp_path: Path
) -> None:
    converted = {
        name: tensor.to(dtype) if tensor.is_floating_point() else tensor
        for name, tensor in state.items()
    }
    checkpoint = read(converted, tmp_path)
    assert checkpoint.gnn[1].taps.dtype == np.float32
    np.testing.assert_array_equal(checkpoint.gnn[1].taps[1], converted[TAP].float().numpy().T)


def test_batch_counts_and_parameters_do_not_matter(state: State, tmp_path: Path) -> None:
    graphs = build_graphs(read(state, tmp_path))
    uncounted = {
        name: torch.nn.Parameter(tensor)
        for name, tensor in state.items()
        if not name.endswith("num_batches_tracked")
    }
    assert build_graphs(read(uncounted, tmp_path)) == graphs


def test_every_missing_tensor_is_named_with_its_shape(state: State, tmp_path: Path) -> None:
    for name, tensor in state.items():
        if not name.endswith("num_batches_tracked"):
            rest = {other: values for other, values in state.items() if other != name}
            text = error_of(rest, tmp_path)
            assert text.startswith(f"{name}: found no such tensor, expected one of shape [")
            # No other tensor gives the numbers of channels and of pixels.
            if name not in ("cnn_backbone.conv0.weight", "cnn_backbone.linear_1.weight"):
                assert text.endswith(str(list(tensor.shape))), text


def test_every_misshapen_tensor_is_named_with_both_shapes(state: State, tmp_path: Path) -> None:
    for name, tensor in state.items():
        if name.endswith("num_batches_tracked"):
            continue
        right = list(tensor.shape)
        for wrong in (torch.cat([tensor, tensor[:1]]), tensor[None], tensor[:0]):
            text = error_of({**state, name: wrong}, tmp_path)
            assert text.startswith(f"{name}: found shape {list(wrong.shape)}, expected ["), text
            if name not in ("cnn_backbone.conv0.weight", "cnn_backbone.linear_1.weight"):
                assert text.endswith(f"expected {right}"), text


def test_every_nan_is_found(state: State, tmp_path: Path) -> None:
    for name, tensor in state.items():
        if not name.endswith("num_batches_tracked"):
            broken = tensor.clone()
            broken.view(-1)[-1] = torch.nan
            text = error_of({**state, name: broken}, tmp_path)
            assert text == f"{name}: found NaN, expected finite numbers"


def changed(name: str, change: Callable[[torch.Tensor], Any]) -> Callable[[State], State]:
    return lambda state: {**state, name: change(state[name])}


def renamed(name: str, new_name: str) -> Callable[[State], State]:
    return lambda state: {
        (new_name if other == name else other): tensor for other, tensor in state.items()
    }


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (
            changed(TAP, lambda tap: tap / 0),
            f"{TAP}: found infinity (in float32), expected finite numbers",
        ),
        (
            changed(TAP, lambda tap: tap.double() * 1e300),
            f"{TAP}: found infinity (in float32), expected finite numbers",
        ),
        (
            changed(TAP, lambda tap: tap.int()),
            f"{TAP}: found torch.int32, torch.strided, on cpu, "
            "expected dense floating point numbers",
        ),
        (
            changed(TAP, lambda tap: tap.to_sparse()),
            f"{TAP}: found torch.float32, torch.sparse_coo, on cpu, "
            "expected dense floating point numbers",
        ),
        (
            changed(TAP, lambda tap: tap.to(torch.complex64)),
            f"{TAP}: found torch.complex64, torch.strided, on cpu, "
            "expected dense floating point numbers",
        ),
        (
            changed(f"{NORM}.running_var", lambda variance: variance - 3),
            rf"{NORM}.running_var: found -\d[.\d]*, expected variances of at least 0",
        ),
        (
            changed("cnn_backbone.conv0.weight", lambda weight: weight[:, :3]),
            "cnn_backbone.conv0.weight: found 3 map channels, expected 2 or 4 or 5 or 6",
        ),
        (
            changed("cnn_backbone.linear_1.weight", lambda weight: weight[:, 8:]),
            "cnn_backbone.linear_1.weight: found shape [8, 1144], "
            "expected [8, 8 * n * n] for square images",
        ),
        (
            changed("output_linear.weight", lambda weight: torch.cat([weight, weight])),
            "output_linear.weight: found shape [4, 32], expected [2, 32]",
        ),
        (
            lambda state: {**state, "gnn_backbone.graph_conv_1.scale": torch.ones(16)},
            "gnn_backbone.graph_conv_1.scale: found a tensor of shape [16], "
            "expected no tensor of that name in this LPAC network",
        ),
        (
            lambda state: {**state, "gnn_backbone.graph_conv_1.lins.3.weight": state[TAP]},
            "gnn_backbone.graph_conv_0.lins.2.weight: found no such tensor, "
            "expected one of shape [16, 10]",
        ),
        (
            renamed(TAP, "gnn_backbone.graph_conv_1.lins.2.weight"),
            f"{TAP}: found no such tensor, expected one of shape [16, 16]",
        ),
        (
            lambda state: {**state, "gnn_backbone.graph_conv_3.bias": torch.ones(16)},
            "gnn_backbone.graph_conv_2.lins.0.weight: found no such tensor, "
            "expected one of shape [*, 16]",
        ),
        (
            renamed(TAP, "gnn_backbone.graph_conv_1.lins.99999999.weight"),
            f"{TAP}: found no such tensor, expected one of shape [16, 16]",
        ),
        (
            lambda state: {
                name: tensor for name, tensor in state.items() if ".lins.1.weight" not in name
            },
            "gnn_backbone.graph_conv_0.lins.1.weight: found no such tensor, "
            "expected one of shape [16, 10]",
        ),
        (
            lambda state: {f"module.{name}": tensor for name, tensor in state.items()},
            "the tensors' names begin with 'module.', so the network was part of another module: "
            "save the state dict of the network alone",
        ),
    ],
)
def test_what_is_wrong_is_said_in_one_line(
    change: Callable[[State], State], line: str, state: State, tmp_path: Path
) -> None:
    text = error_of(change(state), tmp_path)
    assert text == line or re.fullmatch(line, text), text


@pytest.mark.parametrize(
    ("content", "line"),
    [
        ({}, "found 0 tensors"),
        ([torch.ones(2)], "found a list, expected a state dict"),
        (torch.ones(2), "found a Tensor, expected a state dict"),
        ({"fc.weight": torch.ones(2, 2)}, "found 1 tensors (fc.weight, ...), expected those of"),
        ({"model": {"a": torch.ones(2)}, "epoch": 3}, "model: found a dict, expected tensors"),
        ({3: torch.ones(2)}, "3: found a Tensor, expected tensors by name"),
        (torch.nn.Linear(2, 2), "found a pickled torch.nn.modules.linear.Linear, expected"),
    ],
)
def test_torch_files_that_hold_something_else(content: object, line: str, tmp_path: Path) -> None:
    assert error_of(content, tmp_path).startswith(line)


@pytest.mark.parametrize("key", ["state_dict", "model_state_dict"])
def test_a_state_dict_among_other_things_is_found(key: str, state: State, tmp_path: Path) -> None:
    torch.save({"epoch": 3, "optimizer": {"lr": 1e-3}, key: state}, tmp_path / "kept.pt")
    torch.save(state, tmp_path / "alone.pt")
    kept, alone = (read_checkpoint(tmp_path / name) for name in ("kept.pt", "alone.pt"))
    assert kept.geometry == alone.geometry
    np.testing.assert_array_equal(kept.gnn[0].taps, alone.gnn[0].taps)
    assert "model_state_dict: found a int" in error_of({"model_state_dict": 3}, tmp_path)


@pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")
def test_files_that_torch_cannot_read(state: State, tmp_path: Path) -> None:
    torch.save(state, tmp_path / "whole.pt")
    torch.jit.save(torch.jit.script(torch.nn.Linear(2, 2)), tmp_path / "script.pt")
    whole = (tmp_path / "whole.pt").read_bytes()
    (tmp_path / "cut.pt").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "empty.pt").write_bytes(b"")
    (tmp_path / "text.pt").write_text("not a checkpoint")
    for name in ("script.pt", "cut.pt", "empty.pt", "text.pt"):
        with pytest.raises(CheckpointError) as error:
            read_checkpoint(tmp_path / name)
        assert str(error.value) == (
            f"{tmp_path / name}: found no torch file, expected a state dict"
        )
    with pytest.raises(CheckpointError, match=r"absent\.pt: there is no such file or folder$"):
        read_checkpoint(tmp_path / "absent.pt")


def test_folder_of_tensors_gives_the_same_graphs_without_a_cnn(
    state: State, tmp_path: Path
) -> None:
    whole = build_graphs(read(state, tmp_path))
    folder = tap_folder(state, tmp_path / "taps")
    (folder / "README.md").write_text("about the tensors")
    checkpoint = read_checkpoint(folder)
    assert checkpoint.cnn is None
    del whole["cnn.onnx"]
    assert build_graphs(checkpoint) == whole

    shutil.copytree(folder, tmp_path / "copy")
    assert read_checkpoint(tmp_path / "copy").sha256 == checkpoint.sha256
    torch.save(torch.zeros(2), tmp_path / "copy" / "actions_mean.pt")
    assert read_checkpoint(tmp_path / "copy").sha256 != checkpoint.sha256


@pytest.mark.parametrize(
    ("file", "content", "line"),
    [
        ("lin_0_1.pt", None, "lin_0_1.pt: found no such tensor, expected one of shape [16, 10]"),
        ("mlp_norm_0_running_var.pt", None, "mlp_norm_0_running_var.pt: found no such tensor"),
        ("outlayer_wts.pt", torch.ones(3, 32), "outlayer_wts.pt: found shape [3, 32], expected"),
        ("lin_1_0.pt", torch.full((16, 16), torch.nan), "lin_1_0.pt: found NaN"),
        ("lin_3_0.pt", torch.ones(16, 16), "lin_2_0.pt: found no such tensor"),
        ("mlp_norm_1_weight.pt", torch.ones(32), "mlp_norm_1_weight.pt: found a tensor of shape"),
        ("cnn.pt", torch.ones(2), "cnn.pt: expected only tensors of an LPAC network"),
        ("notes.txt", torch.ones(2), "notes.txt: expected only tensors of an LPAC network"),
    ],
)
def test_folder_errors_name_the_file(
    file: str, content: torch.Tensor | None, line: str, state: State, tmp_path: Path
) -> None:
    folder = tap_folder(state, tmp_path / "taps")
    if content is None:
        (folder / file).unlink()
    else:
        torch.save(content, folder / file)
    with pytest.raises(CheckpointError) as error:
        read_checkpoint(folder)
    text = str(error.value)
    assert text.startswith(f"{folder}: {line}"), text
    assert "\n" not in text


def test_folders_that_are_no_checkpoint(state: State, tmp_path: Path) -> None:
    folder = tap_folder(state, tmp_path / "taps")
    torch.save({"weight": torch.ones(2)}, folder / "bias_0.pt")
    with pytest.raises(CheckpointError, match=r"bias_0\.pt: found a dict, expected a tensor$"):
        read_checkpoint(folder)
    (tmp_path / "empty").mkdir()
    with pytest.raises(CheckpointError, match=r"empty: lin_0_0\.pt: found no such tensor"):
        read_checkpoint(tmp_path / "empty")
