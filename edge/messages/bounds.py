"""Bounds of numbers, texts and lists in messages: decoding refuses everything else.

They are far beyond what a fleet needs, and below what costs or breaks anything.
"""

from typing import Annotated

from msgspec import Meta

from edge.core.wire import MAX_ROBOT_ID

MOST_ROBOTS = 1000
MOST_TEXTS = 100
MOST_LETTERS = 1000


RobotId = Annotated[int, Meta(ge=0, le=MAX_ROBOT_ID)]
# Keys of JSON objects are strings.
RobotKey = Annotated[str, Meta(pattern=r"^[0-9]{1,5}$")]
# 32 bits; 0 is none.
TimeBase = Annotated[int, Meta(ge=0, lt=2**32)]
Nonce = Annotated[int, Meta(ge=0, lt=2**48)]
Sequence = Annotated[int, Meta(ge=-1, le=2**48)]
Count = Annotated[int, Meta(ge=0, le=2**53)]
SystemId = Annotated[int, Meta(ge=0, le=255)]
Name = Annotated[str, Meta(max_length=128)]
Text = Annotated[str, Meta(max_length=MOST_LETTERS)]
Metres = Annotated[float, Meta(ge=-1e6, le=1e6)]
MetresPerSecond = Annotated[float, Meta(ge=-1e4, le=1e4)]
Radians = Annotated[float, Meta(ge=-100.0, le=100.0)]
Degrees = Annotated[float, Meta(ge=-720.0, le=720.0)]
Seconds = Annotated[float, Meta(ge=-1e9, le=1e9)]
UnixSeconds = Annotated[float, Meta(ge=0.0, le=1e11)]
Milliseconds = Annotated[float, Meta(ge=-1e9, le=1e9)]
Share = Annotated[float, Meta(ge=-0.01, le=10.0)]
Precision = Annotated[float, Meta(ge=0.0, le=1e4)]
