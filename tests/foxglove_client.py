"""What a client of Foxglove's makes of what it is sent: messages by the schemas that came along."""

import base64
import json
import struct
from collections.abc import Awaitable, Callable
from typing import Any, NamedTuple

import aiohttp
from google.protobuf import descriptor_pool, json_format, message_factory
from google.protobuf.descriptor_pb2 import FileDescriptorSet

SUBPROTOCOL = "foxglove.sdk.v1"
_MESSAGE = 1


def decoded(schema_name: str, schema: bytes, data: bytes) -> dict[str, Any]:
    """A protobuf message of the schema; fields that are 0 are left out."""
    pool = descriptor_pool.DescriptorPool()
    for file in FileDescriptorSet.FromString(schema).file:
        pool.Add(file)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema_name))
    message: dict[str, Any] = json_format.MessageToDict(
        kind.FromString(data), preserving_proto_field_name=True
    )
    return message


class Heard(NamedTuple):
    """A message of a topic, as the client understood it."""

    topic: str
    unix_time_s: float
    message: dict[str, Any]


class FoxgloveClient:
    """Subscribes to all that is advertised; `channels` are those, by topic."""

    def __init__(self, stream: aiohttp.ClientWebSocketResponse) -> None:
        self.channels: dict[str, dict[str, Any]] = {}
        self.statuses: list[str] = []
        self._stream = stream
        self._topics: dict[int, str] = {}

    async def hear(self, wanted: Callable[[Heard], bool]) -> Heard:
        """The next message that is so."""
        while True:
            heard = await self._next()
            if heard is not None and wanted(heard):
                return heard

    async def until(self, condition: Callable[[], bool]) -> None:
        """Listen until it holds."""
        while not condition():
            await self._next()

    async def _next(self) -> Heard | None:
        frame = await self._stream.receive()
        if frame.type is aiohttp.WSMsgType.BINARY:
            return self._heard(frame.data)
        assert frame.type is aiohttp.WSMsgType.TEXT, frame
        said = json.loads(frame.data)
        if said["op"] == "advertise":
            await self._subscribe(said["channels"])
        elif said["op"] == "status":
            self.statuses.append(said["message"])
        return None

    def _subscribe(self, channels: list[dict[str, Any]]) -> Awaitable[None]:
        for channel in channels:
            self.channels[channel["topic"]] = channel
            self._topics[channel["id"]] = channel["topic"]
        wanted = [{"id": channel["id"], "channelId": channel["id"]} for channel in channels]
        return self._stream.send_json({"op": "subscribe", "subscriptions": wanted})

    def _heard(self, data: bytes) -> Heard | None:
        opcode, subscription, time_ns = struct.unpack_from("<BIQ", data)
        if opcode != _MESSAGE:
            return None
        payload = data[13:]
        topic = self._topics[subscription]
        channel = self.channels[topic]
        if channel["encoding"] == "json":
            return Heard(topic, time_ns / 1e9, json.loads(payload))
        schema = base64.b64decode(channel["schema"] + "==")
        return Heard(topic, time_ns / 1e9, decoded(channel["schemaName"], schema, payload))
