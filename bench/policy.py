"""One robot's policy tick, from what it has seen and heard to its action and its own message.

Against the same in torch: eager with torch_geometric, and traced and frozen with one linear layer
per tap. All take the same inputs on one thread each, and must agree before they are timed.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from bench import BUNDLE, CHECKPOINT, cnn
from bench.moment import NEIGHBOURS, Moment, moment_in_flight
from bench.result import Result, Table, Target, progress
from bench.timing import interleaved, quartiles, with_quartiles
from bench.torch_robot import Network, PygLayer, TapLayer, TorchRobot, exchange_inputs, load_network
from edge.core import F32
from edge.core.aggregation import HopBuffer
from edge.core.wire import decode, encode
from edge.policy.bundle import load_bundle
from edge.policy.family import Observation
from edge.policy.lpac.images import PolicyImages
from edge.policy.lpac.manifest import ACTION, gnn_graph
from edge.policy.lpac.policy import LpacPolicy

EDGE, TRACED, EAGER = "lpac-edge", "torch traced", "torch + PyG eager"
TOLERANCE = 1e-4

Outputs = tuple[F32, F32]


def measure(rounds: int = 200, round_s: float = 0.01) -> Result:
    """Whole tick, graph neural network alone, the parts of our tick, and the CNN's efficiency.

    Raises RuntimeError if the variants' outputs differ by more than TOLERANCE.
    """
    progress("policy: a flight for the inputs")
    bundle = load_bundle(BUNDLE)
    policy = LpacPolicy(bundle)
    moment = moment_in_flight(policy)
    robot = EdgeRobot(policy, moment)
    eager = load_network(CHECKPOINT, PygLayer)
    taps = load_network(CHECKPOINT, TapLayer)

    ticks = {EDGE: robot.tick, **_torch_ticks(eager, taps, moment, policy)}
    exchanges = {EDGE: robot.exchange, **_torch_exchanges(eager, taps, moment, robot.features)}
    figures: dict[str, Any] = {"neighbours": NEIGHBOURS, "rounds": rounds}
    tables = []
    for name, variants in (("tick", ticks), ("gnn", exchanges)):
        error = _largest_difference(list(variants.values()))
        if not error <= TOLERANCE:
            raise RuntimeError(f"{name}: the variants' outputs differ by {error}")
        progress(f"policy: {name}")
        figures[name] = {"largest_difference": error, **_compared(variants, rounds, round_s)}
        tables.append(_comparison_table(name, figures[name]))

    progress("policy: parts")
    times = interleaved(robot.parts(), rounds, round_s / 4)
    figures["parts_us"] = {name: quartiles(1e6 * t) for name, t in times.items()}
    tables.append(
        Table(
            f"The parts of our tick, {NEIGHBOURS} neighbours, each alone in a loop",
            ("part", "us, median (quartiles)"),
            [(name, with_quartiles(us, 1)) for name, us in figures["parts_us"].items()],
        )
    )

    progress("policy: CNN")
    figures["cnn"] = cnn.measure(bundle, robot.images, rounds // 2, round_s)
    tables.append(cnn.table(figures["cnn"]))
    return Result(
        "policy",
        figures,
        tables,
        [
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
            "Tick: maps of the robot's surroundings, resize, CNN, aggregation of the neighbours' "
            "messages, graph neural network, action, own message. The graph neural network alone: "
            "from features and messages to the last layer and the own message. One thread each; "
            "ratios are medians over rounds in which the variants take turns."
        ],
    )


class EdgeRobot:
    """Our tick at a moment of a flight."""

    def __init__(self, policy: LpacPolicy, moment: Moment) -> None:
        assert policy.manifest.perception
        self._policy = policy
        self._moment = moment
        self._hops = HopBuffer(policy.geometry)
        images = policy.lpac.images
        assert images
        self._images = PolicyImages(policy.manifest.perception, images.channels, images.size)
        self._agent = policy.agent()
        self.images = self._make_images().copy()
        self.features = self._agent.observe(self._observation()).features

    def tick(self) -> Outputs:
        """Velocity (2,) and message (message_size,)."""
        features = self._agent.observe(self._observation()).features
        return self._agent.step(features, self._moment.payloads, NEIGHBOURS)

    def exchange(self) -> Outputs:
        """The graph neural network alone: x_L (F_L,) and message (message_size,)."""
        self._hops.diffuse(self._moment.payloads, NEIGHBOURS)
        return self._layers(), self._hops.message(NEIGHBOURS)

    def parts(self) -> dict[str, Callable[[], object]]:
        """What a robot does for a tick, in order, and the steps of `Pac` as a whole."""
        moment, policy = self._moment, self._policy
        last = self._layers()[None]
        own = moment.messages[0]
        wire = [encode(message, policy.bundle_id, "float16") for message in moment.messages]

        def decode_all() -> None:
            for data in wire:
                decode(
                    data,
                    bundle_id=policy.bundle_id,
                    frame_id=0,
                    message_size=policy.message_size,
                )

        return {
            f"decode {NEIGHBOURS} messages": decode_all,
            "images": self._make_images,
            "CNN": lambda: policy.image_features(self.images),
            "aggregation": lambda: self._hops.diffuse(moment.payloads, NEIGHBOURS),
            "layers": self._layers,
            "action": lambda: policy.run(ACTION, last),
            "own message": lambda: self._hops.message(NEIGHBOURS),
            "encode": lambda: encode(own, policy.bundle_id, "float16"),
            "whole step: Pac.perceive": lambda: moment.robot.perceive(moment.now_s),
            "whole step: Pac.infer": lambda: moment.robot.infer(moment.now_s),
        }

    def _observation(self) -> Observation:
        moment = self._moment
        return Observation(
            moment.position,
            moment.memory.local_map(moment.position),
            moment.neighbours,
            np.zeros(2),
        )

    def _make_images(self) -> F32:
        return self._images.images(*self._observation()[:3])

    def _layers(self) -> F32:
        features = self.features
        for number, layer in enumerate(self._hops.layers, 1):
            layer[0, 0] = features
            features = self._policy.run(gnn_graph(number), layer)[0]
        return features


class _Exchange(nn.Module):
    """The graph neural network of a `Network` alone, so that it can be traced."""

    def __init__(self, network: Network) -> None:
        super().__init__()
        self.network = network

    def forward(self, features: Tensor, payloads: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
        return self.network.exchange(features, payloads, scale)


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


def _torch_exchanges(
    eager: Network, taps: Network, moment: Moment, features: F32
) -> dict[str, Callable[[], Outputs]]:
    def inputs() -> tuple[Tensor, ...]:
        return torch.from_numpy(features[None]), *exchange_inputs(moment.payloads)

    def exchange(network: Callable[..., tuple[Tensor, Tensor]]) -> Outputs:
        with torch.inference_mode():
            last, message = network(*inputs())
            return last[0].numpy(), message.numpy()

    traced = _frozen(_Exchange(taps).eval(), inputs())
    return {TRACED: lambda: exchange(traced), EAGER: lambda: exchange(eager.exchange)}


def _frozen(module: nn.Module, inputs: tuple[Tensor, ...]) -> Callable[..., Any]:
    with torch.inference_mode():
        traced = torch.jit.trace(module, inputs)  # type: ignore[no-untyped-call]
        frozen: Callable[..., Any] = torch.jit.freeze(traced)
    return frozen


def _largest_difference(variants: Sequence[Callable[[], Outputs]]) -> float:
    """Of any output of a variant from the first one's."""
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
