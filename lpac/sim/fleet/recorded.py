"""Recorded decisions of policies in a simulated flight: the same flight on any CPU.

onnxruntime's numbers differ in the last bits from one type of CPU to another, and a flight then
goes another way. Their flight logs hold what the robots' policies made of it.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from edge.core import F32
from edge.core.part import PartError
from edge.core.wire import Rejection, decode
from edge.drivers.flight_log import read, read_metadata
from edge.policy.family import Observation, Perceived, Policy, PolicyStep


class RecordingError(ValueError):
    """The logs are not those of this flight; the text says which, and why."""


class RecordedAgent:
    """One robot's agent, of which each step is as its log has it."""

    def __init__(self, steps: "RecordedSteps", unix_s: Callable[[], float]) -> None:
        """`unix_s` is the simulated wall clock."""
        self._steps = steps
        self._unix_s = unix_s

    def observe(self, observation: Observation) -> Perceived:
        """Its steps need no features."""
        return Perceived(np.zeros(0, np.float32), {})

    def step(self, features: F32, payloads: Sequence[F32], degree: int) -> PolicyStep:
        """Decision at this time. Raises PartError if there was none."""
        return self._steps.at(self._unix_s())

    def reset(self) -> None:
        """It remembers nothing."""


class RecordedSteps:
    """The steps of one robot in one flight, by their times."""

    def __init__(self, steps: Mapping[int, PolicyStep]) -> None:
        self._steps = steps

    def at(self, unix_time_s: float) -> PolicyStep:
        """Raises PartError if there was none."""
        step = self._steps.get(_in_ms(unix_time_s))
        if step is None:
            raise PartError(
                f"the robot's log has no step at {unix_time_s:.3f} s: it is of another flight, or "
                "of other options"
            )
        return step


def recorded_steps(folder: Path, robot_id: int, policy: Policy) -> RecordedSteps:
    """Of a robot, from what a simulated flight left in its folder.

    Raises RecordingError if there are no logs of one flight with this policy; OSError.
    """
    logs = sorted((folder / "robots" / str(robot_id)).rglob("*.mcap"))
    if not logs:
        raise RecordingError(f"{folder}: has no flight log of robot {robot_id}")
    steps: dict[int, PolicyStep] = {}
    perception = policy.manifest.perception
    for log in logs:
        if bytes.fromhex(read_metadata(log).bundle_id) != policy.bundle_id:
            raise RecordingError(f"{log}: was flown with another policy")
        for _, unix_time_s, message in read(log, "policy"):
            sent = decode(
                message["message"],
                message_size=policy.message_size,
                shared_side=perception.shared_map_side if perception else 0,
            )
            if isinstance(sent, Rejection):
                raise RecordingError(f"{log}: at {unix_time_s:.3f} s: a message is {sent}")
            step = PolicyStep(message["velocity"], sent.payload.astype(np.float32))
            if steps.setdefault(_in_ms(unix_time_s), step) is not step:
                raise RecordingError(f"{folder}: holds logs of more than one flight")
    return RecordedSteps(steps)


def _in_ms(unix_time_s: float) -> int:
    """No two steps of a policy are so near each other; a log keeps times far more exactly."""
    return round(unix_time_s * 1e3)
