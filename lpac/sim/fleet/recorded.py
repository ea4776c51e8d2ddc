"""Replay of recorded policy outputs, for the same simulated flight on any CPU.

onnxruntime's results differ in the last bits between types of CPU, and the flights then diverge.
The flight logs hold the policies' outputs.
"""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from edge.core import F32
from edge.core.part import PartError
from edge.core.wire import Rejection, decode
from edge.drivers.log_reader import read, read_metadata
from edge.policy.family import Neighbourhood, Observation, Perceived, Policy, PolicyStep


class RecordingError(ValueError):
    """The logs do not belong to this flight; the text says which, and why."""


class RecordedAgent:
    """Agent that replays the steps of one robot's log."""

    def __init__(self, steps: "RecordedSteps", unix_s: Callable[[], float]) -> None:
        """`unix_s` is the simulated wall clock."""
        self._steps = steps
        self._unix_s = unix_s

    def observe(self, observation: Observation) -> Perceived:
        """Returns no features: its steps need none."""
        return Perceived(np.zeros(0, np.float32), {})

    def step(self, features: F32, neighbours: Neighbourhood) -> PolicyStep:
        """Recorded step at this time. Raises PartError if there is none."""
        return self._steps.at(self._unix_s())

    def reset(self) -> None:
        """Do nothing: it has no memory."""


class RecordedSteps:
    """Steps of one robot in one flight, by time, ms."""

    def __init__(self, steps: Mapping[int, PolicyStep]) -> None:
        self._steps = steps

    def at(self, unix_time_s: float) -> PolicyStep:
        """Step at that Unix time. Raises PartError if there is none."""
        step = self._steps.get(_in_ms(unix_time_s))
        if step is None:
            raise PartError(
                f"the robot's log has no step at {unix_time_s:.3f} s: it is of another flight, or "
                "of other options"
            )
        return step


def recorded_steps(folder: Path, robot_id: int, policy: Policy) -> RecordedSteps:
    """Steps of a robot, from the folder of a simulated flight.

    Raises RecordingError unless its logs are of one flight with this policy; OSError.
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
    """Time key of a step: steps are further apart, and a log's times far more exact."""
    return round(unix_time_s * 1e3)
