"""Interface of a policy family, so that robots can fly its policies.

A bundle's manifest names its family. The family makes a `Policy` of the bundle, which all robots of
a program share; that gives each robot an `Agent`. `edge.policy.lpac` is the family of the paper.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from edge.core import F32, F64
from edge.core.part import array_problem, in_one_line
from edge.policy.bundle import Bundle, BundleError, Manifest

# Float32 rounding stays a factor of six below it, on x86-64 and on AArch64.
TOLERANCE = 1e-5


@dataclass(frozen=True, slots=True)
class GoldenCheck:
    """How far one part of a policy is, on this machine, from the bundle's golden outputs."""

    name: str
    relative_error: float

    @property
    def passed(self) -> bool:
        """Whether the error is within TOLERANCE (a NaN is not)."""
        return self.relative_error <= TOLERANCE


class Observation(NamedTuple):
    """A robot's knowledge when it perceives; model units, arrays valid until the next one.

    `position` (2,) is the robot's, or the nearest point of the world to it. `local_map`
    (local_map_size, local_map_size), indexed [x, y], is the importance around it as far as it was
    seen, 0 outside the world; `edge.core.perception.window_corner` says which cell is where. Cells
    that were not seen have the manifest's `unknown_importance`, or are NaN if `unseen_as_nan` is
    set there. `neighbours` (n, 2) are the positions of the robots in communication range;
    `velocity` (2,) is the robot's own, in model units/s as a `PolicyStep` has it.
    """

    position: F64
    local_map: F32
    neighbours: F64
    velocity: F64


class Perceived(NamedTuple):
    """An agent's result from an observation.

    `features` is a new array, of what shape is the agent's matter; `inputs` is what it was computed
    from, by name, which the flight log keeps.
    """

    features: F32
    inputs: Mapping[str, F32]


class PolicyStep(NamedTuple):
    """An agent's next action and message: new arrays.

    `velocity` (2,) is in model units/s, `payload` (message_size,) what its neighbours are told.
    """

    velocity: F32
    payload: F32


class Agent(Protocol):
    """One robot under a policy.

    `observe` is called from the perception thread, `step` and `reset` from the policy thread; they
    share nothing but the features, which are handed on.
    """

    def observe(self, observation: Observation) -> Perceived:
        """Look. What the robot has seen before is in the observation's map, and nowhere else."""

    def step(self, features: F32, payloads: Sequence[F32], degree: int) -> PolicyStep:
        """Decide, by the newest features and the neighbours' newest messages.

        `payloads` are of (message_size,), float16 or float32, in the order of the robots' ids;
        `degree` is how many neighbours the robot has, heard this time or not. A velocity or a
        payload that is not finite, or of another shape or type, stops the robot.
        """

    def reset(self) -> None:
        """A new mission begins: what `step` remembers of the last one is forgotten."""


def perceived_problem(perceived: object) -> str:
    """Why what `Agent.observe` gave is not used; "" if nothing is wrong with it."""
    if not isinstance(perceived, Perceived):
        return f"observe gives a {type(perceived).__name__}: must be a Perceived"
    if not isinstance(perceived.features, np.ndarray):
        return f"features are a {type(perceived.features).__name__}: must be a numpy array"
    return ""


def step_problem(step: object, message_size: int) -> str:
    """Why what `Agent.step` gave is not used; "" if nothing is wrong with it."""
    if not isinstance(step, PolicyStep):
        return f"step gives a {type(step).__name__}: must be a PolicyStep"
    return array_problem("velocity", step.velocity, (2,)) or array_problem(
        "payload", step.payload, (message_size,)
    )


class Policy(Protocol):
    """A loaded bundle. Has no state of its own: several threads may use it at once."""

    @property
    def manifest(self) -> Manifest:
        """The bundle's; its `perception` is what the policy observes."""

    @property
    def bundle_id(self) -> bytes:
        """The bundle's, 32 bytes."""

    @property
    def message_size(self) -> int:
        """How many floats a robot tells its neighbours at each step; 0 or more."""

    def agent(self) -> Agent:
        """For one robot that has not flown yet. Raises BundleError if no robot can fly this."""

    def verify(self) -> Iterator[GoldenCheck]:
        """Compute the bundle's golden outputs again; nothing if it has none.

        Raises BundleError if what it says cannot be read.
        """


class PolicyFamily(Protocol):
    """Makes policies."""

    def __call__(self, bundle: Bundle) -> Policy:
        """Raises BundleError, one line, for a bundle that is not as the family needs it."""


@dataclass(frozen=True, slots=True, eq=False)
class VerifiedPolicy:
    """A policy that was tried on this CPU; `problem` is why it does not pass, None if it does."""

    policy: Policy
    problem: str | None


def golden_checks(policy: Policy) -> Iterator[GoldenCheck]:
    """Run the policy's `verify`. Raises BundleError, also for whatever else that raises."""
    try:
        yield from policy.verify()
    except BundleError:
        raise
    except Exception as error:  # a family may be anybody's
        raise BundleError(f"policy: verify: {in_one_line(error)}") from error


def verified(policy: Policy) -> VerifiedPolicy:
    """Try it. Raises BundleError if it has nothing to be tried with that can be read."""
    failed = [check.name for check in golden_checks(policy) if not check.passed]
    problem = None
    if failed:
        problem = f"{', '.join(failed)} of the bundle do not compute its golden outputs here"
    return VerifiedPolicy(policy, problem)
