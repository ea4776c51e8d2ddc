"""Flight log: MCAP files for Foxglove and `lpac replay`.

A segment is a file `<name>-<number>.mcap`: a metadata record `lpac` with the robot, program and
policy, then zstd chunks of JSON messages. Numbers increase over all starts, so they give the order
even if the clock is wrong. A robot's segments are named `robot-<id>` and have these topics (for the
ground's, see `lpac.ground.record`):

| topic | content |
| --- | --- |
| `perception` | a tick of the perception loop: features and their sources |
| `policy` | a tick of the policy loop: features, neighbours' payloads, velocity, message sent |
| `received` | a neighbour's message, and the reason if it was refused |
| `control` | a tick of the control loop: state, position, setpoint, and the part of it sent |
| `flight` | the same tick for `lpac replay`: all inputs and results, or their changes |
| `status`, `ground`, `vehicle` | `RobotStatus`, `GroundState`, `VehicleState` |
| `order` | `Order`, and its answer |
| `/pose` | `position_m` (3,) and `yaw_rad` (from x to y, or None) in the mission frame |
| `/log` | `level` (debug, info, warning, error, critical), `message`, `name` |

The last two are converted to Foxglove's own messages. In JSON, an array is an object with its numpy
dtype, shape and bytes in base64, and bytes are an object `{"base64": ...}`. Dataclasses and named
tuples are objects. Numbers that are not finite are the strings "NaN", "Infinity" and "-Infinity".
"""

import binascii
import contextlib
import dataclasses
import errno
import json
import math
import os
import re
import shutil
import time
import types
import typing
import zlib
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path
from threading import Lock
from typing import Any, BinaryIO, ClassVar, Literal, NamedTuple, Protocol

import numpy as np
from mcap.writer import CompressionType, Writer

from edge.core.logger import log
from edge.core.schema import AtLeastOne, require
from edge.core.vehicle import VehicleState
from edge.messages.mission import GroundState, Order, OrderResult, RobotStatus

_METADATA = "lpac"
# Bytes that MCAP adds to a message and to a chunk, including indexes and summary.
_MESSAGE_OVERHEAD_BYTES = 64
_CHUNK_OVERHEAD_BYTES = 512
_SMALLEST_SEGMENT_BYTES = 2**18
# Space left for other files; on a small disk, a tenth of it.
_LEAST_FREE_BYTES = 20_000_000
# Limits for readers of logs from unknown sources.
MOST_MESSAGE_BYTES = 2**22
MOST_CHUNK_BYTES = 2**24
ARRAY_KINDS = "biuf"


class LogMetadata(Protocol):
    """Metadata of a log's writer: a dataclass, written as text to every segment."""

    __dataclass_fields__: ClassVar[dict[str, dataclasses.Field[Any]]]

    @property
    def log_name(self) -> str:
        """Name of the segments, without number."""
        ...


@dataclass(frozen=True, slots=True)
class FlightMetadata:
    """Robot, program, policy and configuration of a log.

    `bundle_id` is in hexadecimal, `bundle_path` its path on the robot, `configuration` the robot's
    configuration as JSON.
    """

    robot_id: int
    boot_nonce: int
    bundle_id: str
    bundle_path: str
    configuration: str
    version: str

    @property
    def log_name(self) -> str:
        """Name of a robot's segments."""
        return f"robot-{self.robot_id}"


_Convert = Callable[[int, Mapping[str, Any]], Mapping[str, object]]


class LoggedTopic(NamedTuple):
    """JSON schema of a topic's messages, and `convert`, called with time in ns and message."""

    schema_name: str
    schema: bytes
    convert: _Convert


def topic(name: str, kind: type | None = None, /, **more: Any) -> LoggedTopic:
    """Topic of messages with the fields of the dataclass `kind`, and `more` (name -> type)."""
    hints = {} if kind is None else typing.get_type_hints(kind)
    return _topic(f"lpac.{name}", _unchanged, **hints, **more)


class FlightLog:
    """Writer of a robot's or the ground's log; implements `Recorder`.

    `record` is thread-safe; call the other methods from one thread at a time. No method raises in
    flight. After an error of the file system, or while the disk is full, nothing is written, which
    is logged once; writing resumes in a new segment as soon as possible.
    """

    def __init__(
        self,
        directory: Path,
        metadata: LogMetadata,
        topics: Mapping[str, LoggedTopic] | None = None,
        *,
        max_segment_bytes: int = 2**25,
        max_total_bytes: int = 2**30,
        max_queued_messages: int = 2000,
        sync_period_s: float = 1.0,
    ) -> None:
        """Start a segment in `directory`, created if needed. Default `topics`: a robot's.

        A killed process or a power loss costs the messages of the last `sync_period_s`. A battery
        swap is a power loss, and the kernel alone would write up to half a minute late. Shorter
        periods compress worse.

        No segment grows beyond `max_segment_bytes`. The oldest segments of this name, also of
        earlier starts, are deleted to keep their total within `max_total_bytes`. They also make
        room on the disk: 20 MB stay free, or a tenth of a smaller disk.

        Raises ValueError for an impossible limit. `recording` is False while nothing can be
        written.
        """
        if max_segment_bytes < _SMALLEST_SEGMENT_BYTES:
            raise ValueError(
                f"max_segment_bytes = {max_segment_bytes}: must be at least "
                f"{_SMALLEST_SEGMENT_BYTES}"
            )
        if max_total_bytes < max_segment_bytes:
            raise ValueError(
                f"max_total_bytes = {max_total_bytes}: must be at least "
                f"max_segment_bytes = {max_segment_bytes}"
            )
        require(AtLeastOne, max_queued_messages, "max_queued_messages")
        self._directory = directory
        self._metadata = metadata
        self._topics = ROBOT_TOPICS if topics is None else topics
        self._max_segment_bytes = max_segment_bytes
        self._max_total_bytes = max_total_bytes
        self._lock = Lock()
        self._queue: deque[tuple[str, float, Mapping[str, object]]] = deque(
            maxlen=max_queued_messages
        )
        self._dropped = 0
        self._dropped_reported = 0
        self._refused_topics: set[str] = set()
        self._sync_period_s = sync_period_s
        self._synced_at_s = time.monotonic()
        self._segment: _Segment | None = None
        self._newest: Path | None = None
        self._stopped = self._closed = False
        with self._stopping_on_error():
            self._begin_segment()

    @property
    def recording(self) -> bool:
        """Whether messages are written. Thread-safe."""
        return self._segment is not None

    @property
    def dropped(self) -> int:
        """Number of messages lost to a full queue or an error."""
        return self._dropped

    def record(self, topic: str, unix_time_s: float, message: Mapping[str, object]) -> None:
        """Queue a message. It and its arrays must not change afterwards."""
        if self._closed:
            return
        with self._lock:
            self._dropped += len(self._queue) == self._queue.maxlen
            self._queue.append((topic, unix_time_s, message))

    def flush(self) -> None:
        """Write the queue, and wait for the disk when a sync is due.

        Call it a few times a second.
        """
        self._write_queue()
        if time.monotonic() - self._synced_at_s >= self._sync_period_s:
            with self._stopping_on_error():
                if self._segment is None:
                    self._begin_segment()
                else:
                    self._sync(self._segment)
            self._synced_at_s = time.monotonic()
            self._report_dropped()

    def close(self) -> None:
        """Write the queue, and the index with which readers open the file quickly."""
        self._write_queue()
        with self._stopping_on_error():
            if self._segment is not None:
                self._segment.close()
        self._report_dropped()
        self._segment, self._closed = None, True

    def _write_queue(self) -> None:
        if self._segment is None:
            return  # the queue keeps the newest messages until writing resumes
        with self._lock:
            queue, self._queue = self._queue, deque(maxlen=self._queue.maxlen)
        with self._stopping_on_error():
            while queue:
                self._write(*queue.popleft())
        with self._lock:
            self._dropped += len(queue)

    def _write(self, topic: str, unix_time_s: float, message: Mapping[str, object]) -> None:
        assert self._segment is not None
        try:
            encoded = _encode(topic, self._topics[topic], unix_time_s, message)
        except Exception as error:  # any error: the other messages must be kept
            self._refuse(topic, repr(error))
            return
        if len(encoded.data) > min(self._segment.max_bytes // 2, MOST_MESSAGE_BYTES):
            self._refuse(topic, f"has {len(encoded.data)} bytes, which are too many")
            return
        if not self._segment.has_room_for(encoded):
            self._segment.close()
            self._begin_segment()
        self._segment.write(encoded)
        if self._segment.pending_bytes > MOST_CHUNK_BYTES // 2:
            self._sync(self._segment)

    def _sync(self, segment: "_Segment") -> None:
        if self._spare_bytes() < segment.pending_bytes:
            self._delete_oldest(segment.pending_bytes)
        if self._spare_bytes() < segment.pending_bytes:
            # The end of the segment fits into the reserved space.
            segment.close()
            self._begin_segment()
        else:
            segment.sync()

    def _refuse(self, topic: str, why: str) -> None:
        with self._lock:
            self._dropped += 1
        if topic not in self._refused_topics:
            self._refused_topics.add(topic)
            log.error("flight log cannot hold a message", topic=topic, why=why)

    def _report_dropped(self) -> None:
        if self._dropped > self._dropped_reported and self.recording:
            log.warning("flight log dropped messages", dropped=self._dropped)
            self._dropped_reported = self._dropped

    def _begin_segment(self) -> None:
        self._segment = None
        self._directory.mkdir(parents=True, exist_ok=True)
        number = max(_segments(self._directory, self._metadata.log_name), default=0) + 1
        path = self._directory / f"{self._metadata.log_name}-{number:04}.mcap"
        self._delete_oldest(_SMALLEST_SEGMENT_BYTES, new_bytes=self._max_segment_bytes)
        spare_bytes = self._spare_bytes()
        if spare_bytes < _SMALLEST_SEGMENT_BYTES:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        # On a small disk, several small segments: deleting the oldest must not delete nearly all.
        max_bytes = min(self._max_segment_bytes, max(_SMALLEST_SEGMENT_BYTES, spare_bytes // 4))
        segment = _Segment(path, max_bytes, self._topics)
        try:
            segment.begin(self._metadata)
        except BaseException:
            segment.abandon()
            path.unlink(missing_ok=True)
            raise
        self._segment, self._newest = segment, path
        if self._stopped:
            self._stopped = False
            log.warning("flight log goes on", path=str(path))

    def _delete_oldest(self, wanted_bytes: int, new_bytes: int = 0) -> None:
        """Delete segments until `wanted_bytes` are spare and `new_bytes` fit into the total.

        The newest segment of this flight is kept, however full the disk is.
        """
        segments = _segments(self._directory, self._metadata.log_name)
        sizes = {path: path.stat().st_size for _, path in sorted(segments.items())}
        older = {path: size for path, size in sizes.items() if path != self._newest}
        # If other files fill the disk, deletions would not help.
        helps = self._spare_bytes() + sum(older.values()) >= wanted_bytes
        for path, size in older.items():
            is_within = sum(sizes.values()) + new_bytes <= self._max_total_bytes
            if is_within and not (helps and self._spare_bytes() < wanted_bytes):
                break
            path.unlink(missing_ok=True)
            del sizes[path]
            log.info("flight log deleted its oldest segment", path=str(path), bytes=size)

    def _spare_bytes(self) -> int:
        """Number of bytes that may be written."""
        disk = shutil.disk_usage(self._directory)
        return disk.free - min(_LEAST_FREE_BYTES, disk.total // 10)

    @contextlib.contextmanager
    def _stopping_on_error(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # of the system or zstandard: none may end a flight
            segment, self._segment = self._segment, None
            if segment is not None:
                segment.abandon()
                with self._lock:
                    self._dropped += segment.pending_messages
            if not self._stopped:
                self._stopped = True
                path = self._directory if segment is None else segment.path
                log.error("flight log stopped", path=str(path), why=repr(error))


def new_file(path: Path) -> BinaryIO:
    """Create a file that other users may not read, since it has places."""
    return open(path, "xb", opener=partial(os.open, mode=0o640))


def checksum(texts: Mapping[str, str]) -> str:
    """CRC-32 of all texts except "crc"."""
    others = sorted(item for item in texts.items() if item[0] != "crc")
    return f"{zlib.crc32(json.dumps(others).encode()):08x}"


class _Encoded(NamedTuple):
    topic: str
    time_ns: int
    data: bytes


class _Segment:
    """One file. Raises the file system's errors."""

    def __init__(self, path: Path, max_bytes: int, topics: Mapping[str, LoggedTopic]) -> None:
        self.path = path
        self.max_bytes = max_bytes
        self.pending_messages = 0
        self._file = new_file(path)
        self._topics = topics
        self._texts: dict[str, str] | None = None  # metadata to be repeated
        # With this chunk size, only `sync` closes chunks.
        self._writer = Writer(self._file, max_bytes, CompressionType.ZSTD)
        self._channels: dict[str, int] = {}
        # Size of the open chunk. The first one and the summary, which `close` writes, have the
        # schemas.
        self.pending_bytes = sum(len(topic.schema) + 128 for topic in topics.values())
        self._summary_bytes = self.pending_bytes + _CHUNK_OVERHEAD_BYTES

    def begin(self, metadata: LogMetadata) -> None:
        """Write metadata, schemas and channels."""
        self._writer.start()
        texts = {key: str(value) for key, value in dataclasses.asdict(metadata).items()}
        texts["topics"] = " ".join(self._topics)
        self._texts = {"crc": checksum(texts), **texts}
        self._writer.add_metadata(_METADATA, self._texts)
        self._summary_bytes += sum(len(text.encode()) + 64 for text in self._texts.values())
        for name, topic in self._topics.items():
            schema = self._writer.register_schema(topic.schema_name, "jsonschema", topic.schema)
            self._channels[name] = self._writer.register_channel(name, "json", schema)
        self.sync()

    def has_room_for(self, encoded: _Encoded) -> bool:
        """Whether the file, closed after this message, would be within its limit."""
        size = self._file.tell() + self.pending_bytes + self._summary_bytes
        size += len(encoded.data) + _MESSAGE_OVERHEAD_BYTES + _CHUNK_OVERHEAD_BYTES
        return size <= self.max_bytes

    def write(self, encoded: _Encoded) -> None:
        channel = self._channels[encoded.topic]
        self._writer.add_message(channel, encoded.time_ns, encoded.data, encoded.time_ns)
        self.pending_messages += 1
        self.pending_bytes += len(encoded.data) + _MESSAGE_OVERHEAD_BYTES

    def sync(self) -> None:
        """Close the chunk, and wait until the disk has it."""
        self._writer.flush()  # type: ignore[no-untyped-call]
        if self.pending_messages and self._texts is not None:
            # Repeated, so that a file with a damaged beginning can still be identified.
            self._writer.add_metadata(_METADATA, self._texts)
            self._writer.flush()  # type: ignore[no-untyped-call]
            self._texts = None
        os.fsync(self._file.fileno())
        if self.pending_messages:
            self.pending_messages = self.pending_bytes = 0
            self._summary_bytes += _CHUNK_OVERHEAD_BYTES

    def close(self) -> None:
        self.sync()
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()

    def abandon(self) -> None:
        """Close the file without its end."""
        with contextlib.suppress(OSError):
            self._file.close()


def _segments(directory: Path, name: str) -> dict[int, Path]:
    """Segments of that name by number."""
    matches = (
        (re.fullmatch(rf"{re.escape(name)}-(\d+)\.mcap", path.name), path)
        for path in directory.iterdir()
    )
    return {int(match[1]): path for match, path in matches if match}


def _encode(
    name: str, topic: LoggedTopic, unix_time_s: float, message: Mapping[str, object]
) -> _Encoded:
    """Raises TypeError or ValueError for a message that JSON cannot represent."""
    whole_s = math.floor(unix_time_s)
    # A float of nanoseconds would lose its last digits.
    time_ns = whole_s * 10**9 + round((unix_time_s - whole_s) * 1e9)
    if not 0 <= time_ns < 2**63:
        raise ValueError(f"unix_time_s = {unix_time_s}")
    converted = topic.convert(time_ns, message)
    return _Encoded(name, time_ns, _to_json(_plain(converted)).encode())


_JSON_TYPES = frozenset({type(None), bool, int, str})
_to_json = json.JSONEncoder(separators=(",", ":")).encode


def _plain(value: object) -> object:
    """Convert to JSON's own types."""
    # A fast path for nearly all values.
    kind = type(value)
    if kind in _JSON_TYPES or (kind is float and math.isfinite(value)):  # type: ignore[arg-type]
        return value
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else json.dumps(value)
    if isinstance(value, np.ndarray):
        if value.dtype.kind not in ARRAY_KINDS:
            raise TypeError(f"an array of {value.dtype}")
        return {
            "dtype": value.dtype.str,
            "shape": list(value.shape),
            "data": _base64(value.tobytes()),
        }
    if isinstance(value, bytes):
        return {"base64": _base64(value)}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {
            field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)
        }
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        return _plain(value._asdict())
    if isinstance(value, tuple | list):
        return [_plain(entry) for entry in value]
    raise TypeError(f"a {type(value).__name__}")


def _base64(data: bytes) -> str:
    return binascii.b2a_base64(data, newline=False).decode("ascii")


# Foxglove needs one type for each value, though unknown values are null.
_Schema = dict[str, Any]
_BASE64: _Schema = {"type": "string", "contentEncoding": "base64"}
_BY_TYPE: dict[Any, _Schema] = {
    float: {"type": "number"},
    int: {"type": "integer"},
    str: {"type": "string"},
    bool: {"type": "boolean"},
    object: {"type": "object", "properties": {}},
}


def _schema(hint: Any) -> _Schema:
    """Schema of values of that type after `_plain`, or the given schema."""
    if isinstance(hint, dict):
        return hint
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        (known,) = (argument for argument in arguments if argument is not types.NoneType)
        return _schema(known)
    if origin is tuple:
        return {"type": "array", "items": _schema(arguments[0])}
    if origin is dict:
        return {**_object(), "additionalProperties": _schema(arguments[1])}
    if origin is Literal or issubclass(hint, StrEnum):
        return _schema(str)
    return _BY_TYPE.get(hint) or _object(**typing.get_type_hints(hint))


def _object(**hints: Any) -> _Schema:
    """Schema of an object, without lists of lists: Foxglove refuses these, but shows the values."""
    schemas = {name: _schema(hint) for name, hint in hints.items()}
    properties = {
        name: schema
        for name, schema in schemas.items()
        if schema["type"] != "array" or schema["items"]["type"] != "array"
    }
    return {"type": "object", "properties": properties}


_BY_TYPE[np.ndarray] = _object(dtype=str, shape=tuple[int, ...], data=_BASE64)
_BY_TYPE[bytes] = _object(base64=_BASE64)
_TIME = {**_object(sec=int, nsec=int), "title": "time"}
_POSE = _object(
    position=_object(**dict.fromkeys("xyz", float)),
    orientation=_object(**dict.fromkeys("xyzw", float)),
)


def _unchanged(_: int, message: Mapping[str, object]) -> Mapping[str, object]:
    return message


def _foxglove_pose(time_ns: int, message: Mapping[str, Any]) -> Mapping[str, object]:
    x, y, z = message["position_m"]
    half_yaw = (message["yaw_rad"] or 0.0) / 2.0
    orientation = {"x": 0.0, "y": 0.0, "z": math.sin(half_yaw), "w": math.cos(half_yaw)}
    return {
        "timestamp": _foxglove_time(time_ns),
        "frame_id": "mission",
        "pose": {"position": {"x": x, "y": y, "z": z}, "orientation": orientation},
    }


# Foxglove's 0 is an unknown level.
_FOXGLOVE_LEVELS = {"debug": 1, "info": 2, "warning": 3, "error": 4, "critical": 5}


def _foxglove_log(time_ns: int, message: Mapping[str, Any]) -> Mapping[str, object]:
    return {
        "timestamp": _foxglove_time(time_ns),
        "level": _FOXGLOVE_LEVELS.get(message["level"], 0),
        "message": message["message"],
        "name": message["name"],
        "file": "",
        "line": 0,
    }


def _foxglove_time(time_ns: int) -> dict[str, int]:
    return dict(zip(("sec", "nsec"), divmod(time_ns, 10**9), strict=True))


def _topic(schema_name: str, convert: _Convert, /, **hints: Any) -> LoggedTopic:
    return LoggedTopic(schema_name, json.dumps(_object(**hints)).encode(), convert)


_Numbers = tuple[float, ...]
ROBOT_TOPICS = {
    "perception": topic(
        "Perception", images=np.ndarray, position_feature=np.ndarray, features=np.ndarray
    ),
    "policy": topic(
        "Policy", features=np.ndarray, senders=tuple[int, ...], payloads=tuple[np.ndarray, ...],
        positions=np.ndarray, velocities=np.ndarray, ages_s=np.ndarray, degree=int, inputs=object,
        velocity=np.ndarray, message=bytes,
    ),
    "received": topic("Received", sender=int, sequence=int, age_s=float, rejection=str),
    "control": topic(
        "Control", state=str, reason=str, reason_code=str, height_m=float, position_m=_Numbers,
        velocity_m_s=_Numbers, policy_velocity_m_s=_Numbers, setpoint_kind=str, setpoint=_Numbers,
        sent_local=_Numbers, actions=tuple[str, ...], closest_m=float,
    ),
    "flight": topic("Flight", number=int, whole=bool, given=object, made=object),
    "status": topic("Status", RobotStatus),
    "order": topic("Order", Order, answer=OrderResult),
    "ground": topic("Ground", GroundState),
    "vehicle": topic("Vehicle", VehicleState),
    "/pose": _topic(
        "foxglove.PoseInFrame", _foxglove_pose, timestamp=_TIME, frame_id=str, pose=_POSE
    ),
    "/log": _topic(
        "foxglove.Log", _foxglove_log,
        timestamp=_TIME, level=int, message=str, name=str, file=str, line=int,
    ),
}  # fmt: skip
