"""Reads flight logs of `edge.drivers.flight_log`, including damaged ones.

A log may come from anyone: parts that unpack to more than a flight log has are refused.
"""

import binascii
import dataclasses
import json
import mmap
import os
import re
import struct
from collections.abc import Callable, Iterator
from datetime import datetime
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import breakup_chunk
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from edge.core.logger import log
from edge.drivers.flight_log import (
    ARRAY_KINDS,
    MOST_CHUNK_BYTES,
    MOST_MESSAGE_BYTES,
    FlightMetadata,
    checksum,
    new_file,
)

_MOST_COMPRESSION = 200.0
# First bytes of a chunk, and of the metadata `lpac`: reading resumes at these after damage.
_ANCHOR = re.compile(rb"\x06.{36}\x04\0\0\0zstd|\x0c.{8}\x04\0\0\0lpac", re.DOTALL)
_RECORD = struct.Struct("<BQ")


class FlightLogError(ValueError):
    """The file is not a flight log; the text says why."""


class LogGap(NamedTuple):
    """Missing messages between two others, before the first (None) or after the last (None).

    `damaged` is False for a log that ends early: its program was killed, lost its power, or is
    still writing.
    """

    path: Path
    since_unix_s: float | None
    until_unix_s: float | None
    damaged: bool

    def __str__(self) -> str:
        what = "is damaged" if self.damaged else "breaks off"
        since_s, until_s = self.since_unix_s, self.until_unix_s
        since = "its beginning" if since_s is None else _local_time(since_s)
        until = "on" if until_s is None else f"to {_local_time(until_s)}"
        return f"{self.path}: {what}: holds nothing from {since} {until}"


def _local_time(unix_s: float) -> str:
    return f"{datetime.fromtimestamp(unix_s).astimezone():%Y-%m-%d %H:%M:%S}"


def warn(gap: LogGap) -> None:
    """Log a gap as a warning."""
    log.warning(str(gap))


def read_metadata(path: Path) -> FlightMetadata:
    """Read a segment's metadata.

    Raises FlightLogError for a file that is not MCAP or not a robot's, or OSError.
    """
    for records in _intact_parts(path, lambda _: None):
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
    path: Path, *only: str, on_gap: Callable[[LogGap], None] = warn
) -> Iterator[tuple[str, float, dict[str, Any]]]:
    """Yield a segment's messages in order of writing: topic, Unix time in s, message.

    With topics in `only`, others are skipped, three times as fast. Damaged parts are skipped, and a
    segment that breaks off is read to its end; `on_gap` is called for both. Arrays have the same
    bits as those recorded, bytes are bytes.

    Raises FlightLogError if the file is not a flight log, OSError if it cannot be read.
    """
    topics: dict[int, str] = {}
    for records in _intact_parts(path, on_gap):
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


def repair(path: Path, out: Path, on_gap: Callable[[LogGap], None] = warn) -> int:
    """Write the intact messages of a segment to the new file `out`; returns their number.

    Raises FlightLogError if there are none; OSError, also if `out` exists.
    """
    file = new_file(out)
    try:
        with file:
            count = _copy_intact(path, file, on_gap)
        if not count:
            raise FlightLogError(f"{path}: holds no intact message")
    except BaseException:
        out.unlink(missing_ok=True)
        raise
    return count


def _copy_intact(path: Path, file: BinaryIO, on_gap: Callable[[LogGap], None]) -> int:
    count = 0
    writer = Writer(file, 2**20, CompressionType.ZSTD)
    writer.start()
    schemas, channels = {0: 0}, dict[int, int]()
    for records in _intact_parts(path, on_gap):
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


def _message(data: bytes) -> dict[str, Any]:
    if len(data) > MOST_MESSAGE_BYTES:
        raise ValueError(f"has {len(data)} bytes")
    message = json.loads(data, object_hook=_decoded)
    if not isinstance(message, dict):
        raise TypeError(f"a {type(message).__name__}")
    return message


def _decoded(value: dict[str, Any]) -> object:
    """Convert a JSON object that represents an array or bytes; others are unchanged."""
    if value.keys() == {"dtype", "shape", "data"}:
        data, dtype = binascii.a2b_base64(value["data"]), np.dtype(value["dtype"])
        if dtype.kind not in ARRAY_KINDS:
            raise ValueError(f"an array of {dtype}")
        return np.ndarray(value["shape"], dtype, data)
    if value.keys() == {"base64"}:
        return binascii.a2b_base64(value["base64"])
    return value


def _intact_parts(path: Path, on_gap: Callable[[LogGap], None]) -> Iterator[list[McapRecord]]:
    """Yield the intact parts of a log, by their checksums: metadata, and each chunk's records.

    Other records only show whether something is missing in between.
    """
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        if not size:
            on_gap(LogGap(path, None, None, damaged=False))
            return
        with mmap.mmap(file.fileno(), size, access=mmap.ACCESS_READ) as data:
            yield from _intact_parts_of(path, data, on_gap)


def _intact_parts_of(
    path: Path, data: mmap.mmap, on_gap: Callable[[LogGap], None]
) -> Iterator[list[McapRecord]]:
    begins = MCAP0_MAGIC.startswith(data[:8])
    intact_to, at, since_s = len(MCAP0_MAGIC), 0, None
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
        except Exception:  # errors of mcap, struct and zstandard all mean damage
            at = anchor.start() + 1
            continue
        damaged = damaged or not _only_indexes(data, intact_to, anchor.start())
        times_s = [record.log_time / 10**9 for record in records if isinstance(record, Message)]
        if damaged and times_s:
            on_gap(LogGap(path, since_s, times_s[0], damaged=True))
            damaged = False
        since_s = times_s[-1] if times_s else since_s
        yield records
        intact_to = at = end
        found = True
    if not found and not begins:
        raise FlightLogError(f"{path}: is not an MCAP file")
    is_closed = data[-8:] == MCAP0_MAGIC and len(data) > 8
    if damaged or not is_closed or not _is_last(data, intact_to):
        on_gap(LogGap(path, since_s, None, damaged=damaged or is_closed))


def _records_at(data: mmap.mmap, begin: int, size: int) -> tuple[list[McapRecord], int]:
    """Records of the part at `begin`, and its end. Raises any exception for a damaged one."""
    opcode, length = _RECORD.unpack_from(data, begin)
    end = begin + _RECORD.size + length
    if end > size or length > MOST_CHUNK_BYTES:
        raise ValueError("breaks off")
    stream = ReadDataStream(BytesIO(data[begin + _RECORD.size : end]))
    record = (Chunk if opcode == Opcode.CHUNK else Metadata).read(stream)
    if stream.count != length:  # a wrong length would hide the parts that follow
        raise ValueError("its length is wrong")
    if isinstance(record, Chunk):
        return _unpacked(record), end
    crc = record.metadata.get("crc")
    if crc is not None and crc != checksum(record.metadata):
        raise ValueError("its metadata are damaged")
    return [record], end


def _only_indexes(data: mmap.mmap, begin: int, end: int) -> bool:
    """Whether nothing lies between two parts except the file's header and message indexes."""
    while begin + _RECORD.size + 6 <= end:
        opcode, length = _RECORD.unpack_from(data, begin)
        (entries,) = struct.unpack_from("<I", data, begin + _RECORD.size + 2)
        is_header = opcode == Opcode.HEADER and begin == len(MCAP0_MAGIC)
        if not is_header and (opcode != Opcode.MESSAGE_INDEX or length != 6 + entries):
            return False
        begin += _RECORD.size + length
    return begin == end


def _is_last(data: mmap.mmap, begin: int) -> bool:
    """Whether the end of the data section follows the indexes at `begin`."""
    end = data.find(_RECORD.pack(Opcode.DATA_END, 4), begin)
    return end >= 0 and _only_indexes(data, begin, end)


def _topics_in(metadata: Metadata) -> dict[int, str]:
    """Topics by channel number, in case the chunk that defines them is damaged."""
    return dict(enumerate(metadata.metadata.get("topics", "").split(), 1))


def _unpacked(chunk: Chunk) -> list[McapRecord]:
    """Unpack a chunk. Raises ValueError for one that is too large, before it takes memory."""
    packed, stated = chunk.data, chunk.uncompressed_size
    size = max(stated, zstandard.frame_content_size(packed))
    if size > min(MOST_CHUNK_BYTES, 2**16 + _MOST_COMPRESSION * len(packed)):
        raise ValueError(f"{len(packed)} bytes of it would be {size}: is not a flight log")
    return breakup_chunk(chunk, validate_crc=True)
