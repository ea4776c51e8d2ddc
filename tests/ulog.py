"""PX4's log format, as far as tests write it."""

import struct

HEADER = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)


def message(kind: str, content: bytes) -> bytes:
    """One message: B flags, F format of a topic, A its number, D its values."""
    return struct.pack("<HB", len(content), ord(kind)) + content
