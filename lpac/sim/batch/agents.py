"""Batched counterpart of `edge.policy.family.Agent`: many robots under one policy."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple, Protocol

import numpy as np

from edge.core import F32
from edge.core.aggregation import HopBuffer
from edge.core.part import in_one_line
from edge.core.perception import PerceptionParameters
from edge.drivers.registry import load_policy
from edge.policy.bundle import Bundle
from edge.policy.family import Neighbourhood, Observation, perceived_problem, step_problem
from edge.policy.images import PolicyImages
from edge.policy.lpac.policy import LpacPolicy, position_feature

# Largest batch of the CNN: larger ones are no faster, and take more memory.
_CNN_BATCH = 8

Inputs = Mapping[str, F32]


class PolicyFailedError(ArithmeticError):
    """A policy raised an error, or its output is one that robots refuse.

    `lpac.sim.points.fly_points` shows how they react.
    """


class PolicySteps(NamedTuple):
    """Next step of n robots: see `edge.policy.family.PolicyStep`.

    `velocities` is (n, 2), `payloads` (n, message_size).
    """

    velocities: F32
    payloads: F32


class Agents(Protocol):
    """Robots 0..N-1, of one world or of several, under one policy.

    An observation affects later steps by its features alone, so the simulator computes inputs and
    features only of observations that a step uses.
    """

    @property
    def message_size(self) -> int:
        """The number of floats in a payload."""

    def inputs(self, robot: int, observation: Observation) -> Inputs:
        """New arrays with the policy's inputs from an observation, by the same names for all."""

    def features(self, robots: Sequence[int], inputs: Sequence[Inputs]) -> list[F32]:
        """Features of n robots from their inputs. The only thread-safe method."""

    def step(
        self,
        robots: Sequence[int],
        features: Sequence[F32],
        neighbours: Sequence[Neighbourhood],
    ) -> PolicySteps:
        """`Agent.step` of n distinct robots; payloads are float32, rounded as on the wire."""

    def reset(self, robot: int) -> None:
        """Forget everything, as a restarted program."""


class LpacAgents:
    """Robots under a policy of the paper's family; their only memory is in the messages."""

    def __init__(self, policy: LpacPolicy, perceptions: Sequence[PerceptionParameters]) -> None:
        """`perceptions` has the perception parameters of each robot."""
        self._policy = policy
        self._perceptions = perceptions
        images = policy.lpac.images
        assert images is not None  # a policy without perception makes no agents
        self._images = {
            perception: PolicyImages(perception, images.channels, images.size)
            for perception in set(perceptions)
        }

    @property
    def message_size(self) -> int:
        return self._policy.message_size

    def inputs(self, robot: int, observation: Observation) -> Inputs:
        """The images (channels, size, size), and the position feature (2,)."""
        perception = self._perceptions[robot]
        [images] = self._images[perception].images(*observation[:3])
        return {
            "images": images.copy(),
            "position_feature": position_feature(observation.position, perception.world_size),
        }

    def features(self, robots: Sequence[int], inputs: Sequence[Inputs]) -> list[F32]:
        """n of (F_0,): the CNN's features, and the position's."""
        images = np.stack([each["images"] for each in inputs])
        positions = np.stack([each["position_feature"] for each in inputs])
        seen = [
            self._policy.image_features(images[start : start + _CNN_BATCH])
            for start in range(0, len(images), _CNN_BATCH)
        ]
        return list(np.concatenate([np.concatenate(seen), positions], axis=1))

    def step(
        self,
        robots: Sequence[int],
        features: Sequence[F32],
        neighbours: Sequence[Neighbourhood],
    ) -> PolicySteps:
        hops = HopBuffer(self._policy.geometry, len(robots))
        for i, each in enumerate(neighbours):
            hops.diffuse(each.payloads, each.degree, i)
        velocities = self._policy.velocity(np.stack(features), hops)
        payloads = [hops.message(each.degree, i) for i, each in enumerate(neighbours)]
        return PolicySteps(velocities, np.stack(payloads))

    def reset(self, robot: int) -> None:
        """Do nothing: the agents have no memory."""


class SingleAgents:
    """Robots under a policy of any family, one agent each, one after another."""

    def __init__(self, bundle: Bundle, perceptions: Sequence[PerceptionParameters]) -> None:
        """As `LpacAgents`. Raises BundleError and ConfigError as `load_policy`."""
        policies = {
            perception: load_policy(
                replace(bundle, manifest=replace(bundle.manifest, perception=perception))
            )
            for perception in dict.fromkeys(perceptions)
        }
        self._policies = [policies[perception] for perception in perceptions]
        self._agents = [policy.agent() for policy in self._policies]

    @property
    def message_size(self) -> int:
        return self._policies[0].message_size

    def inputs(self, robot: int, observation: Observation) -> Inputs:
        """The agent's recorded inputs and its features."""
        try:
            perceived = self._agents[robot].observe(observation)
        except Exception as error:
            raise _failed(in_one_line(error)) from error
        if problem := perceived_problem(perceived):
            raise _failed(problem)
        return {**perceived.inputs, "features": perceived.features}

    def features(self, robots: Sequence[int], inputs: Sequence[Inputs]) -> list[F32]:
        return [each["features"] for each in inputs]

    def step(
        self,
        robots: Sequence[int],
        features: Sequence[F32],
        neighbours: Sequence[Neighbourhood],
    ) -> PolicySteps:
        steps = []
        for robot, seen, each in zip(robots, features, neighbours, strict=True):
            try:
                step = self._agents[robot].step(seen, each)
            except Exception as error:
                raise _failed(in_one_line(error)) from error
            if problem := step_problem(step, self.message_size):
                raise _failed(problem)
            steps.append(step)
        return PolicySteps(
            np.stack([step.velocity for step in steps]), np.stack([step.payload for step in steps])
        )

    def reset(self, robot: int) -> None:
        self._agents[robot] = self._policies[robot].agent()


def _failed(problem: str) -> PolicyFailedError:
    return PolicyFailedError(f"policy: {problem}")


def make_agents(bundle: Bundle, perceptions: Sequence[PerceptionParameters]) -> Agents:
    """The fastest agents available for the bundle's family, one for each of `perceptions`.

    Raises BundleError and ConfigError as `load_policy`.
    """
    policy = load_policy(bundle)
    if isinstance(policy, LpacPolicy):
        return LpacAgents(policy, perceptions)
    return SingleAgents(bundle, perceptions)
