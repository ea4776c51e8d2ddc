"""Adapter for Fast DDS, with ROS 2's default quality of service.

Fast DDS has no Python package: `fast_dds.cpp` is compiled once against the installed library.
"""

import ctypes
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, suppress
from functools import cache
from pathlib import Path
from threading import Event, Thread
from typing import Self

from edge.messages.topics import MESSAGE, TOPICS
from lpac.middleware.kinds import Peer

_SOURCE = Path(__file__).with_name("fast_dds.cpp")
# The same domains as in `over_cyclone`: a measurement never runs both at once.
_DOMAINS, _PORTS_OF_A_BLOCK = 50, 200
_TAKE_TIMEOUT_MS = 200
_MOST_BYTES = 2**20
_TOPICS = (MESSAGE, *(t for t in TOPICS if t.sender == "robot" and t != MESSAGE))


def version() -> str | None:
    """Installed version; None without Fast DDS or a compiler."""
    library = _library()
    return None if library is None else library.fast_dds_version().decode()


@cache
def _library() -> ctypes.CDLL | None:
    compiler = shutil.which("c++")
    if compiler is None:
        return None
    name = hashlib.sha256(_SOURCE.read_bytes()).hexdigest()[:16]
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "lpac-edge"
    compiled = folder / f"fast-dds-{name}.so"
    # Fails after an upgrade of Fast DDS: then compile again.
    with suppress(OSError):
        return _loaded(compiled)
    with suppress(OSError, subprocess.CalledProcessError):
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            new = Path(scratch) / "new.so"
            to_compile = ["-std=c++17", "-O2", "-shared", "-fPIC", "-o", str(new), str(_SOURCE)]
            subprocess.run(
                [compiler, *to_compile, "-lfastrtps", "-lfastcdr"], check=True, capture_output=True
            )
            new.replace(compiled)
        return _loaded(compiled)
    return None


def _loaded(path: Path) -> ctypes.CDLL:
    """Load the library and declare its functions. Raises OSError."""
    library = ctypes.CDLL(str(path))
    pointer, number, text = ctypes.c_void_p, ctypes.c_uint32, ctypes.c_char_p
    for function, returns, takes in (
        (library.fast_dds_version, text, ()),
        (library.fast_dds_open, pointer, (number, text, ctypes.POINTER(text), ctypes.c_int)),
        (library.fast_dds_close, None, (pointer,)),
        (library.fast_dds_publish, ctypes.c_int, (pointer, text, number)),
        (library.fast_dds_take, ctypes.c_int, (pointer, text, number, number)),
    ):
        function.restype, function.argtypes = returns, takes
    return library


class _FastPeer:
    def __init__(
        self,
        library: ctypes.CDLL,
        domain: int,
        address: str,
        receive: Callable[[bytes], None],
    ) -> None:
        """Raises OSError."""
        self._library = library
        self._receive = receive
        names = (ctypes.c_char_p * len(_TOPICS))(*(topic.name.encode() for topic in _TOPICS))
        self._peer = library.fast_dds_open(domain, address.encode(), names, len(_TOPICS))
        if self._peer is None:
            raise OSError(f"Fast DDS cannot open a participant at {address}")
        self._closed = Event()
        self._receiving = Thread(target=self._take, daemon=True)

    def __enter__(self) -> Self:
        self._receiving.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closed.set()
        self._receiving.join()
        self._library.fast_dds_close(self._peer)

    def publish(self, data: bytes) -> None:
        if not self._library.fast_dds_publish(self._peer, data, len(data)):
            sys.stderr.write("write: the queue of Fast DDS is full\n")

    def _take(self) -> None:
        buffer = ctypes.create_string_buffer(_MOST_BYTES)
        while not self._closed.is_set():
            size = self._library.fast_dds_take(self._peer, buffer, _MOST_BYTES, _TAKE_TIMEOUT_MS)
            if size > 0:
                self._receive(ctypes.string_at(buffer, size))


def open_peer(
    index: int, endpoints: Sequence[str], receive: Callable[[bytes], None]
) -> AbstractContextManager[Peer]:
    """See `OpenPeer`. Robots discover each other on ports chosen by DDS."""
    library = _library()
    if library is None:
        raise ModuleNotFoundError("Fast DDS is not installed")
    address = endpoints[index].rpartition(":")[0]
    domain = int(endpoints[0].rpartition(":")[2]) // _PORTS_OF_A_BLOCK % _DOMAINS
    return _FastPeer(library, domain, address, receive)
