"""`python -m bench.first_tick_torch`: the same with torch and torch_geometric."""

import numpy as np

from bench import CHECKPOINT
from bench.first_tick import ENV_SCALE, NEIGHBOURS_M, POSITION_M, run
from bench.torch_robot import PygLayer, TorchRobot, load_network
from edge.core.perception import PerceptionParameters

_IMAGE_SIZE = 32


def main() -> None:
    """Load the checkpoint, tick with ten neighbours."""
    perception = PerceptionParameters(
        world_size=512, local_map_size=256, sensor_size=64, communication_range=256.0
    )
    network = load_network(CHECKPOINT, PygLayer)
    robot_map = np.ones((perception.world_size,) * 2, np.float32)
    robot = TorchRobot(network, perception, _IMAGE_SIZE, robot_map)
    message_size = sum(hops * inputs for hops, inputs in network.held_shapes)
    payloads = [np.zeros(message_size, np.float32)] * len(NEIGHBOURS_M)
    position, *neighbours = ENV_SCALE * np.array((POSITION_M, *NEIGHBOURS_M))[:, :2]
    run(lambda: robot.tick(position, np.array(neighbours), payloads))


if __name__ == "__main__":
    main()
