"""Interfaces of a policy family.

A bundle's manifest names its family. The family makes a `Policy` of the bundle, shared by all
robots of a program; the policy makes an `Agent` for each robot. `edge.policy.lpac` is the paper's
family.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from edge.core import F32, F64
from edge.core.part import array_problem, in_one_line
from edge.policy.bundle import Bundle, BundleError, Manifest

# Six times the float32 rounding on x86-64 and on AArch64.
TOLERANCE = 1e-5
_NO_INPUTS: Mapping[str, F32] = {}


@dataclass(frozen=True, slots=True)
class GoldenCheck:
    """Error of one part of a policy on this machine relative to the bundle's golden outputs."""

    name: str
    relative_error: float
    tolerance: float = TOLERANCE

    @property
    def passed(self) -> bool:
        """Whether the error is within the tolerance; False for NaN."""
        return self.relative_error <= self.tolerance


class Observation(NamedTuple):
    """Inputs of a perception step, in model units. Arrays are valid until the next step.

    `position` (2,) is the robot's, or the nearest point of the world. `local_map` (local_map_size,
    local_map_size), indexed [x, y], is the importance seen around it, 0 outside the world;
    `edge.core.perception.window_corner` gives its place in the world. Unseen cells have the
    manifest's `unknown_importance`, or NaN if `unseen_as_nan` is set. `neighbours` (n, 2) are the
    positions of the robots in communication range. `velocity` (2,) is the robot's own, in model
    units/s like that of `PolicyStep`.
    """

    position: F64
    local_map: F32
    neighbours: F64
    velocity: F64


class Perceived(NamedTuple):
    """An agent's result of an observation, in new arrays.

    `features` has a shape of the agent's choice; `inputs`, by name, are written to the flight log.
    """

    features: F32
    inputs: Mapping[str, F32]


class Neighbourhood(NamedTuple):
    """The neighbours' newest messages at a policy step, in the order of the robots' ids.

    `robot_ids` (n,) are the senders, `payloads` n of (message_size,), float16 or float32.
    `positions` (n, 2), in model units, are the senders' when they sent, relative to the robot's
    present one; `velocities` (n, 2), in model units/s, are theirs then. `ages_s` (n,) are the
    messages' greatest possible ages. `degree` is the number of robots in range, including those
    without a message this time.
    """

    robot_ids: tuple[int, ...]
    payloads: Sequence[F32]
    positions: F32
    velocities: F32
    ages_s: F32
    degree: int

    @classmethod
    def silent(cls, degree: int) -> "Neighbourhood":
        """Robots in range without any message."""
        nowhere, never = np.zeros((0, 2), np.float32), np.zeros(0, np.float32)
        return cls((), (), nowhere, nowhere, never, degree)


class PolicyStep(NamedTuple):
    """An agent's next action and message, in new arrays.

    `velocity` (2,) is in model units/s, `payload` (message_size,) is sent to the neighbours.
    `inputs`, by name, are written to the flight log: the agent's state before the step.
    """

    velocity: F32
    payload: F32
    inputs: Mapping[str, F32] = _NO_INPUTS


class Agent(Protocol):
    """One robot's instance of a policy.

    The perception thread calls `observe`; the policy thread calls `step` and `reset`. They share
    only the features, which are passed on.
    """

    def observe(self, observation: Observation) -> Perceived:
        """Compute features. The observation's map is the only memory of what the robot saw."""

    def step(self, features: F32, neighbours: Neighbourhood) -> PolicyStep:
        """Compute an action from the newest features and the neighbours' newest messages.

        A velocity or payload that is not finite, or has another shape or type, stops the robot.
        """

    def reset(self) -> None:
        """Forget the state of `step`: a new mission begins."""


def perceived_problem(perceived: object) -> str:
    """Why the result of `Agent.observe` is invalid; "" if it is valid."""
    if not isinstance(perceived, Perceived):
        return f"observe gives a {type(perceived).__name__}: must be a Perceived"
    if not isinstance(perceived.features, np.ndarray):
        return f"features are a {type(perceived.features).__name__}: must be a numpy array"
    return ""


def step_problem(step: object, message_size: int) -> str:
    """Why the result of `Agent.step` is invalid; "" if it is valid."""
    if not isinstance(step, PolicyStep):
        return f"step gives a {type(step).__name__}: must be a PolicyStep"
    return array_problem("velocity", step.velocity, (2,)) or array_problem(
        "payload", step.payload, (message_size,)
    )


class Policy(Protocol):
    """A loaded bundle, without state: safe to call from several threads."""

    @property
    def manifest(self) -> Manifest:
        """The bundle's manifest; its `perception` determines the observations."""

    @property
    def bundle_id(self) -> bytes:
        """The bundle's id, 32 bytes."""

    @property
    def message_size(self) -> int:
        """Number of floats in a robot's message; 0 or more."""

    def agent(self) -> Agent:
        """Make a new robot's agent. Raises BundleError if robots cannot fly this bundle."""

    def verify(self) -> Iterator[GoldenCheck]:
        """Compare with the bundle's golden outputs; yields nothing if it has none.

        Raises BundleError if they cannot be read.
        """


@runtime_checkable
class Replayable(Protocol):
    """A policy whose features and steps can be computed again from a flight log."""

    def logged_features(self, inputs: Mapping[str, F32]) -> F32:
        """Features from the `Perceived.inputs` of an observation. Raises KeyError, ValueError."""

    def logged_step(
        self, features: F32, neighbours: Neighbourhood, inputs: Mapping[str, F32]
    ) -> PolicyStep:
        """Step with the `PolicyStep.inputs` of a step. Raises KeyError, ValueError."""


class PolicyFamily(Protocol):
    """Constructor of a family's policies."""

    def __call__(self, bundle: Bundle) -> Policy:
        """Load the bundle. Raises BundleError, one line, if it does not fit the family."""


@dataclass(frozen=True, slots=True, eq=False)
class VerifiedPolicy:
    """A policy after verification on this CPU; `problem` is None if it passed."""

    policy: Policy
    problem: str | None


def golden_checks(policy: Policy) -> Iterator[GoldenCheck]:
    """Run the policy's `verify`. Turns all its exceptions into BundleError."""
    try:
        yield from policy.verify()
    except BundleError:
        raise
    except Exception as error:  # families may come from other packages
        raise BundleError(f"policy: verify: {in_one_line(error)}") from error


def verified(policy: Policy) -> VerifiedPolicy:
    """Verify the policy. Raises BundleError if its golden outputs cannot be read."""
    failed = [check.name for check in golden_checks(policy) if not check.passed]
    problem = None
    if failed:
        problem = f"{', '.join(failed)} did not reproduce the bundle's golden outputs here"
    return VerifiedPolicy(policy, problem)
