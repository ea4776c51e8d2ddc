"""Agents that replace a policy's own in simulation."""

from collections.abc import Callable, Iterator

import numpy as np

from edge.core import F32
from edge.policy.bundle import Manifest
from edge.policy.family import (
    Agent,
    GoldenCheck,
    Neighbourhood,
    Observation,
    Perceived,
    Policy,
    PolicyStep,
)
from edge.policy.lpac.policy import LpacAgent


class PolicyWithAgents:
    """A verified policy with agents made by `agent`. See `Policy`."""

    def __init__(self, policy: Policy, agent: Callable[[], Agent]) -> None:
        self._policy = policy
        self.agent = agent

    @property
    def manifest(self) -> Manifest:
        """The bundle's."""
        return self._policy.manifest

    @property
    def bundle_id(self) -> bytes:
        """The bundle's."""
        return self._policy.bundle_id

    @property
    def message_size(self) -> int:
        """The policy's."""
        return self._policy.message_size

    def verify(self) -> Iterator[GoldenCheck]:
        """Yield nothing: the policy is already verified."""
        return iter(())


class DeferredAgent(LpacAgent):
    """`LpacAgent` that computes features only when it decides, of the last observation.

    The steps are those of `LpacAgent`, but its features cannot be logged.
    """

    _seen: Observation | None = None
    _features: F32 = np.zeros(0, np.float32)

    def observe(self, observation: Observation) -> Perceived:
        """Keep the observation; returns no features."""
        # Its map is valid until the next observation.
        self._seen = observation
        return Perceived(np.zeros(0, np.float32), {})

    def step(self, features: F32, neighbours: Neighbourhood) -> PolicyStep:
        """Step on the last observation; `features` are ignored."""
        if self._seen is not None:
            self._features, self._seen = super().observe(self._seen).features, None
        return super().step(self._features, neighbours)
