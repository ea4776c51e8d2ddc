"""The flight log: MCAP files that Foxglove opens and `lpac replay` runs again.

A segment is a file `<name>-<number>.mcap`: a metadata record `lpac` that says who flew what, then
zstd chunks of JSON messages. The numbers go on from one start to the next, so that they tell the
order where the clock does not. A robot's are called `robot-<id>`, and have these topics (the ground
has its own, see `lpac.ground.record`):

| topic | holds |
| --- | --- |
| `perception` | a tick of the perception loop: features, and what they were made of |
| `policy` | a tick of the policy loop: features, neighbours' payloads, velocity, message sent |
| `received` | a neighbour's message, and why it was refused if it was |
| `control` | a tick of the control loop: state, position, setpoint, and what was sent of it |
| `flight` | the same tick, for `lpac replay`: all that it was given, and made, or the changes |
| `status`, `ground`, `vehicle` | `RobotStatus`, `GroundState`, `VehicleState` |
| `order` | `Order`, and the answer to it |
| `/pose` | `position_m` (3,) and `yaw_rad` (from x to y, or None) in the mission frame |
| `/log` | `level` (debug, info, warning, error, critical), `message`, `name` |

The last two become Foxglove's own messages. In JSON, an array is an object of its numpy dtype, its
shape and its bytes in base64, bytes are an object `{"base64": ...}`, dataclasses and named tuples
are objects, and numbers that are not finite are the strings "NaN", "Infinity" and "-Infinity".
"""

import binascii
import contextlib
import dataclasses
import json
import math
import os
import re
import time
import types
import typing
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path
from threading import Lock
from typing import Any, ClassVar, Literal, NamedTuple, Protocol

import numpy as np
import zstandard
from mcap.exceptions import InvalidMagic
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer

from edge.core.logger import log
from edge.core.vehicle import VehicleState
from edge.messages.mission import GroundState, Order, OrderResult, RobotStatus

_METADATA = "lpac"
# What MCAP adds to the bytes of a message, and to a chunk, indexes and summary included.
_MESSAGE_OVERHEAD_BYTES = 64
_CHUNK_OVERHEAD_BYTES = 512
_SMALLEST_SEGMENT_BYTES = 2**18
# Whoever reads a log may not know who made it: nothing unpacks to more.
_MOST_MESSAGE_BYTES = 2**22
_MOST_CHUNK_BYTES = 2**24
_MOST_UNPACKED_SHARE = 200.0
_ARRAY_KINDS = "biuf"


class FlightLogError(ValueError):
    """The file is no flight log; the text says why."""


class LogMetadata(Protocol):
    """Who writes: a dataclass, whose fields stand as text at the start of every segment."""

    __dataclass_fields__: ClassVar[dict[str, dataclasses.Field[Any]]]

    @property
    def log_name(self) -> str:
        """What the segments are called before their numbers."""
        ...


@dataclass(frozen=True, slots=True)
class FlightMetadata:
    """Who flew what.

    `bundle_id` is in hexadecimal, `bundle_path` is where the robot found it, and `configuration` is
    the robot's configuration as JSON text.
    """

    robot_id: int
    boot_nonce: int
    bundle_id: str
    bundle_path: str
    configuration: str
    version: str

    @property
    def log_name(self) -> str:
        """What a robot's segments are called."""
        return f"robot-{self.robot_id}"


class LoggedTopic(NamedTuple):
    """How the messages of a topic are described (`schema`, a JSON schema), and converted to it.

    `convert` gets the time, ns, and the message.
    """

    schema_name: str
    schema: bytes
    convert: Callable[[int, Mapping[str, Any]], Mapping[str, object]]


def topic(name: str, kind: type, /, **more: Any) -> LoggedTopic:
    """A topic whose messages have the fields of the dataclass `kind`, and `more` (name -> type)."""
    hints = {**typing.get_type_hints(kind), **more}
    return _topic(name, _fields_schema(hints))


class FlightLog:
    """Writes what a robot, or the ground, records; implements `Recorder`.

    `record` may be called from any thread, everything else from one thread at a time. After an
    error of the file system it records nothing more and says so once; nothing raises in flight.
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
        """Start a segment in `directory`, which is made if need be. No `topics` are a robot's.

        A killed process and a power loss cost what was recorded in the last `sync_period_s`: a
        battery swap is a power loss, and the kernel alone would write up to half a minute late.
        Shorter periods compress worse.

        No segment grows beyond `max_segment_bytes`, and the oldest ones of this name are deleted
        so that all of them, of earlier starts too, stay within `max_total_bytes`.

        Raises ValueError if a limit is impossible. If nothing can be written there, `recording` is
        False from the beginning.
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
        if max_queued_messages < 1:
            raise ValueError(f"max_queued_messages = {max_queued_messages}: must be at least 1")
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
        with self._stopping_on_error():
            directory.mkdir(parents=True, exist_ok=True)
            self._begin_segment()

    @property
    def recording(self) -> bool:
        """Whether messages are kept. Any thread may ask."""
        return self._segment is not None

    @property
    def dropped(self) -> int:
        """How many messages were recorded faster than they were written, or could not be."""
        return self._dropped

    def record(self, topic: str, unix_time_s: float, message: Mapping[str, object]) -> None:
        """Keep one message; nobody may change it, or the arrays in it, afterwards."""
        if self._segment is None:
            return
        with self._lock:
            self._dropped += len(self._queue) == self._queue.maxlen
            self._queue.append((topic, unix_time_s, message))

    def flush(self) -> None:
        """Write what was recorded, and wait for the disk when a sync is due.

        To be called a few times a second.
        """
        self._write_queue()
        if time.monotonic() - self._synced_at_s >= self._sync_period_s:
            with self._stopping_on_error():
                if self._segment is not None:
                    self._segment.sync()
            self._synced_at_s = time.monotonic()
            self._report_dropped()

    def close(self) -> None:
        """Write what was recorded, and the index that makes the file quick to open."""
        self._write_queue()
        with self._stopping_on_error():
            if self._segment is not None:
                self._segment.close()
        self._segment = None
        self._report_dropped()

    def _write_queue(self) -> None:
        with self._lock:
            queue, self._queue = self._queue, deque(maxlen=self._queue.maxlen)
        with self._stopping_on_error():
            for topic, unix_time_s, message in queue:
                self._write(topic, unix_time_s, message)

    def _write(self, topic: str, unix_time_s: float, message: Mapping[str, object]) -> None:
        if self._segment is None:
            return
        try:
            encoded = _encode(topic, self._topics[topic], unix_time_s, message)
        except Exception as error:  # whatever it is, the others are worth keeping
            self._refuse(topic, repr(error))
            return
        if len(encoded.data) > min(self._max_segment_bytes // 2, _MOST_MESSAGE_BYTES):
            self._refuse(topic, f"its {len(encoded.data)} bytes are too many")
            return
        if not self._segment.has_room_for(encoded):
            self._segment.close()
            self._begin_segment()
        self._segment.write(encoded)
        if self._segment.pending_bytes > _MOST_CHUNK_BYTES // 2:
            self._segment.sync()

    def _refuse(self, topic: str, why: str) -> None:
        with self._lock:
            self._dropped += 1
        if topic not in self._refused_topics:
            self._refused_topics.add(topic)
            log.error("flight log cannot hold a message", topic=topic, why=why)

    def _report_dropped(self) -> None:
        if self._dropped > self._dropped_reported:
            log.warning("flight log dropped messages", dropped=self._dropped)
            self._dropped_reported = self._dropped

    def _begin_segment(self) -> None:
        name = self._metadata.log_name
        segments = _segments(self._directory, name)
        number = max(segments, default=0) + 1
        sizes = {path: path.stat().st_size for _, path in sorted(segments.items())}
        for path, size in list(sizes.items()):
            if sum(sizes.values()) + self._max_segment_bytes <= self._max_total_bytes:
                break
            path.unlink(missing_ok=True)
            del sizes[path]
            log.info("flight log deleted its oldest segment", path=str(path), bytes=size)
        path = self._directory / f"{name}-{number:04}.mcap"
        self._segment = _Segment(path, self._max_segment_bytes, self._topics)
        self._segment.begin(self._metadata)

    @contextlib.contextmanager
    def _stopping_on_error(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # the operating system's, and zstandard's: none may end a flight
            segment, self._segment = self._segment, None
            if segment is not None:
                segment.abandon()
            self._queue.clear()
            log.error("flight log stopped", directory=str(self._directory), why=repr(error))


def read_metadata(path: Path) -> FlightMetadata:
    """Who flew what in that segment.

    Raises FlightLogError if it is no MCAP file or was not written by a robot, OSError if it cannot
    be read.
    """
    for record in _records(path):
        if isinstance(record, Metadata) and record.name == _METADATA:
            texts: dict[str, Any] = record.metadata
            try:
                numbers = {key: int(texts[key]) for key in ("robot_id", "boot_nonce")}
                return FlightMetadata(**{**texts, **numbers})
            except (KeyError, TypeError, ValueError):
                break
    raise FlightLogError(f"{path}: was not written by a robot, or broke off before it began")


def read(path: Path, *only: str) -> Iterator[tuple[str, float, dict[str, Any]]]:
    """(topic, Unix time in s, message) of one segment in the order of writing.

    With topics in `only` all others are passed over, three times as fast. A segment that breaks
    off, since the robot was killed or lost its power, is read up to there.
    Arrays are numpy's again, bit by bit, and bytes are bytes.

    Raises FlightLogError if it is no flight log, OSError if it cannot be read.
    """
    topics: dict[int, str] = {}
    for record in _records(path):
        if isinstance(record, Channel):
            topics[record.id] = record.topic
        elif isinstance(record, Message):
            topic = topics.get(record.channel_id)
            if topic is None:
                raise FlightLogError(f"{path}: holds a message of no topic")
            if not only or topic in only:
                try:
                    message = _message(record.data)
                except (TypeError, ValueError, RecursionError) as error:
                    raise FlightLogError(f"{path}: {topic}: is not a log's: {error}") from None
                yield topic, record.log_time / 10**9, message


def _message(data: bytes) -> dict[str, Any]:
    if len(data) > _MOST_MESSAGE_BYTES:
        raise ValueError(f"has {len(data)} bytes")
    message = json.loads(data, object_hook=_revive)
    if not isinstance(message, dict):
        raise TypeError(f"a {type(message).__name__}")
    return message


def _records(path: Path) -> Iterator[McapRecord]:
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        # The zeros that a power loss can leave do not pass for data: their checksum is wrong.
        limit = min(size, _MOST_CHUNK_BYTES)
        reader = StreamReader(
            file, emit_chunks=True, validate_crcs=True, record_size_limit=limit
        ).records
        while True:
            try:
                record = next(reader)
                records = _unpacked(record) if isinstance(record, Chunk) else [record]
            except StopIteration:
                return
            except FlightLogError as error:
                raise FlightLogError(f"{path}: {error}") from None
            except InvalidMagic:
                if file.tell() > 8:
                    return
                raise FlightLogError(f"{path}: is not an MCAP file") from None
            except Exception:  # mcap's own, struct's, zstandard's: all mean that it breaks off here
                return
            yield from records


def _unpacked(chunk: Chunk) -> list[McapRecord]:
    """Raises FlightLogError for what no flight log has, before it takes any memory."""
    packed, stated = chunk.data, chunk.uncompressed_size
    if chunk.compression != "zstd":
        raise FlightLogError(f"is compressed by {chunk.compression!r}, not by 'zstd'")
    size = max(stated, zstandard.frame_content_size(packed))
    if size > min(_MOST_CHUNK_BYTES, 2**16 + _MOST_UNPACKED_SHARE * len(packed)):
        raise FlightLogError(f"{len(packed)} bytes of it would be {size}: is no flight log")
    return breakup_chunk(chunk, validate_crc=True)


class _Encoded(NamedTuple):
    topic: str
    time_ns: int
    data: bytes


class _Segment:
    """One file. Raises what the file system raises."""

    def __init__(self, path: Path, max_bytes: int, topics: Mapping[str, LoggedTopic]) -> None:
        # Where a fleet flew is not for everybody who has a login.
        self._file = open(path, "xb", opener=partial(os.open, mode=0o640))  # noqa: SIM115
        self._max_bytes = max_bytes
        self._topics = topics
        # The chunks are closed by `sync` alone.
        self._writer = Writer(self._file, max_bytes, CompressionType.ZSTD)
        self._channels: dict[str, int] = {}
        # Of the chunk that is not closed, the first of which has the schemas; and of what `close`
        # writes, which repeats them.
        self._pending_bytes = sum(len(topic.schema) + 128 for topic in topics.values())
        self._summary_bytes = self._pending_bytes + _CHUNK_OVERHEAD_BYTES
        self._pending_messages = 0

    def begin(self, metadata: LogMetadata) -> None:
        """Write what comes before the first message."""
        self._writer.start()
        texts = {key: str(value) for key, value in dataclasses.asdict(metadata).items()}
        self._writer.add_metadata(_METADATA, texts)
        for name, topic in self._topics.items():
            schema = self._writer.register_schema(topic.schema_name, "jsonschema", topic.schema)
            self._channels[name] = self._writer.register_channel(name, "json", schema)
        self.sync()

    def has_room_for(self, encoded: _Encoded) -> bool:
        """Whether the file, closed after this message, is within its limit."""
        size = self._file.tell() + self._pending_bytes + self._summary_bytes
        size += len(encoded.data) + _MESSAGE_OVERHEAD_BYTES + _CHUNK_OVERHEAD_BYTES
        return size <= self._max_bytes

    @property
    def pending_bytes(self) -> int:
        """Of the chunk that is not closed."""
        return self._pending_bytes

    def write(self, encoded: _Encoded) -> None:
        channel = self._channels[encoded.topic]
        self._writer.add_message(channel, encoded.time_ns, encoded.data, encoded.time_ns)
        self._pending_messages += 1
        self._pending_bytes += len(encoded.data) + _MESSAGE_OVERHEAD_BYTES

    def sync(self) -> None:
        """Close the chunk, and wait until the disk has it."""
        self._writer.flush()  # type: ignore[no-untyped-call]
        os.fsync(self._file.fileno())
        if self._pending_messages:
            self._pending_messages = self._pending_bytes = 0
            self._summary_bytes += _CHUNK_OVERHEAD_BYTES

    def close(self) -> None:
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()

    def abandon(self) -> None:
        """Close the file as it is."""
        with contextlib.suppress(OSError):
            self._file.close()


def _segments(directory: Path, name: str) -> dict[int, Path]:
    """The segments of that name by their numbers."""
    matches = (
        (re.fullmatch(rf"{re.escape(name)}-(\d+)\.mcap", path.name), path)
        for path in directory.iterdir()
    )
    return {int(match[1]): path for match, path in matches if match}


def _encode(
    name: str, topic: LoggedTopic, unix_time_s: float, message: Mapping[str, object]
) -> _Encoded:
    """Raises TypeError and ValueError for what JSON cannot hold."""
    whole_s = math.floor(unix_time_s)
    # Times 10**9 as a whole, a float would lose its last digits.
    time_ns = whole_s * 10**9 + round((unix_time_s - whole_s) * 1e9)
    if not 0 <= time_ns < 2**63:
        raise ValueError(f"unix_time_s = {unix_time_s}")
    converted = topic.convert(time_ns, message)
    return _Encoded(name, time_ns, _to_json(_plain(converted)).encode())


_OF_JSON = frozenset({type(None), bool, int, str})
_to_json = json.JSONEncoder(separators=(",", ":")).encode


def _plain(value: object) -> object:
    """`value` as JSON's own types."""
    # Nearly all that is logged; of anything else it takes much longer to tell what it is.
    kind = type(value)
    if kind in _OF_JSON or (kind is float and math.isfinite(value)):  # type: ignore[arg-type]
        return value
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else json.dumps(value)
    if isinstance(value, np.ndarray):
        if value.dtype.kind not in _ARRAY_KINDS:
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


def _revive(value: dict[str, Any]) -> object:
    """The array or the bytes that an object of JSON stands for, if it does."""
    if value.keys() == {"dtype", "shape", "data"}:
        data, dtype = binascii.a2b_base64(value["data"]), np.dtype(value["dtype"])
        if dtype.kind not in _ARRAY_KINDS:
            raise ValueError(f"an array of {dtype}")
        return np.ndarray(value["shape"], dtype, data)
    if value.keys() == {"base64"}:
        return binascii.a2b_base64(value["base64"])
    return value


# Foxglove reads schemas that give each value one type; what is not known is null all the same.
_Schema = dict[str, Any]
_NUMBER: _Schema = {"type": "number"}
_INTEGER: _Schema = {"type": "integer"}
_STRING: _Schema = {"type": "string"}
_BOOLEAN: _Schema = {"type": "boolean"}
_BASE64: _Schema = {"type": "string", "contentEncoding": "base64"}


def _list(items: _Schema) -> _Schema:
    return {"type": "array", "items": items}


def _object(**properties: _Schema) -> _Schema:
    return {"type": "object", "properties": properties}


_ARRAY = _object(dtype=_STRING, shape=_list(_INTEGER), data=_BASE64)
_BYTES = _object(base64=_BASE64)
_TIME: _Schema = {**_object(sec=_INTEGER, nsec=_INTEGER), "title": "time"}
_VECTOR = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)


def _schema(hint: Any) -> _Schema:
    """The schema of what `_plain` makes of a value of that type."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        (known,) = (argument for argument in arguments if argument is not types.NoneType)
        return _schema(known)
    if origin is tuple:
        return _list(_schema(arguments[0]))
    if origin is dict:
        return {**_object(), "additionalProperties": _schema(arguments[1])}
    if origin is Literal or issubclass(hint, StrEnum):
        return _STRING
    by_type = {float: _NUMBER, int: _INTEGER, str: _STRING, bool: _BOOLEAN}
    if hint in by_type:
        return by_type[hint]
    return _fields_schema(typing.get_type_hints(hint))


def _fields_schema(hints: Mapping[str, Any]) -> _Schema:
    """Without lists of lists, which make Foxglove refuse a topic; it shows them all the same."""
    schemas = {name: _schema(hint) for name, hint in hints.items()}
    return _object(
        **{
            name: schema
            for name, schema in schemas.items()
            if schema["type"] != "array" or schema["items"]["type"] != "array"
        }
    )


def _as_it_is(_: int, message: Mapping[str, object]) -> Mapping[str, object]:
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


# 0 is a level that is not known.
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


def _topic(name: str, schema: _Schema) -> LoggedTopic:
    return LoggedTopic(f"lpac.{name}", json.dumps(schema).encode(), _as_it_is)


ROBOT_TOPICS = {
    "perception": _topic(
        "Perception", _object(images=_ARRAY, position_feature=_ARRAY, features=_ARRAY)
    ),
    "policy": _topic(
        "Policy",
        _object(
            features=_ARRAY,
            senders=_list(_INTEGER),
            payloads=_list(_ARRAY),
            degree=_INTEGER,
            velocity=_ARRAY,
            message=_BYTES,
        ),
    ),
    "received": _topic(
        "Received",
        _object(sender=_INTEGER, sequence=_INTEGER, age_s=_NUMBER, rejection=_STRING),
    ),
    "control": _topic(
        "Control",
        _object(
            state=_STRING,
            reason=_STRING,
            reason_code=_STRING,
            height_m=_NUMBER,
            position_m=_list(_NUMBER),
            velocity_m_s=_list(_NUMBER),
            policy_velocity_m_s=_list(_NUMBER),
            setpoint_kind=_STRING,
            setpoint=_list(_NUMBER),
            sent_local=_list(_NUMBER),
            actions=_list(_STRING),
            closest_m=_NUMBER,
        ),
    ),
    "flight": _topic(
        "Flight", _object(number=_INTEGER, whole=_BOOLEAN, given=_object(), made=_object())
    ),
    "status": topic("Status", RobotStatus),
    "order": topic("Order", Order, answer=OrderResult),
    "ground": topic("Ground", GroundState),
    "vehicle": topic("Vehicle", VehicleState),
    "/pose": LoggedTopic(
        "foxglove.PoseInFrame",
        json.dumps(
            _object(
                timestamp=_TIME,
                frame_id=_STRING,
                pose=_object(position=_VECTOR, orientation=_QUATERNION),
            )
        ).encode(),
        _foxglove_pose,
    ),
    "/log": LoggedTopic(
        "foxglove.Log",
        json.dumps(
            _object(
                timestamp=_TIME,
                level=_INTEGER,
                message=_STRING,
                name=_STRING,
                file=_STRING,
                line=_INTEGER,
            )
        ).encode(),
        _foxglove_log,
    ),
}
