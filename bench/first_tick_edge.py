"""`python -m bench.first_tick_edge`: a robot's policy process."""

import numpy as np

from bench import BUNDLE
from bench.first_tick import ENV_SCALE, NEIGHBOURS_M, POSITION_M, run
from edge.core.aggregation import AggregatedMessage
from edge.core.fleet_time import FleetTime
from edge.core.frames import ModelScale
from edge.core.ports import Odometry
from edge.core.wire import encode
from edge.drivers.world_sensor import WorldSensor
from edge.policy.bundle import load_bundle
from edge.policy.lpac.policy import LpacPolicy
from edge.robot.pac import Pac, PacParameters


class _Standing:
    """A robot that does not move."""

    def odometry(self) -> Odometry:
        return Odometry(POSITION_M, (0.0, 0.0, 0.0))


def main() -> None:
    """Load the bundle, hear ten neighbours, tick."""
    policy = LpacPolicy(load_bundle(BUNDLE))
    perception = policy.manifest.perception
    assert perception
    importance = np.ones((perception.world_size,) * 2, np.float32)
    robot = Pac(
        robot_id=0,
        boot_epoch=1,
        policy=policy,
        sensor=WorldSensor(importance, perception.sensor_size),
        odometry=_Standing(),
        parameters=PacParameters(scale=ModelScale(ENV_SCALE, 0.25), max_speed_m_s=1.25),
    )
    robot.clock.hear(1, 0.0, echoed_at_s=0.0, held_s=0.0, now_s=0.0)
    payload = np.zeros(policy.message_size, np.float32)
    for number, position_m in enumerate(NEIGHBOURS_M, 1):
        message = AggregatedMessage(
            number,
            1,
            1,
            FleetTime(1, 0.0, 0.0),
            position_m,
            velocity_m_s=(0.0, 0.0, 0.0),
            frame_id=0,
            payload=payload,
        )
        robot.receive(encode(message, policy.bundle_id, "float16"), now_s=0.0)

    def tick() -> None:
        robot.perceive(now_s=0.0)
        assert robot.infer(now_s=0.0)

    run(tick)


if __name__ == "__main__":
    main()
