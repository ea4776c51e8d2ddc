"""Replay of a flight log: does the policy compute the same outputs again?"""

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from edge.core import F32
from edge.core.aggregation import AggregatedMessage
from edge.core.wire import Rejection, decode, encode, payload_type_of
from edge.policy.bundle import BundleError
from edge.policy.family import Neighbourhood, Policy, Replayable

_Array = npt.NDArray[Any]


class ReplayError(ValueError):
    """The messages do not belong to a flight with this policy; the text names one and the cause."""


@dataclass(slots=True)
class Comparison:
    """One output of the policy over all ticks: logged against computed.

    `largest_difference` is absolute; NaN where only one of the two is NaN.
    """

    name: str
    ticks: int = 0
    differing: int = 0
    largest_difference: float = 0.0

    def add(self, logged: _Array, computed: _Array) -> None:
        """Compare one tick's arrays, of equal shape."""
        self.ticks += 1
        if np.array_equal(logged, computed, equal_nan=True):
            return
        self.differing += 1
        with np.errstate(invalid="ignore"):
            difference = np.abs(logged.astype(np.float64) - computed.astype(np.float64)).max()
        self.largest_difference = float(np.maximum(self.largest_difference, difference))


def replay(
    policy: Policy, messages: Iterable[tuple[str, float, Mapping[str, Any]]]
) -> tuple[Comparison, ...]:
    """Run every tick again from its logged inputs; compare features, velocity and message.

    `messages` are (topic, Unix time in s, message). Topics other than `perception` (features and
    inputs of a `Perceived`) and `policy` (the fields of a `PolicyTick`) are skipped. Each tick is
    independent, so gaps are harmless. Payloads are compared as sent: in float16 or int8 if that was
    their type. Returns nothing for a policy that is not `Replayable`.

    Raises ReplayError that names the tick if a message does not belong to this policy, and
    BundleError if robots cannot fly it.
    """
    if not isinstance(policy, Replayable):
        return ()
    features, velocity, payload = (Comparison(n) for n in ("features", "velocity", "message"))
    for topic, unix_time_s, message in messages:
        try:
            if topic == "perception":
                computed = policy.logged_features(message)
                features.add(_array("features", message["features"], computed.shape), computed)
            elif topic == "policy":
                velocities, payloads = _step(policy, policy, message)
                velocity.add(*velocities)
                payload.add(*payloads)
        except BundleError:
            raise
        except KeyError as error:
            raise ReplayError(f"{topic} at {unix_time_s:.3f} s: {error} is missing") from None
        # onnxruntime's exceptions share no base class.
        except Exception as error:
            raise ReplayError(f"{topic} at {unix_time_s:.3f} s: {error}") from None
    return features, velocity, payload


def _step(
    policy: Policy, replayable: Replayable, message: Mapping[str, Any]
) -> tuple[tuple[_Array, _Array], tuple[_Array, _Array]]:
    """Velocity, logged and computed; payload, sent and computed."""
    logged = _array("velocity", message["velocity"], (2,))
    payloads = [_array("payloads", each, (policy.message_size,)) for each in message["payloads"]]
    count, degree = len(payloads), message["degree"]
    if degree < count:
        raise ValueError(f"degree = {degree}: must be at least {count}, the payloads")
    neighbours = Neighbourhood(
        robot_ids=tuple(message["senders"]),
        payloads=payloads,
        positions=_array("positions", message["positions"], (count, 2)),
        velocities=_array("velocities", message["velocities"], (count, 2)),
        ages_s=_array("ages_s", message["ages_s"], (count,)),
        degree=degree,
    )
    sent = _decoded(policy, message["message"])
    step = replayable.logged_step(message["features"], neighbours, message["inputs"])
    now = dataclasses.replace(sent, payload=step.payload)
    again = _decoded(policy, encode(now, payload_type_of(message["message"])))
    return (logged, step.velocity), (sent.payload, again.payload)


def _array(name: str, value: object, shape: tuple[int, ...]) -> F32:
    if not isinstance(value, np.ndarray) or value.dtype.kind != "f" or value.shape != shape:
        found = getattr(value, "shape", type(value).__name__)
        raise ValueError(f"{name}: is {found}; the policy needs {shape}")
    return value


def _decoded(policy: Policy, data: bytes) -> AggregatedMessage:
    perception = policy.manifest.perception
    message = decode(
        data,
        message_size=policy.message_size,
        shared_side=perception.shared_map_side if perception else 0,
    )
    if isinstance(message, Rejection):
        raise ValueError(f"message would be refused: {message}")
    return message
