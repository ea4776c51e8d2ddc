"""Replay of a flight log: does the policy compute the same outputs again?"""

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from edge.core.aggregation import AggregatedMessage, HopBuffer
from edge.core.wire import Rejection, decode, encode, payload_type_of
from edge.policy.bundle import BundleError
from edge.policy.lpac.policy import LpacPolicy

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
    policy: LpacPolicy, messages: Iterable[tuple[str, float, Mapping[str, Any]]]
) -> tuple[Comparison, Comparison, Comparison]:
    """Run every tick again from its logged inputs; compare features, velocity and message.

    `messages` are (topic, Unix time in s, message). Topics other than `perception` (features and
    inputs of a `Perceived`) and `policy` (the fields of a `PolicyTick`) are skipped. Each tick is
    independent, so gaps are harmless. Payloads are compared as sent: in float16 or int8 if that was
    their type.

    Raises ReplayError that names the tick if a message does not belong to this policy, and
    BundleError if robots cannot fly it.
    """
    features, velocity, payload = (Comparison(n) for n in ("features", "velocity", "message"))
    hops = HopBuffer(policy.geometry)
    for topic, unix_time_s, message in messages:
        try:
            if topic == "perception":
                features.add(*_perceive(policy, message))
            elif topic == "policy":
                velocities, payloads = _infer(policy, hops, message)
                velocity.add(*velocities)
                payload.add(*payloads)
        except BundleError:
            raise
        except KeyError as error:
            raise ReplayError(f"{topic} at {unix_time_s:.3f} s: {error} is missing") from None
        except (AttributeError, OverflowError, TypeError, ValueError) as error:
            raise ReplayError(f"{topic} at {unix_time_s:.3f} s: {error}") from None
    return features, velocity, payload


def _perceive(policy: LpacPolicy, message: Mapping[str, Any]) -> tuple[_Array, _Array]:
    """The logged features, and the computed ones."""
    inputs = policy.lpac.images
    if inputs is None:
        raise BundleError(f"bundle {policy.manifest.name!r} has no perception: no robot can fly it")
    shape = (1, len(inputs.channels), inputs.size, inputs.size)
    images = _checked("images", message["images"], shape)
    position_feature = _checked("position_feature", message["position_feature"], (2,))
    logged = _checked("features", message["features"], policy.geometry.feature_sizes[:1])
    return logged, np.concatenate([policy.image_features(images)[0], position_feature])


def _infer(
    policy: LpacPolicy, hops: HopBuffer, message: Mapping[str, Any]
) -> tuple[tuple[_Array, _Array], tuple[_Array, _Array]]:
    """Velocity, logged and computed; payload, sent and computed."""
    geometry = policy.geometry
    features = _checked("features", message["features"], geometry.feature_sizes[:1])
    logged = _checked("velocity", message["velocity"], (2,))
    payloads = [_checked("payloads", p, (geometry.message_size,)) for p in message["payloads"]]
    degree = message["degree"]
    if degree < len(payloads):
        raise ValueError(f"degree = {degree}: must be at least {len(payloads)}, the payloads")
    sent = _decoded(policy, message["message"])
    hops.diffuse(payloads, degree)
    [velocity] = policy.velocity(features[None], hops)
    now = dataclasses.replace(sent, payload=hops.message(degree))
    again = _decoded(policy, encode(now, payload_type_of(message["message"])))
    return (logged, velocity), (sent.payload, again.payload)


def _checked(name: str, value: object, shape: tuple[int, ...]) -> _Array:
    if not isinstance(value, np.ndarray) or value.dtype.kind != "f" or value.shape != shape:
        found = getattr(value, "shape", type(value).__name__)
        raise ValueError(f"{name}: is {found}; the policy needs {shape}")
    return value


def _decoded(policy: LpacPolicy, data: bytes) -> AggregatedMessage:
    perception = policy.manifest.perception
    message = decode(
        data,
        message_size=policy.geometry.message_size,
        shared_side=perception.shared_map_side if perception else 0,
    )
    if isinstance(message, Rejection):
        raise ValueError(f"message would be refused: {message}")
    return message
