"""One robot with a policy and received messages, without a flight."""

import numpy as np

from edge.core.wire import most_bytes
from edge.drivers.registry import load_policy
from edge.identity.envelope import OVERHEAD_BYTES
from edge.messages.beacon import BEACON_BYTES
from edge.policy.bundle import Bundle
from edge.policy.family import Neighbourhood, Observation, PolicyStep


class ReceivingRobot:
    """A robot that receives from `others` robots around it.

    Raises BundleError if robots cannot fly the bundle.
    """

    def __init__(self, others: int, bundle: Bundle) -> None:
        policy, perception = load_policy(bundle), bundle.manifest.perception
        assert perception is not None
        self._agent = policy.agent()
        rng = np.random.default_rng(0)
        middle = np.full(2, perception.world_size / 2.0)
        reach = perception.communication_range / 2.0
        self._observed = Observation(
            middle,
            rng.random((perception.local_map_size,) * 2, np.float32),
            middle + rng.uniform(-reach, reach, (others, 2)),
            np.zeros(2),
        )
        self._neighbours = Neighbourhood(
            robot_ids=tuple(range(1, others + 1)),
            payloads=list(rng.random((others, policy.message_size), np.float32)),
            positions=(self._observed.neighbours - middle).astype(np.float32),
            velocities=np.zeros((others, 2), np.float32),
            ages_s=np.zeros(others, np.float32),
            degree=others,
        )

    def step(self) -> PolicyStep:
        """Perceive and decide."""
        features = self._agent.observe(self._observed).features
        return self._agent.step(features, self._neighbours)


def message_bytes(bundle: Bundle, others: int) -> int:
    """Size of the largest message of a robot with `others` neighbours, in float16.

    Raises BundleError if robots cannot fly the bundle.
    """
    assert bundle.manifest.perception is not None
    payload = ReceivingRobot(others, bundle).step().payload
    of_policy = most_bytes(payload.size, "float16", bundle.manifest.perception.shared_map_side)
    return BEACON_BYTES + of_policy + OVERHEAD_BYTES
