"""The trained network equals the one that flies."""

import io
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from edge.core import F32, Bools
from edge.core.schema import ConfigError
from edge.policy.images import MAP_CHANNELS, PolicyImages
from edge.policy.lpac.manifest import LpacManifest
from edge.policy.lpac.policy import LpacPolicy, position_feature
from export import network
from export.checkpoint import parse_checkpoint
from export.parameters import read_parameters
from lpac.train.family import learnable, shift_operator
from lpac.train.lpac import LpacModule, LpacNetwork, lpac_network
from tests.conftest import ROOT, SHIPPED
from tests.unit.export.reference_lpac import reference_lpac

SMALL = LpacNetwork(image_size=12, cnn_channels=(6, 6), features=6, layers=2, hops=2, width=8)
MEAN, DEVIATION = np.array([0.1, -0.2], np.float32), np.array([1.5, 2.5], np.float32)


def drawn(sizes: LpacNetwork, seed: int = 0) -> LpacModule:
    """A module with trained batch norms."""
    torch.manual_seed(seed)
    module = sizes.module(MEAN, DEVIATION)
    for name, buffer in module.named_buffers():
        if name.endswith("running_mean"):
            buffer.normal_(0.0, 0.3)
        if name.endswith("running_var"):
            buffer.uniform_(0.5, 2.0)
    return module.eval()


def swarm(sizes: LpacNetwork, robots: int, seed: int = 0) -> tuple[dict[str, F32], Bools]:
    """Inputs and adjacency; the last robot is alone."""
    rng = np.random.default_rng(seed)
    adjacency = rng.random((robots, robots)) < 0.6
    adjacency = np.triu(adjacency, 1) | np.triu(adjacency, 1).T
    adjacency[-1] = adjacency[:, -1] = False
    shape = (robots, len(sizes.channels), sizes.image_size, sizes.image_size)
    return {
        "images": rng.random(shape, np.float32),
        "position_feature": rng.uniform(0.5, 1.5, (robots, 2)).astype(np.float32),
    }, adjacency


def velocities(
    module: LpacModule, inputs: dict[str, F32], adjacency: Bools, present: Bools
) -> torch.Tensor:
    shift = shift_operator(adjacency, np.ones_like(adjacency))
    told: torch.Tensor = module(
        {name: torch.from_numpy(rows) for name, rows in inputs.items()},
        torch.from_numpy(shift),
        torch.from_numpy(present),
    )
    return told.detach()


@pytest.mark.parametrize(
    "sizes",
    [
        SMALL,
        LpacNetwork(
            channels=("importance", "obstacles"), image_size=9, cnn_channels=(4, 7, 3), features=5,
            layers=3, hops=1, width=6, mlp_width=4, mlp_layers=3,
        ),
        replace(SMALL, channels=MAP_CHANNELS[5]),
    ],
)  # fmt: skip
def test_it_computes_what_the_checkpoints_network_does(sizes: LpacNetwork) -> None:
    module = drawn(sizes)
    checkpoint = parse_checkpoint(sizes.checkpoint(module.state_dict()), "trained")
    inputs, adjacency = swarm(sizes, 7)
    told = velocities(module, inputs, adjacency[None], np.ones((1, 7), np.bool_))
    assert checkpoint.cnn is not None
    features = torch.cat(
        [
            network.cnn_features(checkpoint.cnn, torch.from_numpy(inputs["images"]).double()),
            torch.from_numpy(inputs["position_feature"]).double(),
        ],
        dim=1,
    )
    shift = network.shift_operator(torch.from_numpy(adjacency))
    expected = network.centralised(checkpoint, shift, features)
    torch.testing.assert_close(told.double(), expected, rtol=1e-5, atol=1e-5)


def test_coverage_control_loads_its_checkpoint() -> None:
    state = drawn(SMALL).state_dict()
    reference = reference_lpac(state, SMALL.image_size)
    assert reference.state_dict().keys() == state.keys()


@given(sizes=st.lists(st.integers(1, 5), min_size=1, max_size=4), seed=st.integers(0, 99))
def test_swarms_of_a_batch_do_not_see_each_other(sizes: list[int], seed: int) -> None:
    module = drawn(SMALL)
    swarms = [swarm(SMALL, robots, seed + i) for i, robots in enumerate(sizes)]
    present = np.arange(max(sizes)) < np.array(sizes)[:, None]
    adjacency = np.zeros((*present.shape, max(sizes)), np.bool_)
    for i, (_, near) in enumerate(swarms):
        adjacency[i, : len(near), : len(near)] = near
    together = {
        name: np.concatenate([inputs[name] for inputs, _ in swarms]) for name in swarms[0][0]
    }
    alone = [
        velocities(module, inputs, near[None], np.ones((1, len(near)), np.bool_))
        for inputs, near in swarms
    ]
    torch.testing.assert_close(
        velocities(module, together, adjacency, present), torch.cat(alone), rtol=1e-5, atol=1e-5
    )


def test_who_is_not_heard_is_still_a_neighbour() -> None:
    _, adjacency = swarm(SMALL, 5)
    heard = np.ones_like(adjacency)
    heard[0] = False
    whole = shift_operator(adjacency[None], np.ones_like(adjacency)[None])[0]
    lossy = shift_operator(adjacency[None], heard[None])[0]
    np.testing.assert_array_equal(lossy[1:], whole[1:])
    assert not lossy[0].any() and whole[0].any()
    expected = network.shift_operator(torch.from_numpy(adjacency)).numpy()
    np.testing.assert_allclose(whole, expected, rtol=1e-6)


@given(turned=st.integers(0, 7), channels=st.sampled_from([4, 5]), seed=st.integers(0, 99))
def test_symmetries_are_those_of_the_images(turned: int, channels: int, seed: int) -> None:
    """Inputs in a mirrored world are the mirrored inputs."""
    parameters = read_parameters(SHIPPED.with_suffix(".toml")).perception
    size, rng = parameters.world_size, np.random.default_rng(seed)
    position, others = rng.integers(0, size, 2) * 1.0, rng.uniform(0, size, (3, 2))
    goal = rng.normal(size=2)
    around = rng.random((parameters.local_map_size,) * 2, np.float32)
    sizes = LpacNetwork(channels=MAP_CHANNELS[channels])
    if channels == 5:
        parameters = replace(parameters, unseen_as_nan=True)
        around[np.cumsum(around, axis=0) > 20.0] = np.nan

    def turn(points: "np.ndarray[Any, Any]", about: float) -> "np.ndarray[Any, Any]":
        points = points.copy()
        for axis in range(2):
            if turned & 1 << axis:
                points[..., axis] = 2.0 * about - points[..., axis]
        return points[..., ::-1] if turned & 4 else points

    flipped = around
    for axis in range(2):
        flipped = np.flip(flipped, axis) if turned & 1 << axis else flipped
    flipped = flipped.T if turned & 4 else flipped

    def perceived(at: Any, local: Any, near: Any) -> dict[str, F32]:
        images = PolicyImages(parameters, sizes.channels, 32).images(
            at, np.ascontiguousarray(local), near
        )
        return {
            "images": images.copy(),
            "position_feature": position_feature(at, parameters.world_size)[None],
        }

    before, velocity = perceived(position, around, others), goal.astype(np.float32)[None]
    inputs, velocity = sizes.symmetric(before, velocity, turned)
    expected = perceived(turn(position, size / 2), flipped, turn(others, size / 2))
    np.testing.assert_allclose(velocity[0], turn(goal, 0.0), rtol=1e-6)
    np.testing.assert_allclose(inputs["position_feature"], expected["position_feature"], rtol=1e-6)
    np.testing.assert_allclose(inputs["images"], expected["images"], atol=2e-6)


def test_its_bundle_passes_and_says_where_it_is_from() -> None:
    sizes = LpacNetwork(image_size=12, cnn_channels=(6, 6), features=6, width=8, mlp_width=5)
    content = sizes.checkpoint(drawn(sizes).state_dict())
    parameters = read_parameters(SHIPPED.with_suffix(".toml"))
    bundle = sizes.bundle(content, parameters, "small", {"training": "here"})
    assert bundle.manifest.name == "small" and bundle.manifest.provenance["training"] == "here"
    images = LpacManifest.of(bundle.manifest).images
    assert images is not None and (images.size, images.features) == (12, 6)
    assert all(check.passed for check in LpacPolicy(bundle).verify())
    torch.load(io.BytesIO(content), weights_only=True)


def test_it_can_go_on_with_the_shipped_policys_weights() -> None:
    state = torch.load(ROOT / "policies" / f"{SHIPPED.name}.pt", weights_only=True)
    LpacNetwork().module(MEAN, DEVIATION).load_state_dict(state)


def test_without_hops_nobody_heeds_what_is_said() -> None:
    """Trained or not; the bundle has a network of one hop."""
    sizes = replace(SMALL, hops=0)
    module = drawn(sizes)
    optimiser = torch.optim.AdamW(module.parameters(), lr=0.1)
    inputs, adjacency = swarm(sizes, 7)
    present = np.ones((1, 7), np.bool_)
    shift = torch.from_numpy(shift_operator(adjacency[None], np.ones_like(adjacency)[None]))
    tensors = {name: torch.from_numpy(rows) for name, rows in inputs.items()}
    module(tensors, shift, torch.from_numpy(present)).square().sum().backward()
    optimiser.step()
    content = sizes.checkpoint(module.state_dict())
    assert parse_checkpoint(content, "trained").geometry.hops == 1
    alone = np.zeros_like(adjacency[None])
    torch.testing.assert_close(
        velocities(module, inputs, adjacency[None], present),
        velocities(module, inputs, alone, present),
    )
    bundle = sizes.bundle(content, read_parameters(SHIPPED.with_suffix(".toml")), "small", {})
    assert all(check.passed for check in LpacPolicy(bundle).verify())
    with pytest.raises(ValueError, match=r"small\.pt: a network of hops = 0 cannot use"):
        sizes.initial(content, "small.pt")


@pytest.mark.parametrize(
    ("network_table", "text"),
    [
        ({"family": "none"}, "network: family = 'none': is not installed here"),
        ({"depth": 3}, "here: unknown key 'depth'; known are channels, "),
        ({"channels": ["importance"]}, "here: channels = importance: allowed are "),
        ({"cnn_channels": []}, r"here: cnn_channels = \[\]: must be at least 1 long"),
        ({"hops": -1}, "here: hops = -1: must be at least 0"),
        ({"layers": 0}, "here: layers = 0: must be at least 1"),
        (
            {"image_size": 6},
            "here: image_size = 6: must be above 6, the border that the convolutions",
        ),
    ],
)
def test_networks_that_cannot_be(network_table: dict[str, object], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        learnable(network_table, "here")
    if "family" not in network_table:
        with pytest.raises(ConfigError, match=text):
            lpac_network(network_table, "here")


@pytest.mark.parametrize("batches", [True, False])
def test_a_checkpoint_without_the_explored_image_is_gone_on_with(batches: bool) -> None:
    """The wider network first computes the same as the narrower one, whatever the new image."""
    module = drawn(SMALL)
    state = {
        name: tensor
        for name, tensor in module.state_dict().items()
        if batches or not name.endswith("num_batches_tracked")
    }
    sizes = replace(SMALL, channels=MAP_CHANNELS[5])
    wider = sizes.module(MEAN + 1.0, DEVIATION)
    wider.load_state_dict(sizes.initial(SMALL.checkpoint(state), "narrow.pt"))
    inputs, adjacency = swarm(sizes, 7)
    places = [sizes.channels.index(channel) for channel in SMALL.channels]
    narrow = {**inputs, "images": inputs["images"][:, places]}
    present = np.ones((1, 7), np.bool_)
    torch.testing.assert_close(
        velocities(wider.eval(), inputs, adjacency[None], present),
        velocities(module, narrow, adjacency[None], present),
    )


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"width": 9}, r"other.pt: gnn_backbone.graph_conv_0.bias: found \(9,\), expected \(8,\)"),
        ({"layers": 1}, r"other.pt: gnn_backbone.graph_conv_1.bias: found nothing, expected"),
        ({"layers": 3}, r"other.pt: gnn_backbone.graph_conv_2.*: the network has no such tensor"),
        (
            {"channels": MAP_CHANNELS[5]},
            r"other.pt: cnn_backbone.conv0.weight: found \(6, 5, 3, 3\)",
        ),
    ],
)
def test_another_networks_checkpoint_is_not(changes: dict[str, Any], text: str) -> None:
    other = replace(SMALL, **changes)
    checkpoint = other.checkpoint(drawn(other).state_dict())
    with pytest.raises(ValueError, match=text):
        SMALL.initial(checkpoint, "other.pt")
