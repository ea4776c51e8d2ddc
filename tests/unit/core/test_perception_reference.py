"""The images against the reference library's maps, along random walks that touch the borders."""

import numpy as np
import pytest

from edge.core import F32, F64
from edge.core.memory import RobotMemory
from edge.core.perception import PerceptionParameters, neighbours_in_range
from edge.drivers.world_sensor import WorldSensor
from edge.policy.images import MAP_CHANNELS, PolicyImages
from lpac.analysis.worlds import random_features
from tests.unit.core.reference import point_vector, reference_environment

PARAMETERS = PerceptionParameters(
    world_size=512, local_map_size=256, sensor_size=64, communication_range=256.0
)
ROBOTS = 8
STEPS = 25
# The library keeps robots this far inside the world.
MARGIN = 1e-3


def random_walk(rng: np.random.Generator) -> list[F64]:
    """Positions (STEPS, ROBOTS, 2); two robots start in corners, one follows the border."""
    positions = rng.uniform(0, 512, (ROBOTS, 2))
    positions[0], positions[1], positions[2, 0] = (MARGIN, 512 - MARGIN), (512 - MARGIN, 3), MARGIN
    walk = [positions]
    for _ in range(STEPS - 1):
        step = rng.normal(0, 12, (ROBOTS, 2))
        step[2, 0] = 0.0
        walk.append(np.clip(walk[-1] + step, MARGIN, 512 - MARGIN))
    return walk


def reference_images(environment: object, robot: int) -> F32:
    torch = pytest.importorskip("torch", reason="the reference resizes its maps with torch")
    raw = np.stack(
        [environment.GetRobotLocalMap(robot), environment.GetRobotObstacleMap(robot)]  # type: ignore[attr-defined]
    ).astype(np.float32)
    importance, obstacles = torch.nn.functional.interpolate(
        torch.from_numpy(raw)[None], (32, 32), mode="bilinear", antialias=True
    )[0].numpy()
    maps = environment.GetCommunicationMaps(32)  # type: ignore[attr-defined]
    return np.stack([importance, maps[2 * robot], maps[2 * robot + 1], obstacles])


@pytest.mark.parametrize("seed", range(4))
def test_images_are_the_librarys(seed: int) -> None:
    rng = np.random.default_rng(seed)
    features = random_features(rng, 10, 512)
    walk = random_walk(rng)
    environment = reference_environment(features, walk[0])
    # The library's own raster: ours is compared with it elsewhere.
    sensor = WorldSensor(environment.GetWorldMap().astype(np.float32), PARAMETERS.sensor_size)
    robots = [
        (RobotMemory(PARAMETERS), PolicyImages(PARAMETERS, MAP_CHANNELS[4], 32))
        for _ in range(ROBOTS)
    ]
    seen = 0.0
    for positions in walk:
        environment.SetGlobalRobotPositions(point_vector(positions))
        for i, (memory, policy_images) in enumerate(robots):
            own, others = positions[i], np.delete(positions, i, axis=0)
            memory.observe(own, sensor.view(own))
            near = neighbours_in_range(own, others, PARAMETERS.communication_range)
            images = policy_images.images(own, memory.local_map(own), others[near])[0]
            expected = reference_images(environment, i)
            np.testing.assert_allclose(images, expected, atol=1e-5)
            seen += float(expected[0].sum())
    assert seen > 0.0
