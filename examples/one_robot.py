"""One robot's steps by hand: it perceives, infers and is controlled, and hears one neighbour.

What a drone's threads call, and the simulator, is called here in a loop.
"""

import numpy as np

from lpac.api import (
    FIELD_SCALE,
    SHIPPED_BUNDLE,
    Pac,
    PacParameters,
    PointVehicles,
    VehicleOdometry,
    WorldSensor,
    load_bundle,
    load_policy,
    random_features,
    rasterize,
)

bundle = load_bundle(SHIPPED_BUNDLE)
policy = load_policy(bundle)
perception, training = bundle.manifest.perception, bundle.manifest.training

# A world of 512 x 512 model units, 16 of which are a metre of the field; and two robots in it.
features = random_features(np.random.default_rng(7), 10, perception.world_size)
importance = rasterize(features, perception.world_size)
vehicles = PointVehicles(np.array([[6.0, 8.0], [14.0, 12.0]]), world_size_m=32.0)
parameters = PacParameters(
    scale=FIELD_SCALE,
    max_speed_m_s=training.max_speed * FIELD_SCALE.velocity_scale,
    max_message_age_s=0.0,  # each message counts once: these robots have no common clock
)
robots = [
    Pac(
        robot_id=number,
        policy=policy,
        sensor=WorldSensor(importance, perception.sensor_size),
        odometry=VehicleOdometry(vehicles, number),
        parameters=parameters,
    )
    for number in range(2)
]
for tick in range(10):
    now_s = vehicles.now_s = 0.4 * tick
    for number, robot in enumerate(robots):
        perceived = robot.perceive(now_s)  # view -> map -> images -> 34 features
        did = robot.infer(now_s)  # features and messages -> velocity and an own message
        assert perceived and did  # None where there is no position, view or message
        robots[1 - number].receive(robot.beacon(now_s), (1, tick), did.message, now_s)
        velocity_m_s = robot.control(now_s)  # within the speed limit; None if all is too old
        vehicles.fly(number, np.zeros(2) if velocity_m_s is None else velocity_m_s)
        print(
            f"{now_s:3.1f} s  robot {number} at {vehicles.position_m(number).round(2)} m, "
            f"heard {did.senders}, goes {vehicles.velocity_m_s(number).round(2)} m/s, "
            f"says {len(did.message)} bytes"
        )
