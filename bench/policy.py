"""Time of one robot's policy tick, from memory and messages to its action and own message.

Compared with torch: eager with torch_geometric, and traced and frozen with one linear layer per
tap. All use the same inputs on one thread, and must agree before they are timed.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from bench import BUNDLE, CHECKPOINT, cnn
from bench.moment import NEIGHBOURS, Moment, moment_in_flight, neighbourhood
from bench.result import Result, Table, Target, progress
from bench.timing import interleaved, quartiles, with_quartiles
from bench.torch_robot import (
    Network,
    NetworkForm,
    PygLayer,
    TapLayer,
    TorchRobot,
    exchange_inputs,
    load_network,
)
from edge.core import F32
from edge.core.aggregation import HopBuffer
from edge.drivers.registry import load_policy
from edge.policy.bundle import load_bundle
from edge.policy.family import Observation, Policy
from edge.policy.images import PolicyImages
from edge.policy.lpac.manifest import gnn_graph
from edge.policy.lpac.policy import LpacPolicy
from export.module import network_bundle
from export.parameters import PolicyParameters

EDGE, FORM = "lpac-edge", "family network"
TRACED, EAGER = "torch traced", "torch + PyG eager"
TOLERANCE = 1e-4

Outputs = tuple[F32, F32]


def measure(rounds: int = 200, round_s: float = 0.01) -> Result:
    """Time the whole tick and the graph neural network, and measure the CNN's efficiency.

    Raises RuntimeError if the variants' outputs differ by more than TOLERANCE.
    """
    bundle = load_bundle(BUNDLE)
    policy = LpacPolicy(bundle)
    moment = moment_in_flight(policy)
    robot = EdgeRobot(policy, moment)
    eager = load_network(CHECKPOINT, PygLayer)
    taps = load_network(CHECKPOINT, TapLayer)

    ticks = {
        EDGE: robot.tick,
        FORM: AgentRobot(_network_form(taps, policy), moment).tick,
        **_torch_ticks(eager, taps, moment, policy),
    }
    exchanges = {EDGE: robot.exchange, EAGER: _torch_exchange(eager, moment, robot.features)}
    figures: dict[str, Any] = {"neighbours": NEIGHBOURS, "rounds": rounds}
    tables = []
    for name, variants in (("tick", ticks), ("gnn", exchanges)):
        error = _largest_difference(list(variants.values()))
        if not error <= TOLERANCE:
            raise RuntimeError(f"{name}: the variants' outputs differ by {error}")
        progress(f"policy: {name}")
        figures[name] = {"largest_difference": error, **_compared(variants, rounds, round_s)}
        tables.append(_comparison_table(name, figures[name]))

    progress("policy: CNN")
    figures["cnn"] = cnn.measure(
        policy.image_features, eager.cnn_backbone, robot.images(), rounds // 2, round_s
    )
    tables.append(cnn.table(figures["cnn"]))
    return Result(
        "policy",
        figures,
        tables,
        [
            Target(
                "tick: family network's time over family lpac's",
                figures["tick"]["slower_than_edge"][FORM]["median"],
                1.1,
                at_least=False,
            ),
            _faster("tick", TRACED, figures, 1.7),
            _faster("tick", EAGER, figures, 5.0),
            _faster("gnn", EAGER, figures, 10.0),
            Target(
                "CNN, share of this core's measured peak",
                figures["cnn"]["share_of_peak"]["median"],
                0.7,
                at_least=True,
            ),
        ],
        [
            "Tick: maps of the surroundings, resize, CNN, aggregation of the neighbours' messages, "
            "graph neural network, action, own message. Graph neural network alone: from features "
            "and messages to the last layer and the own message. One thread each; ratios are "
            "medians over rounds in which the variants alternate."
        ],
    )


class AgentRobot:
    """lpac-edge's tick at a moment of a flight."""

    def __init__(self, policy: Policy, moment: Moment) -> None:
        self._moment = moment
        self._agent = policy.agent()
        self._neighbours = neighbourhood(moment.position, moment.neighbours, moment.payloads)
        self.features = self._agent.observe(self._observation()).features

    def tick(self) -> Outputs:
        """Velocity (2,) and message (message_size,)."""
        features = self._agent.observe(self._observation()).features
        return self._agent.step(features, self._neighbours)[:2]

    def _observation(self) -> Observation:
        moment = self._moment
        return Observation(
            moment.position,
            moment.memory.local_map(moment.position),
            moment.neighbours,
            np.zeros(2),
        )


class EdgeRobot(AgentRobot):
    """The tick of a robot of the paper's family, and its parts."""

    def __init__(self, policy: LpacPolicy, moment: Moment) -> None:
        assert policy.manifest.perception
        super().__init__(policy, moment)
        self._policy = policy
        self._hops = HopBuffer(policy.geometry)
        images = policy.lpac.images
        assert images
        self._images = PolicyImages(policy.manifest.perception, images.channels, images.size)

    def exchange(self) -> Outputs:
        """The graph neural network alone: x_L (F_L,) and message (message_size,)."""
        self._hops.diffuse(self._moment.payloads, NEIGHBOURS)
        features = self.features
        for number, layer in enumerate(self._hops.layers, 1):
            layer[0, 0] = features
            features = self._policy.run(gnn_graph(number), layer)[0]
        return features, self._hops.message(NEIGHBOURS)

    def images(self) -> F32:
        """Input of the CNN, (1, channels, size, size)."""
        return self._images.images(*self._observation()[:3]).copy()


def _network_form(network: Network, policy: LpacPolicy) -> Policy:
    """The same network as a bundle of the family `network`."""
    manifest, images = policy.manifest, policy.lpac.images
    assert manifest.perception and images
    trained = PolicyParameters(manifest.perception, manifest.training)
    form = NetworkForm(network, images.channels, images.size)
    return load_policy(network_bundle(form, trained, FORM, {}))


def _torch_ticks(
    eager: Network, taps: Network, moment: Moment, policy: LpacPolicy
) -> dict[str, Callable[[], Outputs]]:
    perception, images = policy.manifest.perception, policy.lpac.images
    assert perception and images

    def robot(network: Callable[..., tuple[Tensor, Tensor]]) -> TorchRobot:
        return TorchRobot(network, perception, images.size, moment.robot_map)

    inputs = moment.position, moment.neighbours, moment.payloads
    with_pyg, with_taps = robot(eager), robot(taps)
    traced = robot(_frozen(taps, with_taps.inputs(*inputs)))
    return {TRACED: lambda: traced.tick(*inputs), EAGER: lambda: with_pyg.tick(*inputs)}


def _torch_exchange(eager: Network, moment: Moment, features: F32) -> Callable[[], Outputs]:
    def exchange() -> Outputs:
        with torch.inference_mode():
            own = torch.from_numpy(features[None])
            last, message = eager.exchange(own, *exchange_inputs(moment.payloads))
            return last[0].numpy(), message.numpy()

    return exchange


def _frozen(module: nn.Module, inputs: tuple[Tensor, ...]) -> Callable[..., Any]:
    with torch.inference_mode():
        traced = torch.jit.trace(module, inputs)  # type: ignore[no-untyped-call]
        frozen: Callable[..., Any] = torch.jit.freeze(traced)
    return frozen


def _largest_difference(variants: Sequence[Callable[[], Outputs]]) -> float:
    """Largest difference of any output from the first variant's."""
    expected, *others = ([out.copy() for out in variant()] for variant in variants)
    return max(
        float(np.abs(a - b).max())
        for outputs in others
        for a, b in zip(outputs, expected, strict=True)
    )


def _compared(
    variants: dict[str, Callable[[], Outputs]], rounds: int, round_s: float
) -> dict[str, Any]:
    times = interleaved(variants, rounds, round_s)
    return {
        "us": {name: quartiles(1e6 * t) for name, t in times.items()},
        "slower_than_edge": {name: quartiles(t / times[EDGE]) for name, t in times.items()},
    }


def _comparison_table(name: str, figures: dict[str, Any]) -> Table:
    title = {"tick": "LpacPolicy tick", "gnn": "Graph neural network alone"}[name]
    rows = [
        (variant, with_quartiles(figures["slower_than_edge"][variant]), f"{us['median']:.0f}")
        for variant, us in figures["us"].items()
    ]
    columns = ("", "times lpac-edge's, median of rounds (quartiles)", "us, median")
    return Table(f"{title}, {NEIGHBOURS} neighbours", columns, rows)


def _faster(name: str, variant: str, figures: dict[str, Any], limit: float) -> Target:
    ratio = figures[name]["slower_than_edge"][variant]["median"]
    return Target(f"{name}: times faster than {variant}", ratio, limit, at_least=True)
