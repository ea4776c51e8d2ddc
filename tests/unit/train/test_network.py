"""Any module is trained for whole swarms, and flies as single robots."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from edge.core.schema import ConfigError
from edge.drivers.registry import load_policy
from edge.policy.family import Neighbourhood
from lpac.train.attention import AttentionModule, AttentionNetwork, attention_network
from lpac.train.family import learnable, shift_operator
from lpac.train.network import ModuleNetwork
from tests.unit.export.test_module import PARAMETERS

SMALL = {"cnn_channels": [4], "features": 8, "width": 16, "layers": 2}


def test_robots_that_exchanged_messages_do_as_the_whole_network() -> None:
    network = attention_network(SMALL, "network")
    module = network.module(np.array([0.5, -0.5], np.float32), np.array([2.0, 1.0], np.float32))
    assert isinstance(module, AttentionModule)
    bundle = network.bundle(network.checkpoint(module.state_dict()), PARAMETERS, "small", {})
    policy = load_policy(bundle)
    rng = np.random.default_rng(2)
    # A swarm of five and one of three; robot 4 of the first has no neighbours.
    present = np.array([[True] * 5, [True] * 3 + [False] * 2])
    adjacency = np.zeros((2, 5, 5), np.bool_)
    for i, j in ((0, 1), (1, 2), (2, 3), (0, 3)):
        adjacency[0, i, j] = adjacency[0, j, i] = True
    adjacency[1, 0, 1] = adjacency[1, 1, 0] = adjacency[1, 1, 2] = adjacency[1, 2, 1] = True
    maps = rng.random((8, 4, 32, 32)).astype(np.float32)
    position = rng.random((8, 2)).astype(np.float32)
    shift = shift_operator(adjacency, np.ones_like(adjacency))
    module.eval()
    with torch.no_grad():
        whole = module(
            {"maps": torch.from_numpy(maps), "position": torch.from_numpy(position)},
            torch.from_numpy(shift),
            torch.from_numpy(present),
        ).numpy()
    for first, swarm in ((0, 0), (5, 1)):
        count = int(present[swarm].sum())
        agents = [policy.agent() for _ in range(count)]
        features = [
            module.encode(torch.from_numpy(maps[first + i]), torch.from_numpy(position[first + i]))
            .detach()
            .numpy()
            for i in range(count)
        ]
        payloads = [np.zeros(policy.message_size, np.float32)] * count
        for _ in range(3):
            steps = []
            for i in range(count):
                others = np.flatnonzero(adjacency[swarm, i])
                at = 512.0 * position[first : first + count]
                around = Neighbourhood(
                    robot_ids=tuple(others.tolist()),
                    payloads=[payloads[j] for j in others],
                    positions=(at[others] - at[i]).astype(np.float32),
                    velocities=np.zeros((len(others), 2), np.float32),
                    ages_s=np.zeros(len(others), np.float32),
                    degree=len(others),
                )
                steps.append(agents[i].step(features[i], around))
            payloads = [step.payload for step in steps]
        np.testing.assert_allclose(
            [step.velocity for step in steps], whole[first : first + count], rtol=1e-4, atol=1e-5
        )


def test_a_mirrored_world_is_mirrored_in_all_inputs() -> None:
    network = attention_network(SMALL, "network")
    rng = np.random.default_rng(0)
    inputs = {
        "maps": rng.random((3, 4, 8, 8)).astype(np.float32),
        "position": rng.random((3, 2)).astype(np.float32),
        "features": rng.random((3, 10)).astype(np.float32),
    }
    velocities = rng.normal(size=(3, 2)).astype(np.float32)
    turned, flown = network.symmetric(inputs, velocities, 1)
    np.testing.assert_allclose(flown, velocities * [-1.0, 1.0])
    np.testing.assert_allclose(turned["position"][:, 0], 1.0 - inputs["position"][:, 0], rtol=1e-6)
    np.testing.assert_array_equal(turned["maps"][:, 0], inputs["maps"][:, 0, ::-1])
    np.testing.assert_array_equal(turned["maps"][:, 1], -inputs["maps"][:, 1, ::-1])
    again, back = network.symmetric(turned, flown, 1)
    np.testing.assert_array_equal(again["maps"], inputs["maps"])
    np.testing.assert_array_equal(back, velocities)
    swapped, _ = network.symmetric(inputs, velocities, 4)
    np.testing.assert_array_equal(swapped["maps"][:, 1], inputs["maps"][:, 2].swapaxes(1, 2))


class Trained(nn.Module):
    """A module of a user's own, with a loss of its own."""

    message_size = 0

    def __init__(self) -> None:
        super().__init__()
        self.action = nn.Linear(4, 2)

    def encode(self, position: torch.Tensor, velocity: torch.Tensor) -> torch.Tensor:
        return torch.cat([position, velocity])

    def step(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return self.action(features), features.new_zeros(0)


class SeesNeighbours(Trained):
    def encode(self, neighbours: torch.Tensor) -> torch.Tensor:  # type: ignore[override]
        return neighbours.sum(dim=0).repeat(2)


def test_a_module_is_named_in_the_configuration() -> None:
    network = learnable({"family": "network", "module": f"{__name__}:Trained"}, "network")
    assert isinstance(network, ModuleNetwork)
    state = Trained().state_dict()
    checkpoint = network.checkpoint(state)
    assert torch.equal(network.initial(checkpoint, "it")["action.bias"], state["action.bias"])
    with pytest.raises(ValueError, match=r"^it: .*Missing key"):
        network.initial(network.checkpoint({}), "it")


@pytest.mark.parametrize(
    ("network", "problem"),
    [
        ({"family": "network"}, "network: module is missing"),
        ({"family": "network", "module": "nowhere.py:It"}, "nowhere.py is not a file"),
        (
            {"family": "network", "module": f"{__name__}:SeesNeighbours"},
            "encode takes 'neighbours': training needs inputs of one shape",
        ),
        ({"family": "attention", "width": 15}, "width = 15: must be a multiple of heads = 2"),
        ({"family": "attention", "image_size": 4}, "image_size = 4: must be above 6"),
        ({"family": "attention", "channels": ["importance"]}, "channels = importance: allowed are"),
    ],
)
def test_a_wrong_network_is_named(network: dict[str, object], problem: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=problem) as error:
        learnable(network, "network")
    assert "\n" not in str(error.value)


def test_sizes_are_those_of_the_message() -> None:
    assert AttentionModule(AttentionNetwork(layers=3, width=8, heads=4)).message_size == 24
