"""`python -m bench.first_tick edge|torch`: a robot's policy process, for `footprint`.

Each variant imports only its own packages, since loading is part of the measurement.
"""

import json
import os
import sys
from collections.abc import Callable

import numpy as np

from bench import BUNDLE, CHECKPOINT
from bench.usage import usage

TICKED = "ticked\n"
TICKS = 20

# Mission frame, m; all neighbours are in range.
_POSITION_M = (16.0, 16.0, 0.0)
_NEIGHBOURS_M = tuple((10.0 + i, 12.0, 0.0) for i in range(10))
_ENV_SCALE = 16.0


def run(tick: Callable[[], object]) -> None:
    """Print TICKED after the first tick, and the memory as JSON after TICKS."""
    tick()
    print(TICKED, end="", flush=True)
    for _ in range(TICKS - 1):
        tick()
    taken = usage(os.getpid())
    print(json.dumps({"rss": taken.resident_mb, "private": taken.private_mb}), flush=True)


def edge() -> Callable[[], object]:
    """Load the bundle and receive from ten neighbours; returns a tick."""
    from dataclasses import replace

    from edge.core.aggregation import AggregatedMessage
    from edge.core.frames import ModelScale
    from edge.core.ports import Odometry
    from edge.core.wire import encode
    from edge.drivers.world_sensor import WorldSensor
    from edge.policy.bundle import load_bundle
    from edge.policy.lpac.policy import LpacPolicy
    from edge.robot.pac import Pac, PacParameters

    class Standing:
        def odometry(self) -> Odometry:
            return Odometry(_POSITION_M, (0.0, 0.0, 0.0))

    policy = LpacPolicy(load_bundle(BUNDLE))
    perception = policy.manifest.perception
    assert perception
    importance = np.ones((perception.world_size,) * 2, np.float32)
    robot = Pac(
        robot_id=0,
        policy=policy,
        sensor=WorldSensor(importance, perception.sensor_size),
        odometry=Standing(),
        parameters=PacParameters(scale=ModelScale(_ENV_SCALE, 0.25), max_speed_m_s=1.25),
    )
    robot.clock.update(1, 0.0, echoed_at_s=0.0, held_s=0.0, now_s=0.0)
    data = encode(AggregatedMessage(np.zeros(policy.message_size, np.float32)), "float16")
    for number, position_m in enumerate(_NEIGHBOURS_M, 1):
        beacon = replace(robot.beacon(0.0), robot_id=number, position_m=position_m)
        robot.receive(beacon, (1, 1), data, now_s=0.0)

    def tick() -> None:
        robot.perceive(now_s=0.0)
        assert robot.infer(now_s=0.0)

    return tick


def torch() -> Callable[[], object]:
    """Load the checkpoint; returns a tick with the same ten neighbours."""
    from bench.torch_robot import PygLayer, TorchRobot, load_network
    from edge.core.perception import PerceptionParameters

    perception = PerceptionParameters(
        world_size=512, local_map_size=256, sensor_size=64, communication_range=256.0
    )
    network = load_network(CHECKPOINT, PygLayer)
    robot = TorchRobot(network, perception, 32, np.ones((perception.world_size,) * 2, np.float32))
    message_size = sum(hops * inputs for hops, inputs in network.held_shapes)
    payloads = [np.zeros(message_size, np.float32)] * len(_NEIGHBOURS_M)
    position, *neighbours = _ENV_SCALE * np.array((_POSITION_M, *_NEIGHBOURS_M))[:, :2]
    return lambda: robot.tick(position, np.array(neighbours), payloads)


if __name__ == "__main__":
    run({"edge": edge, "torch": torch}[sys.argv[1]]())
