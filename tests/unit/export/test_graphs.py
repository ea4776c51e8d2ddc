"""The ONNX graphs against the torch network, the reference LPAC, and torch_geometric's TAGConv."""

import io
from pathlib import Path
from typing import Any, cast

import numpy as np
import onnx
import pytest
import torch

from edge.policy.lpac.manifest import ACTION, CNN, gnn_graph
from export import network
from export.checkpoint import Checkpoint, read_checkpoint
from export.golden import golden_vectors
from export.graphs import build_graphs
from tests.conftest import ROOT
from tests.unit.export.onnx_graphs import relative_error, run_graph
from tests.unit.export.reference_lpac import reference_lpac
from tests.unit.export.states import State, random_state

POLICY = ROOT / "policies" / "lpac_l2_k3_n10_512.pt"

TOLERANCE = 1e-5
# Other processors round sums in another order: keep this far below the tolerance.
MARGIN = 3

GEOMETRIES = [
    (layers, hops, latent) for layers in (1, 2, 5) for hops in (1, 3) for latent in (16, 256)
]
CNNS = [
    (channels, image_size, kernel, convolutions)
    for channels in (2, 4, 5)
    for image_size in (16, 32)
    for kernel in (3, 5)
    for convolutions in (2, 3)
]


def read_state(state: State, tmp_path: Path) -> Checkpoint:
    torch.save(state, tmp_path / "state.pt")
    return read_checkpoint(tmp_path / "state.pt")


def random_swarm(robots: int, checkpoint: Checkpoint) -> tuple[torch.Tensor, ...]:
    """Neighbours (N, N), images and positions in the network's form."""
    random = np.random.default_rng(robots)
    places = random.uniform(0, 1, (robots, 2))
    near = np.hypot(*(places[:, None] - places[None]).T) < 0.4
    np.fill_diagonal(near, False)
    assert checkpoint.cnn
    size = checkpoint.cnn.image_size
    images = random.uniform(0, 1, (robots, checkpoint.cnn.channels, size, size))
    values = (images, random.uniform(0.5, 1.5, (robots, 2)))
    return torch.from_numpy(near), *(torch.from_numpy(v.astype(np.float32)) for v in values)


def run_swarm(
    graphs: dict[str, bytes], checkpoint: Checkpoint, swarm: tuple[torch.Tensor, ...]
) -> np.ndarray:
    """Velocities (N, 2) of the centralised network, computed by the graphs alone."""
    near, images, positions = swarm
    shift = network.shift_operator(near).numpy()
    values = np.concatenate([run_graph(graphs[CNN], images.numpy()), positions.numpy()], axis=1)
    for layer in range(1, checkpoint.geometry.layers + 1):
        hops = [values]
        for _ in range(checkpoint.geometry.hops):
            hops.append((shift @ hops[-1]).astype(np.float32))
        values = run_graph(graphs[gnn_graph(layer)], np.stack(hops, axis=1))
    return run_graph(graphs[ACTION], values)


def assert_graphs_match_torch(checkpoint: Checkpoint) -> None:
    golden = np.load(io.BytesIO(golden_vectors(checkpoint)))
    for name, content in build_graphs(checkpoint).items():
        inputs, truth = golden[f"{name}/input"], golden[f"{name}/output"]
        alone = np.concatenate([run_graph(content, row[None]) for row in inputs[:3]])
        assert relative_error(run_graph(content, inputs), truth) * MARGIN < TOLERANCE, name
        assert relative_error(alone, truth[:3]) * MARGIN < TOLERANCE, name


def assert_graphs_match_lpac(state: State, image_size: int, checkpoint: Checkpoint) -> None:
    model = reference_lpac(state, image_size)
    data = pytest.importorskip("torch_geometric.data")
    swarm = random_swarm(10, checkpoint)
    near, images, positions = swarm
    with torch.no_grad():
        normalised = model(data.Data(x=images, edge_index=near.nonzero().T, pos=positions))
    truth = (normalised * state["actions_std"] + state["actions_mean"]).numpy()
    graphs = build_graphs(checkpoint)
    assert relative_error(run_swarm(graphs, checkpoint, swarm), truth) < TOLERANCE
    assert checkpoint.cnn
    with torch.no_grad():
        features = cast("torch.nn.Module", model.cnn_backbone)(images).numpy()
    assert relative_error(run_graph(graphs[CNN], images.numpy()), features) < TOLERANCE


@pytest.mark.parametrize(("layers", "hops", "latent"), GEOMETRIES)
def test_gnn_and_action_match_torch_and_the_reference(
    layers: int, hops: int, latent: int, tmp_path: Path
) -> None:
    state = random_state(layers, hops, latent, seed=layers + hops + latent)
    checkpoint = read_state(state, tmp_path)
    assert checkpoint.geometry.hops == hops
    assert checkpoint.geometry.feature_sizes == (10, *[latent] * layers)
    assert_graphs_match_torch(checkpoint)
    assert_graphs_match_lpac(state, 16, checkpoint)


@pytest.mark.parametrize(("channels", "image_size", "kernel", "convolutions"), CNNS)
def test_cnn_matches_torch_and_the_reference(
    channels: int, image_size: int, kernel: int, convolutions: int, tmp_path: Path
) -> None:
    state = random_state(
        channels=channels, image_size=image_size, kernel=kernel, convolutions=convolutions
    )
    checkpoint = read_state(state, tmp_path)
    assert checkpoint.cnn
    assert (checkpoint.cnn.channels, checkpoint.cnn.image_size) == (channels, image_size)
    assert_graphs_match_torch(checkpoint)
    assert_graphs_match_lpac(state, image_size, checkpoint)


def test_freshly_initialised_reference_matches(tmp_path: Path) -> None:
    torch.manual_seed(3)
    model = reference_lpac(random_state(layers=5, hops=3, latent=256), 16)
    for module in model.modules():
        reset = getattr(module, "reset_parameters", None)
        if reset is not None:
            reset()
    state = {name: tensor.detach() for name, tensor in model.state_dict().items()}
    checkpoint = read_state(state, tmp_path)
    assert_graphs_match_torch(checkpoint)
    assert_graphs_match_lpac(state, 16, checkpoint)


def test_shipped_policy_matches() -> None:
    checkpoint = read_checkpoint(POLICY)
    state = torch.load(POLICY, "cpu", weights_only=True)
    assert_graphs_match_torch(checkpoint)
    assert_graphs_match_lpac(state, 32, checkpoint)


def test_authors_taps_match_torch_and_tagconv(authors_taps: Path) -> None:
    checkpoint = read_checkpoint(authors_taps)
    assert checkpoint.cnn is None
    assert checkpoint.geometry.hops == 3
    assert checkpoint.geometry.feature_sizes == (34, 256, 256, 256, 256, 256)
    assert_graphs_match_torch(checkpoint)

    geometric = pytest.importorskip("torch_geometric.nn")
    graphs = build_graphs(checkpoint)
    assert CNN not in graphs
    random = np.random.default_rng(0)
    near = np.triu(random.uniform(0, 1, (10, 10)) < 0.4, 1)
    edges = torch.from_numpy(near | near.T).nonzero().T
    shift = network.shift_operator(torch.from_numpy(near | near.T)).numpy()
    values = random.standard_normal((10, 34)).astype(np.float32)
    truth = torch.from_numpy(values)
    for i in range(5):
        layer = geometric.TAGConv(truth.shape[1], 256, K=3)
        layer.load_state_dict(
            {
                "bias": torch.load(authors_taps / f"bias_{i}.pt", "cpu", weights_only=True),
                **{
                    f"lins.{k}.weight": torch.load(
                        authors_taps / f"lin_{i}_{k}.pt", "cpu", weights_only=True
                    )
                    for k in range(4)
                },
            }
        )
        with torch.no_grad():
            truth = layer(truth, edges).relu()
        hops = [values]
        for _ in range(3):
            hops.append((shift @ hops[-1]).astype(np.float32))
        values = run_graph(graphs[gnn_graph(i + 1)], np.stack(hops, axis=1))
        assert relative_error(values, truth.numpy()) < TOLERANCE


def test_graphs_are_clean(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    checkpoint = read_state(random_state(), tmp_path)
    shapes: dict[str, tuple[list[Any], list[Any]]] = {
        CNN: (["batch", 4, 16, 16], ["batch", 8]),
        "gnn_1.onnx": (["batch", 2, 10], ["batch", 16]),
        "gnn_2.onnx": (["batch", 2, 16], ["batch", 16]),
        ACTION: (["batch", 16], ["batch", 2]),
    }
    graphs = build_graphs(checkpoint)
    assert list(graphs) == list(shapes)
    for name, content in graphs.items():
        model = onnx.load_model_from_string(content)
        onnx.checker.check_model(model, full_check=True)
        inferred = onnx.shape_inference.infer_shapes(
            model, check_type=True, strict_mode=True, data_prop=True
        )
        values = [*inferred.graph.input, *inferred.graph.value_info, *inferred.graph.output]
        assert len(values) == len(model.graph.node) + 1
        sizes = [[d.dim_param or d.dim_value for d in v.type.tensor_type.shape.dim] for v in values]
        assert (sizes[0], sizes[-1]) == shapes[name]
        assert all(size[0] == "batch" and 0 not in size for size in sizes)
        assert (model.opset_import[0].version, model.ir_version) == (20, 10)
        assert (model.producer_name, model.producer_version) == ("lpac-edge", "")
        assert not model.metadata_props
        assert not model.doc_string
        kinds = {tensor.data_type for tensor in model.graph.initializer}
        assert kinds == {onnx.TensorProto.FLOAT}
        assert all(tensor.raw_data for tensor in model.graph.initializer)
        for text in (b"torch", b"/", str(tmp_path).encode()):
            assert text not in _without_weights(model)
        run_graph(content, np.zeros((3, *shapes[name][0][1:]), np.float32))
    assert capfd.readouterr().err == ""  # onnxruntime's warnings


def _without_weights(model: onnx.ModelProto) -> bytes:
    for tensor in model.graph.initializer:
        tensor.ClearField("raw_data")
    rest: bytes = model.SerializeToString()
    return rest


def test_taps_can_be_told_apart(tmp_path: Path) -> None:
    state = random_state(layers=1, hops=3)
    graphs = build_graphs(read_state(state, tmp_path))
    model = onnx.load_model_from_string(graphs[gnn_graph(1)])
    (taps,) = (
        onnx.numpy_helper.to_array(tensor)
        for tensor in model.graph.initializer
        if tensor.name == "taps"
    )
    for k, tap in enumerate(taps.reshape(4, 10, 16)):
        expected = state[f"gnn_backbone.graph_conv_0.lins.{k}.weight"].numpy().T
        np.testing.assert_array_equal(tap, expected)


def test_action_networks_of_other_depths(tmp_path: Path) -> None:
    deep, shallow = random_state(), random_state()
    for name in [name for name in deep if name.startswith("gnn_mlp.") and ".0." in name]:
        del shallow[name]
    shallow["gnn_mlp.lins.0.weight"] = torch.randn(
        32, 16, generator=torch.Generator().manual_seed(0)
    )
    shallow["gnn_mlp.lins.0.bias"] = shallow.pop("gnn_mlp.lins.1.bias")
    del shallow["gnn_mlp.lins.1.weight"]
    for name in [name for name in deep if name.startswith("gnn_mlp.norms.0.")]:
        deep[name.replace(".0.", ".1.")] = deep[name].flip(0) if deep[name].dim() else deep[name]
    deep["gnn_mlp.lins.2.weight"] = deep["gnn_mlp.lins.1.weight"].T
    deep["gnn_mlp.lins.2.bias"] = deep["gnn_mlp.lins.1.bias"].flip(0)
    for state, hidden in ((shallow, 0), (deep, 2)):
        checkpoint = read_state(state, tmp_path)
        assert len(checkpoint.action.hidden) == hidden
        assert_graphs_match_torch(checkpoint)


def test_same_checkpoint_gives_the_same_bytes(tmp_path: Path) -> None:
    checkpoint = read_state(random_state(), tmp_path)
    again = read_state(random_state(), tmp_path)
    assert build_graphs(checkpoint) == build_graphs(again)
    assert golden_vectors(checkpoint) == golden_vectors(again)
