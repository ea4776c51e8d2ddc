"""The golden vectors: their contents, and that every weight affects them."""

import io
import os
from collections.abc import Collection, Iterator
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from onnx import numpy_helper

from edge.policy.lpac.manifest import CNN
from export import network
from export.checkpoint import Checkpoint, CheckpointError, read_checkpoint
from export.golden import golden_vectors
from export.graphs import build_graphs
from tests.conftest import ROOT
from tests.published import AUTHORS_TAPS
from tests.unit.export.onnx_graphs import relative_error, run_graph
from tests.unit.export.states import State, random_state

POLICY = ROOT / "policies" / "lpac_l2_k3_n10_512.pt"
TOLERANCE = 1e-5


def golden_of(checkpoint: Checkpoint) -> dict[str, np.ndarray]:
    return dict(np.load(io.BytesIO(golden_vectors(checkpoint)), allow_pickle=False))


def random_checkpoint(folder: Path, **sizes: int) -> Checkpoint:
    torch.save(random_state(**sizes), folder / "model.pt")
    return read_checkpoint(folder / "model.pt")


def scaled_weights(content: bytes, taps: int) -> Iterator[tuple[str, bytes]]:
    """The graph with one of its tensors or taps times 1.01, for each of them."""
    model = onnx.load_model_from_string(content)
    for tensor in model.graph.initializer:
        original = tensor.raw_data
        parts = taps if tensor.name == "taps" else 1
        for part in range(parts):
            values = numpy_helper.to_array(tensor).copy()
            np.array_split(values, parts)[part][:] *= np.float32(1.01)
            tensor.raw_data = values.tobytes()
            yield f"{tensor.name} {part}", model.SerializeToString()
            tensor.raw_data = original


def assert_every_tensor_shows(
    checkpoint: Checkpoint, excepted: Collection[tuple[str, str]] = ()
) -> None:
    golden = golden_of(checkpoint)
    for name, content in build_graphs(checkpoint).items():
        inputs, truth = golden[f"{name}/input"], golden[f"{name}/output"]
        for tensor, altered in scaled_weights(content, checkpoint.geometry.hops + 1):
            if (name, tensor) not in excepted:
                assert relative_error(run_graph(altered, inputs), truth) > 1.5 * TOLERANCE, tensor


@pytest.mark.parametrize("kind", ["shipped", "random", "explored"])
def test_every_tensor_of_a_graph_shows(kind: str, tmp_path: Path) -> None:
    if kind == "random":
        checkpoint = random_checkpoint(tmp_path, layers=5, hops=3)
    elif kind == "explored":
        checkpoint = random_checkpoint(tmp_path, channels=5)
    else:
        checkpoint = read_checkpoint(POLICY)
    assert_every_tensor_shows(checkpoint)


def test_every_tensor_of_the_authors_taps_shows(authors_taps: Path) -> None:
    # The mean velocity that they published is 0.5 mm/s, of 5 m/s.
    published = os.environ.get(AUTHORS_TAPS) == str(authors_taps)
    excepted = [("action.onnx", "bias_1 0")] if published else []
    assert_every_tensor_shows(read_checkpoint(authors_taps), excepted)


def test_every_tensor_of_the_shipped_checkpoint_shows(tmp_path: Path) -> None:
    golden = golden_of(read_checkpoint(POLICY))
    state: State = torch.load(POLICY, "cpu", weights_only=True)
    for name, tensor in state.items():
        if not name.endswith("num_batches_tracked"):
            torch.save({**state, name: tensor * 1.01}, tmp_path / "altered.pt")
            graphs = build_graphs(read_checkpoint(tmp_path / "altered.pt"))
            caught = [
                relative_error(run_graph(content, golden[f"{graph}/input"]), truth)
                > 1.5 * TOLERANCE
                for graph, content in graphs.items()
                for truth in [golden[f"{graph}/output"]]
                if graph != CNN or name.startswith("cnn_backbone.")
            ]
            assert sum(caught) == 1, name


def test_a_tap_that_is_very_small_shows(tmp_path: Path) -> None:
    state = random_state(layers=2, hops=3)
    name = "gnn_backbone.graph_conv_1.lins.2.weight"
    torch.save({**state, name: state[name] * 1e-12}, tmp_path / "model.pt")
    checkpoint = read_checkpoint(tmp_path / "model.pt")
    golden = golden_of(checkpoint)
    for tensor, altered in scaled_weights(build_graphs(checkpoint)["gnn_2.onnx"], 4):
        output = run_graph(altered, golden["gnn_2.onnx/input"])
        assert relative_error(output, golden["gnn_2.onnx/output"]) > 1.5 * TOLERANCE, tensor


@pytest.mark.parametrize("bias", [0.0, -0.1, 1e-30])
def test_biases_that_silence_a_layer_leave_a_measure(bias: float, tmp_path: Path) -> None:
    state = random_state(layers=1, hops=1)
    for name in [name for name in state if name.startswith("gnn_") and name.endswith("bias")]:
        state[name] = torch.full_like(state[name], bias)
    torch.save(state, tmp_path / "model.pt")
    checkpoint = read_checkpoint(tmp_path / "model.pt")
    golden = golden_of(checkpoint)
    for name, content in build_graphs(checkpoint).items():
        truth = golden[f"{name}/output"]
        assert relative_error(run_graph(content, golden[f"{name}/input"]), truth) < TOLERANCE


def test_swarm_holds_every_kind_of_neighbourhood(tmp_path: Path) -> None:
    golden = golden_of(random_checkpoint(tmp_path, layers=2, hops=3))
    neighbours = golden["swarm/neighbours"]
    assert neighbours.dtype == np.bool_
    assert (neighbours == neighbours.T).all() and not neighbours.diagonal().any()
    degrees = neighbours.sum(axis=1)
    assert set(degrees) == {0, 1, 2, 3, 4, 5, 6}
    assert golden["swarm/features"].shape == (10, 10)
    assert golden["swarm/velocities"].shape == (2 * 3 + 1, 10, 2)
    others = {name: array for name, array in golden.items() if name != "swarm/neighbours"}
    assert all(array.dtype == np.float32 for array in others.values())


@pytest.mark.parametrize(("layers", "hops"), [(1, 1), (2, 3), (5, 3)])
def test_swarm_reaches_the_centralised_network_after_all_rounds_and_not_before(
    layers: int, hops: int, tmp_path: Path
) -> None:
    checkpoint = random_checkpoint(tmp_path, layers=layers, hops=hops)
    golden = golden_of(checkpoint)
    shift = network.shift_operator(torch.from_numpy(golden["swarm/neighbours"]))
    features = torch.from_numpy(golden["swarm/features"]).double()
    whole = network.centralised(checkpoint, shift, features).numpy()
    velocities = golden["swarm/velocities"]
    assert relative_error(velocities[-1], whole) < 1e-6
    assert relative_error(velocities[-2], whole) > 1e-6
    alone = golden["swarm/neighbours"].sum(axis=1) == 0
    np.testing.assert_array_equal(velocities[0, alone], velocities[-1, alone])


def test_weights_beyond_float32_are_refused(tmp_path: Path) -> None:
    state = random_state()
    for name in ("actions_std", "output_linear.weight"):
        state[name] *= 1e30
    torch.save(state, tmp_path / "model.pt")
    with pytest.raises(CheckpointError, match=r"action\.onnx: outputs overflow float32"):
        golden_vectors(read_checkpoint(tmp_path / "model.pt"))
