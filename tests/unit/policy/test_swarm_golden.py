"""The decentralised swarm against the centralised network of torch_geometric and the reference."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from edge.core import F32, F64
from edge.core.aggregation import Geometry
from edge.core.frames import ModelScale
from edge.core.ports import Odometry
from edge.messages.beacon import decode_beacon, encode_beacon
from edge.policy.bundle import Bundle
from edge.policy.images import MAP_CHANNELS, PolicyImages
from edge.policy.lpac.policy import LpacPolicy, position_feature
from edge.policy.lpac.verify import swarm_velocities
from edge.robot.pac import Pac, PacParameters
from tests.conftest import SHIPPED

torch = pytest.importorskip("torch", reason="torch is the oracle here")
tag_conv = pytest.importorskip(
    "torch_geometric.nn", reason="torch_geometric is the oracle here"
).TAGConv

from export.exporter import export_bundle  # noqa: E402
from tests.unit.export.reference_lpac import reference_lpac  # noqa: E402
from tests.unit.export.states import State, random_state  # noqa: E402

PARAMETERS = SHIPPED.with_suffix(".toml")
TOLERANCE = 1e-5
ROBOTS = (1, 2, 10, 50)
IMAGE_SIZE = 16

Neighbours = npt.NDArray[np.bool_]


def geometric_graph(robots: int, seed: int = 0) -> Neighbours:
    """Adjacency of robots at random places in a square, from isolated to crowded."""
    places = np.random.default_rng(seed).uniform(0, 1, (robots, 2))
    radius = 2.0 if robots == 2 else 0.35
    near: Neighbours = np.hypot(*(places[:, None] - places[None]).T) < radius
    np.fill_diagonal(near, False)
    return near


def relative_error(output: F32, truth: F32) -> float:
    return float(np.abs(output - truth).max() / np.abs(truth).max())


def tag_conv_features(
    bias: Callable[[int], object], tap: Callable[[int, int], object], geometry: Geometry,
    features: F32, neighbours: Neighbours,
) -> object:  # fmt: skip
    """x_L (N, F_L) from torch_geometric's TAGConv layers with these biases and taps."""
    values = torch.from_numpy(features)
    edges = torch.from_numpy(np.array(np.nonzero(neighbours)))
    for i, (inputs, outputs) in enumerate(
        zip(geometry.feature_sizes[:-1], geometry.feature_sizes[1:], strict=True)
    ):
        layer = tag_conv(inputs, outputs, K=geometry.hops)
        taps = {f"lins.{k}.weight": tap(i, k) for k in range(geometry.hops + 1)}
        layer.load_state_dict({"bias": bias(i), **taps})
        values = layer(values, edges).relu()
    return values


def action(state: Mapping[str, object], features: object) -> F32:
    """De-normalised velocities (N, 2) from x_L, in torch."""
    functional = torch.nn.functional
    norm = "gnn_mlp.norms.0.module"
    hidden = functional.linear(
        features, state["gnn_mlp.lins.0.weight"], state["gnn_mlp.lins.0.bias"]
    )
    hidden = functional.batch_norm(
        hidden, state[f"{norm}.running_mean"], state[f"{norm}.running_var"],
        state[f"{norm}.weight"], state[f"{norm}.bias"],
    ).relu()  # fmt: skip
    hidden = functional.linear(hidden, state["gnn_mlp.lins.1.weight"], state["gnn_mlp.lins.1.bias"])
    output = functional.linear(hidden, state["output_linear.weight"], state["output_linear.bias"])
    velocities: F32 = (output * state["actions_std"] + state["actions_mean"]).numpy()
    return velocities


@pytest.fixture(autouse=True)
def _without_gradients() -> Iterator[None]:
    with torch.no_grad():
        yield


def exported(state: State, folder: Path) -> Bundle:
    torch.save(state, folder / "state.pt")
    return export_bundle(folder / "state.pt", PARAMETERS)


@pytest.mark.parametrize("latent", [16, 256])
@pytest.mark.parametrize("hops", [1, 3])
@pytest.mark.parametrize("layers", [1, 2, 5])
def test_after_k_l_rounds_the_swarm_is_the_centralised_network(
    layers: int, hops: int, latent: int, tmp_path: Path
) -> None:
    state = random_state(layers=layers, hops=hops, latent=latent, image_size=IMAGE_SIZE)
    policy = LpacPolicy(exported(state, tmp_path))
    geometry = policy.geometry
    assert (geometry.layers, geometry.hops) == (layers, hops)
    for robots in ROBOTS:
        neighbours = geometric_graph(robots)
        random = np.random.default_rng(robots)
        features = random.uniform(-1, 1, (robots, geometry.feature_sizes[0])).astype(np.float32)
        velocities = swarm_velocities(policy, neighbours, features, rounds=hops * layers)
        truth = action(
            state,
            tag_conv_features(
                lambda i: state[f"gnn_backbone.graph_conv_{i}.bias"],
                lambda i, k: state[f"gnn_backbone.graph_conv_{i}.lins.{k}.weight"],
                geometry, features, neighbours,
            ),
        )  # fmt: skip
        assert relative_error(velocities[-1], truth) <= TOLERANCE
        if robots >= 10:
            assert relative_error(velocities[-2], truth) > TOLERANCE


@pytest.mark.parametrize(("layers", "hops", "latent"), [(1, 1, 16), (2, 3, 256), (5, 3, 256)])
def test_after_k_l_rounds_the_swarm_is_the_reference_librarys_network(
    layers: int, hops: int, latent: int, tmp_path: Path
) -> None:
    state = random_state(layers=layers, hops=hops, latent=latent, image_size=IMAGE_SIZE)
    model = reference_lpac(state, IMAGE_SIZE)
    policy = LpacPolicy(exported(state, tmp_path))
    for robots in ROBOTS:
        neighbours = geometric_graph(robots)
        random = np.random.default_rng(robots)
        images = random.uniform(0, 1, (robots, 4, IMAGE_SIZE, IMAGE_SIZE)).astype(np.float32)
        positions = random.uniform(0.5, 1.5, (robots, 2)).astype(np.float32)
        features = np.concatenate(
            [[policy.image_features(image[None])[0] for image in images], positions], axis=1
        )
        velocities = swarm_velocities(policy, neighbours, features, rounds=hops * layers)
        truth = lpac_velocities(model, images, positions, neighbours)
        assert relative_error(velocities[-1], truth) <= TOLERANCE


def lpac_velocities(model: object, images: F32, positions: F32, neighbours: Neighbours) -> F32:
    """CoverageControl's LPAC on the whole swarm, de-normalised as by its controller."""
    data = pytest.importorskip("torch_geometric.data").Data(
        x=torch.from_numpy(images), pos=torch.from_numpy(positions),
        edge_index=torch.from_numpy(np.array(np.nonzero(neighbours))),
    )  # fmt: skip
    output = model(data) * model.actions_std + model.actions_mean  # type: ignore[operator,attr-defined]
    velocities: F32 = output.numpy()
    return velocities


def test_the_authors_network_decentralised_is_their_network(authors_taps: Path) -> None:
    def tensor(name: str) -> object:
        return torch.load(authors_taps / f"{name}.pt", "cpu", weights_only=True)

    policy = LpacPolicy(export_bundle(authors_taps, PARAMETERS))
    geometry = policy.geometry
    names = {
        "gnn_mlp.lins.0.weight": "mlp_lin_0", "gnn_mlp.lins.0.bias": "mlp_bias_0",
        "gnn_mlp.lins.1.weight": "mlp_lin_1", "gnn_mlp.lins.1.bias": "mlp_bias_1",
        "output_linear.weight": "outlayer_wts", "output_linear.bias": "outlayer_bias",
        "actions_mean": "actions_mean", "actions_std": "actions_std",
        **{
            f"gnn_mlp.norms.0.module.{part}": f"mlp_norm_0_{part}"
            for part in ("running_mean", "running_var", "weight", "bias")
        },
    }  # fmt: skip
    state = {name: tensor(file) for name, file in names.items()}
    for robots in ROBOTS:
        neighbours = geometric_graph(robots)
        features = np.random.default_rng(robots).uniform(-1, 1, (robots, 34)).astype(np.float32)
        velocities = swarm_velocities(policy, neighbours, features, rounds=15)
        last = tag_conv_features(
            lambda i: tensor(f"bias_{i}"), lambda i, k: tensor(f"lin_{i}_{k}"),
            geometry, features, neighbours,
        )  # fmt: skip
        assert relative_error(velocities[-1], action(state, last)) <= TOLERANCE


@pytest.mark.parametrize(("layers", "hops"), [(1, 1), (1, 3), (2, 1), (2, 3)])
def test_news_travels_one_hop_an_exchange_and_no_further_than_k_l(
    layers: int, hops: int, tmp_path: Path
) -> None:
    """On a tree, a changed feature of robot 0 reaches all within n hops after n exchanges."""
    policy = LpacPolicy(exported(random_state(layers=layers, hops=hops, latent=64), tmp_path))
    parents = np.array([0, 0, 0, 1, 1, 2, 3, 5, 6, 7, 8, 9, 10, 11, 12])
    robots = len(parents)
    neighbours = np.zeros((robots, robots), np.bool_)
    distance = np.zeros(robots, int)
    for robot in range(1, robots):
        neighbours[robot, parents[robot]] = neighbours[parents[robot], robot] = True
        distance[robot] = distance[parents[robot]] + 1
    assert distance.max() > hops * layers
    size = policy.geometry.feature_sizes[0]
    features = np.random.default_rng(5).uniform(-1, 1, (robots, size)).astype(np.float32)
    changed = features.copy()
    changed[0, 3] += 1.0
    rounds = hops * layers + 2
    differs = np.any(
        swarm_velocities(policy, neighbours, features, rounds)
        != swarm_velocities(policy, neighbours, changed, rounds),
        axis=2,
    )
    for exchanges in range(rounds + 1):
        reached = distance <= min(exchanges, hops * layers)
        np.testing.assert_array_equal(differs[exchanges], reached)


class Still:
    """A robot that stands still over its own world."""

    def __init__(self, position_m: tuple[float, float, float], seen: F32) -> None:
        self._position_m = position_m
        self._seen = seen

    def odometry(self) -> Odometry:
        return Odometry(self._position_m, (0.0, 0.0, 0.0))

    def view(self, position: F64) -> F32:
        return self._seen


def test_robots_that_talk_by_wire_become_the_reference_network(shipped_policy: LpacPolicy) -> None:
    """Images, mailboxes and encoded messages of ten robots, against LPAC on the whole swarm."""
    random = np.random.default_rng(3)
    places_m = random.uniform(0, 32, (10, 2)).round(3)  # Beacons tell places to 1 mm.
    parameters = PacParameters(scale=ModelScale(16.0, 1.0), max_speed_m_s=100.0, payload="float32")
    still = [Still((*place, 2.0), random.random((64, 64), np.float32)) for place in places_m]
    robots = [
        Pac(
            robot_id=i, policy=shipped_policy, sensor=still[i], odometry=still[i],
            parameters=parameters,
        )
        for i in range(10)
    ]  # fmt: skip
    for robot in robots:
        robot.clock.update(1, 0.0, echoed_at_s=0.0, held_s=0.0, now_s=0.0)
    geometry = shipped_policy.geometry
    # One exchange more than K L: the first messages only give the robots their neighbours.
    for tick in range(geometry.hops * geometry.layers + 2):
        now_s = 0.4 * tick
        for robot in robots:
            robot.perceive(now_s)
        ticks = [robot.infer(now_s) for robot in robots]
        for i, robot in enumerate(robots):
            for j, sent in enumerate(ticks):
                beacon = decode_beacon(encode_beacon(robots[j].beacon(now_s)), j)
                if i != j:
                    assert sent and robot.receive(beacon, (1, tick), sent.message, now_s) is None
    velocities = np.array([robot.control(now_s) for robot in robots], np.float32)

    neighbours = np.hypot(*(places_m[:, None] - places_m[None]).T) < 16.0
    np.fill_diagonal(neighbours, False)
    perception = shipped_policy.manifest.perception
    assert perception
    images = np.concatenate(
        [
            PolicyImages(perception, MAP_CHANNELS[4], 32).images(
                place, robot._memory.local_map(place), places_m[near] * 16.0
            )
            for robot, place, near in zip(robots, places_m * 16.0, neighbours, strict=True)
        ]
    )
    positions = np.array([position_feature(place * 16.0, 512) for place in places_m])
    state = torch.load(SHIPPED.with_suffix(".pt"), weights_only=True)
    truth = lpac_velocities(reference_lpac(state, 32), images, positions, neighbours)
    assert relative_error(velocities, truth) <= TOLERANCE
