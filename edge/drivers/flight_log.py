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
import errno
import json
import math
import mmap
import os
import re
import shutil
import struct
import time
import types
import typing
import zlib
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from functools import partial
from io import BytesIO
from pathlib import Path
from threading import Lock
from typing import Any, BinaryIO, ClassVar, Literal, NamedTuple, Protocol

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import breakup_chunk
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from edge.core.logger import log
from edge.core.schema import AtLeastOne, require
from edge.core.vehicle import VehicleState
from edge.messages.mission import GroundState, Order, OrderResult, RobotStatus

_METADATA = "lpac"
# What MCAP adds to the bytes of a message, and to a chunk, indexes and summary included.
_MESSAGE_OVERHEAD_BYTES = 64
_CHUNK_OVERHEAD_BYTES = 512
_SMALLEST_SEGMENT_BYTES = 2**18
# For what else has to be written; of a small disk a tenth.
_LEAST_FREE_BYTES = 20_000_000
# Whoever reads a log may not know who made it: nothing unpacks to more.
_MOST_MESSAGE_BYTES = 2**22
_MOST_CHUNK_BYTES = 2**24
_MOST_UNPACKED_SHARE = 200.0
_ARRAY_KINDS = "biuf"
# How a chunk, and the metadata of `_METADATA`, begin: what reading goes on with behind damage.
_ANCHOR = re.compile(rb"\x06.{36}\x04\0\0\0zstd|\x0c.{8}\x04\0\0\0lpac", re.DOTALL)
_RECORD = struct.Struct("<BQ")


class FlightLogError(ValueError):
    """The file is no flight log; the text says why."""


class LogMetadata(Protocol):
    """Metadata of a log's writer: a dataclass, as text at the start of every segment."""

    __dataclass_fields__: ClassVar[dict[str, dataclasses.Field[Any]]]

    @property
    def log_name(self) -> str:
        """Name of the segments, before their numbers."""
        ...


@dataclass(frozen=True, slots=True)
class FlightMetadata:
    """Robot, program, policy and configuration of a log.

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
        """Name of a robot's segments."""
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

    `record` may be called from any thread, everything else from one thread at a time. Nothing
    raises in flight: after an error of the file system, or while the disk is full, it writes
    nothing and says so once, and goes on in a new segment as soon as it can.
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
        so that all of them, of earlier starts too, stay within `max_total_bytes`, and leave
        20 MB of the disk free, or a tenth of a smaller one.

        Raises ValueError if a limit is impossible. While nothing can be written there, `recording`
        is False.
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
        """Whether messages are written. Any thread may ask."""
        return self._segment is not None

    @property
    def dropped(self) -> int:
        """How many messages were recorded faster than they were written, or could not be."""
        return self._dropped

    def record(self, topic: str, unix_time_s: float, message: Mapping[str, object]) -> None:
        """Keep one message; nobody may change it, or the arrays in it, afterwards."""
        if self._closed:
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
                if self._segment is None:
                    self._begin_segment()
                else:
                    self._sync(self._segment)
            self._synced_at_s = time.monotonic()
            self._report_dropped()

    def close(self) -> None:
        """Write what was recorded, and the index that makes the file quick to open."""
        self._write_queue()
        with self._stopping_on_error():
            if self._segment is not None:
                self._segment.close()
        self._report_dropped()
        self._segment, self._closed = None, True

    def _write_queue(self) -> None:
        if self._segment is None:
            return  # What was recorded last waits until something can be written again.
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
        except Exception as error:  # whatever it is, the others are worth keeping
            self._refuse(topic, repr(error))
            return
        if len(encoded.data) > min(self._segment.max_bytes // 2, _MOST_MESSAGE_BYTES):
            self._refuse(topic, f"its {len(encoded.data)} bytes are too many")
            return
        if not self._segment.has_room_for(encoded):
            self._segment.close()
            self._begin_segment()
        self._segment.write(encoded)
        if self._segment.pending_bytes > _MOST_CHUNK_BYTES // 2:
            self._sync(self._segment)

    def _sync(self, segment: "_Segment") -> None:
        if self._spare_bytes() < segment.pending_bytes:
            self._delete_oldest(segment.pending_bytes)
        if self._spare_bytes() < segment.pending_bytes:
            # Its end fits into what is left free.
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
        # Several on a small disk, so that the oldest one is not nearly all that there is.
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
        """Delete segments until `wanted_bytes` are to spare, and the total has `new_bytes` left.

        The newest one of this flight stays, however full others make the disk.
        """
        segments = _segments(self._directory, self._metadata.log_name)
        sizes = {path: path.stat().st_size for _, path in sorted(segments.items())}
        older = {path: size for path, size in sizes.items() if path != self._newest}
        # Where others fill the disk none is deleted in vain.
        helps = self._spare_bytes() + sum(older.values()) >= wanted_bytes
        for path, size in older.items():
            is_within = sum(sizes.values()) + new_bytes <= self._max_total_bytes
            if is_within and not (helps and self._spare_bytes() < wanted_bytes):
                break
            path.unlink(missing_ok=True)
            del sizes[path]
            log.info("flight log deleted its oldest segment", path=str(path), bytes=size)

    def _spare_bytes(self) -> int:
        """How much may be written before too little of the disk is free."""
        disk = shutil.disk_usage(self._directory)
        return disk.free - min(_LEAST_FREE_BYTES, disk.total // 10)

    @contextlib.contextmanager
    def _stopping_on_error(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # the operating system's, and zstandard's: none may end a flight
            segment, self._segment = self._segment, None
            if segment is not None:
                segment.abandon()
                with self._lock:
                    self._dropped += segment.pending_messages
            if not self._stopped:
                self._stopped = True
                path = self._directory if segment is None else segment.path
                log.error("flight log stopped", path=str(path), why=repr(error))


class Missing(NamedTuple):
    """Gap in a log: all between two messages, or before the first, or after the last.

    `damaged` is False where the log just ends: its program was killed, lost its power, or writes.
    """

    path: Path
    since_unix_s: float | None
    until_unix_s: float | None
    damaged: bool

    def __str__(self) -> str:
        what = "is damaged" if self.damaged else "breaks off"
        since_s, until_s = self.since_unix_s, self.until_unix_s
        since = "its beginning" if since_s is None else _at(since_s)
        until = "on" if until_s is None else f"to {_at(until_s)}"
        return f"{self.path}: {what}: holds nothing from {since} {until}"


def _at(unix_s: float) -> str:
    return f"{datetime.fromtimestamp(unix_s).astimezone():%Y-%m-%d %H:%M:%S}"


def warn(missing: Missing) -> None:
    """Say it to people."""
    log.warning(str(missing))


def read_metadata(path: Path) -> FlightMetadata:
    """Read the metadata of that segment.

    Raises FlightLogError if it is no MCAP file or was not written by a robot, OSError if it cannot
    be read.
    """
    for records in _whole(path, lambda _: None):
        for record in records:
            if isinstance(record, Metadata):
                texts: dict[str, Any] = record.metadata
                try:
                    numbers = {key: int(texts[key]) for key in ("robot_id", "boot_nonce")}
                    names = (field.name for field in dataclasses.fields(FlightMetadata))
                    return FlightMetadata(**{**{name: texts[name] for name in names}, **numbers})
                except (KeyError, TypeError, ValueError):
                    break
    raise FlightLogError(f"{path}: was not written by a robot, or broke off before it began")


def read(
    path: Path, *only: str, missing: Callable[[Missing], None] = warn
) -> Iterator[tuple[str, float, dict[str, Any]]]:
    """(topic, Unix time in s, message) of one segment in the order of writing.

    With topics in `only` all others are passed over, three times as fast. What is damaged is passed
    over, and a segment that breaks off, since the robot was killed or lost its power, is read up to
    there; `missing` is told of either.
    Arrays are numpy's again, bit by bit, and bytes are bytes.

    Raises FlightLogError if it is no flight log, OSError if it cannot be read.
    """
    topics: dict[int, str] = {}
    for records in _whole(path, missing):
        for record in records:
            if isinstance(record, Metadata):
                topics.update(_topics_in(record))
            elif isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Message):
                topic = topics[record.channel_id]
                if not only or topic in only:
                    try:
                        message = _message(record.data)
                    except (TypeError, ValueError, RecursionError) as error:
                        raise FlightLogError(f"{path}: {topic}: is not a log's: {error}") from None
                    yield topic, record.log_time / 10**9, message


def repair(path: Path, out: Path, missing: Callable[[Missing], None] = warn) -> int:
    """Write what is whole of a segment as a new one, which is not there yet; how many messages.

    Raises FlightLogError if nothing is; OSError.
    """
    file = _new_file(out)
    try:
        with file:
            count = _copy_whole(path, file, missing)
        if not count:
            raise FlightLogError(f"{path}: holds no whole message")
    except BaseException:
        out.unlink(missing_ok=True)
        raise
    return count


def _copy_whole(path: Path, file: BinaryIO, missing: Callable[[Missing], None]) -> int:
    """How many messages of a segment are whole, and now in the file, too."""
    count = 0
    writer = Writer(file, 2**20, CompressionType.ZSTD)
    writer.start()
    schemas, channels = {0: 0}, dict[int, int]()
    for records in _whole(path, missing):
        for record in records:
            match record:
                case Metadata(name, texts):
                    writer.add_metadata(name, texts)
                    for number, topic in _topics_in(record).items():
                        channels.setdefault(number, writer.register_channel(topic, "json", 0))
                case Schema(number, data, encoding, name):
                    schemas[number] = writer.register_schema(name, encoding, data)
                case Channel():
                    schema = schemas.get(record.schema_id, 0)
                    channels[record.id] = writer.register_channel(record.topic, "json", schema)
                case Message():
                    channel = channels[record.channel_id]
                    writer.add_message(channel, record.log_time, record.data, record.publish_time)
                    count += 1
    writer.finish()  # type: ignore[no-untyped-call]
    return count


def _new_file(path: Path) -> BinaryIO:
    """A file that others may not read, since it tells places."""
    return open(path, "xb", opener=partial(os.open, mode=0o640))


def _message(data: bytes) -> dict[str, Any]:
    if len(data) > _MOST_MESSAGE_BYTES:
        raise ValueError(f"has {len(data)} bytes")
    message = json.loads(data, object_hook=_revive)
    if not isinstance(message, dict):
        raise TypeError(f"a {type(message).__name__}")
    return message


def _whole(path: Path, missing: Callable[[Missing], None]) -> Iterator[list[McapRecord]]:
    """Intact parts of a log: our metadata, and the records of each chunk, by their checksums.

    Other records tell only whether something is missing between them.
    """
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        if not size:
            missing(Missing(path, None, None, damaged=False))
            return
        with mmap.mmap(file.fileno(), size, access=mmap.ACCESS_READ) as data:
            yield from _whole_of(path, data, missing)


def _whole_of(
    path: Path, data: mmap.mmap, missing: Callable[[Missing], None]
) -> Iterator[list[McapRecord]]:
    begins = MCAP0_MAGIC.startswith(data[:8])
    whole_to, at, since_s = len(MCAP0_MAGIC), 0, None
    damaged, found = not begins, False
    channels: set[int] = set()
    while anchor := _ANCHOR.search(data, at):
        try:
            records, end = _records_at(data, anchor.start(), len(data))
            for record in records:
                if isinstance(record, Metadata):
                    channels.update(_topics_in(record))
                elif isinstance(record, Channel):
                    channels.add(record.id)
                elif isinstance(record, Message) and record.channel_id not in channels:
                    raise ValueError("holds a message of no topic")
        except Exception:  # mcap's own, struct's, zstandard's: all mean that it is damaged
            at = anchor.start() + 1
            continue
        damaged = damaged or not _indexes(data, whole_to, anchor.start())
        times_s = [record.log_time / 10**9 for record in records if isinstance(record, Message)]
        if damaged and times_s:
            missing(Missing(path, since_s, times_s[0], damaged=True))
            damaged = False
        since_s = times_s[-1] if times_s else since_s
        yield records
        whole_to = at = end
        found = True
    if not found and not begins:
        raise FlightLogError(f"{path}: is not an MCAP file")
    is_closed = data[-8:] == MCAP0_MAGIC and len(data) > 8
    if damaged or not is_closed or not _ends(data, whole_to):
        missing(Missing(path, since_s, None, damaged=damaged or is_closed))


def _records_at(data: mmap.mmap, begin: int, size: int) -> tuple[list[McapRecord], int]:
    """Raises an exception of any kind for what is not as it was written."""
    opcode, length = _RECORD.unpack_from(data, begin)
    end = begin + _RECORD.size + length
    if end > size or length > _MOST_CHUNK_BYTES:
        raise ValueError("breaks off")
    stream = ReadDataStream(BytesIO(data[begin + _RECORD.size : end]))
    record = (Chunk if opcode == Opcode.CHUNK else Metadata).read(stream)
    if stream.count != length:  # Or it would pass for what is behind it, too.
        raise ValueError("its length is not what it says")
    if isinstance(record, Chunk):
        return _unpacked(record), end
    crc = record.metadata.get("crc")
    if crc is not None and crc != _crc(record.metadata):
        raise ValueError("its metadata are damaged")
    return [record], end


def _indexes(data: mmap.mmap, begin: int, end: int) -> bool:
    """Whether nothing is between a chunk and the next but its messages' indexes."""
    while begin + _RECORD.size + 6 <= end:
        opcode, length = _RECORD.unpack_from(data, begin)
        (entries,) = struct.unpack_from("<I", data, begin + _RECORD.size + 2)
        is_header = opcode == Opcode.HEADER and begin == len(MCAP0_MAGIC)
        if not is_header and (opcode != Opcode.MESSAGE_INDEX or length != 6 + entries):
            return False
        begin += _RECORD.size + length
    return begin == end


def _ends(data: mmap.mmap, begin: int) -> bool:
    """Whether nothing more was recorded: the end of the data follows, behind the last indexes."""
    end = data.find(_RECORD.pack(Opcode.DATA_END, 4), begin)
    return end >= 0 and _indexes(data, begin, end)


def _topics_in(metadata: Metadata) -> dict[int, str]:
    """By the numbers of their channels; should the chunk that has them be damaged."""
    return dict(enumerate(metadata.metadata.get("topics", "").split(), 1))


def _crc(texts: Mapping[str, str]) -> str:
    """Of all texts but the one that is called so."""
    others = sorted(item for item in texts.items() if item[0] != "crc")
    return f"{zlib.crc32(json.dumps(others).encode()):08x}"


def _unpacked(chunk: Chunk) -> list[McapRecord]:
    """Raises ValueError for what no flight log has, before it takes any memory."""
    packed, stated = chunk.data, chunk.uncompressed_size
    size = max(stated, zstandard.frame_content_size(packed))
    if size > min(_MOST_CHUNK_BYTES, 2**16 + _MOST_UNPACKED_SHARE * len(packed)):
        raise ValueError(f"{len(packed)} bytes of it would be {size}: is no flight log")
    return breakup_chunk(chunk, validate_crc=True)


class _Encoded(NamedTuple):
    topic: str
    time_ns: int
    data: bytes


class _Segment:
    """One file. Raises what the file system raises."""

    def __init__(self, path: Path, max_bytes: int, topics: Mapping[str, LoggedTopic]) -> None:
        self.path = path
        self.max_bytes = max_bytes
        self.pending_messages = 0
        # Where a fleet flew is not for everybody who has a login.
        self._file = _new_file(path)
        self._topics = topics
        self._texts: dict[str, str] | None = None  # to be repeated
        # The chunks are closed by `sync` alone.
        self._writer = Writer(self._file, max_bytes, CompressionType.ZSTD)
        self._channels: dict[str, int] = {}
        # Of the chunk that is not closed, the first of which has the schemas; and of what `close`
        # writes, which repeats them.
        self._pending_bytes = sum(len(topic.schema) + 128 for topic in topics.values())
        self._summary_bytes = self._pending_bytes + _CHUNK_OVERHEAD_BYTES

    def begin(self, metadata: LogMetadata) -> None:
        """Write what comes before the first message."""
        self._writer.start()
        texts = {key: str(value) for key, value in dataclasses.asdict(metadata).items()}
        texts["topics"] = " ".join(self._topics)
        self._texts = {"crc": _crc(texts), **texts}
        self._writer.add_metadata(_METADATA, self._texts)
        self._summary_bytes += sum(len(text.encode()) + 64 for text in self._texts.values())
        for name, topic in self._topics.items():
            schema = self._writer.register_schema(topic.schema_name, "jsonschema", topic.schema)
            self._channels[name] = self._writer.register_channel(name, "json", schema)
        self.sync()

    def has_room_for(self, encoded: _Encoded) -> bool:
        """Whether the file, closed after this message, is within its limit."""
        size = self._file.tell() + self._pending_bytes + self._summary_bytes
        size += len(encoded.data) + _MESSAGE_OVERHEAD_BYTES + _CHUNK_OVERHEAD_BYTES
        return size <= self.max_bytes

    @property
    def pending_bytes(self) -> int:
        """Of the chunk that is not closed."""
        return self._pending_bytes

    def write(self, encoded: _Encoded) -> None:
        channel = self._channels[encoded.topic]
        self._writer.add_message(channel, encoded.time_ns, encoded.data, encoded.time_ns)
        self.pending_messages += 1
        self._pending_bytes += len(encoded.data) + _MESSAGE_OVERHEAD_BYTES

    def sync(self) -> None:
        """Close the chunk, and wait until the disk has it."""
        self._writer.flush()  # type: ignore[no-untyped-call]
        if self.pending_messages and self._texts is not None:
            # Once more: without them nobody knows what the rest of a damaged file is.
            self._writer.add_metadata(_METADATA, self._texts)
            self._writer.flush()  # type: ignore[no-untyped-call]
            self._texts = None
        os.fsync(self._file.fileno())
        if self.pending_messages:
            self.pending_messages = self._pending_bytes = 0
            self._summary_bytes += _CHUNK_OVERHEAD_BYTES

    def close(self) -> None:
        self.sync()
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
