"""Channels for a `FoxgloveView`'s messages, to clients or into a file."""

from typing import Any

from foxglove import Channel, Context, Schema
from foxglove.channels import (
    FrameTransformsChannel,
    GridChannel,
    LogChannel,
    SceneUpdateChannel,
)

from edge.drivers.flight_log import ROBOT_TOPICS, LoggedTopic, topic
from edge.messages.codec import encode
from lpac.ground.foxglove.view import Shown, ShownFleet
from lpac.ground.record import TOPICS

_FLEET = topic("Fleet", ShownFleet)


class Channels:
    """All channels of one `Context`."""

    def __init__(self, context: Context) -> None:
        self._context = context
        # Created before any message, so that clients see all topics at once.
        self._foxglove: dict[str, Any] = {
            "/tf": FrameTransformsChannel("/tf", context=context),
            "/robots": SceneUpdateChannel("/robots", context=context),
            "/cells": SceneUpdateChannel("/cells", context=context),
            "/fence": SceneUpdateChannel("/fence", context=context),
            "/density": GridChannel("/density", context=context),
            "/seen": GridChannel("/seen", context=context),
            "/log": LogChannel("/log", context=context),
        }
        self._json = {
            "/fleet": self._json_channel("/fleet", _FLEET),
            "/cost": self._json_channel("/cost", TOPICS["cost"]),
        }

    def publish(self, shown: Shown) -> None:
        """Publish without waiting."""
        time_ns = int(shown.unix_time_s * 1e9)
        channel = self._foxglove.get(shown.topic)
        if channel is not None:
            channel.log(shown.message, log_time=time_ns)
            return
        if shown.topic not in self._json:
            # /robot/<name>
            self._json[shown.topic] = self._json_channel(shown.topic, ROBOT_TOPICS["status"])
        self._json[shown.topic].log(encode(shown.message), log_time=time_ns)

    def _json_channel(self, name: str, described: LoggedTopic) -> Channel:
        schema = Schema(name=described.schema_name, encoding="jsonschema", data=described.schema)
        return Channel(name, schema=schema, message_encoding="json", context=self._context)
