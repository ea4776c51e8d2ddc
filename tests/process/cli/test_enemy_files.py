"""Files that somebody made to do harm: refused in one line, and in little memory."""

import base64
import contextlib
import hashlib
import io
import json
import os
import struct
import subprocess
import sys
import zipfile
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType, Writer

from edge.drivers.flight_log import FlightLog, FlightMetadata
from edge.drivers.log_reader import read
from edge.policy.bundle import Bundle, load_bundle, make_bundle
from edge.policy.golden import GOLDEN
from tests.conftest import ROOT, SHIPPED

MOST_BYTES = 256e6
GIGABYTE = 10**9
BRACKETS = b"[" * 100_000


# Commands in one process, what they printed, and how much memory that had at most, kB. What draws
# figures takes longer to load than a refusal may.
COMMANDS = """
import contextlib, io, json, re, sys
from pathlib import Path
from lpac.cli.main import main
ended = []
for sys.argv in json.loads(sys.argv[1]):
    out, err = io.StringIO(), io.StringIO()
    code = 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main()
        except SystemExit as stop:
            code = stop.code or 0
    if isinstance(code, str):
        err.write(code)
        code = 1
    ended.append((code, out.getvalue(), err.getvalue()))
most = re.search(r"VmHWM:\\s+(\\d+) kB", Path("/proc/self/status").read_text())
print(json.dumps([ended, int(most[1]), "matplotlib" in sys.modules]))
"""


class Ended(NamedTuple):
    """How a command ended."""

    code: int
    out: str
    err: str


def lpac(*commands: Sequence[object]) -> list[Ended]:
    """The commands, one after another, take little memory, and load nothing that draws."""
    typed = [["lpac", *map(str, command)] for command in commands]
    done = subprocess.run(
        [sys.executable, "-c", COMMANDS, json.dumps(typed)],
        cwd=ROOT, capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "200"},
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    ended, most_kb, draws = json.loads(done.stdout)
    assert most_kb * 1024 < MOST_BYTES
    assert not draws
    return [Ended(*each) for each in ended]


def refused(*command: object) -> str:
    """The one line that the command leaves."""
    return line_of(*lpac(command))


def line_of(ended: Ended) -> str:
    assert ended.code == 1, ended
    (line,) = ended.err.strip().splitlines()
    assert line.startswith("lpac: ") and "defect" not in line
    return line


def zip_of(name: str, content_size: int, method: int) -> bytes:
    """An archive of zeros."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive, archive.open(name, "w") as entry:
        for _ in range(content_size // 10**6):
            entry.write(bytes(10**6))
    return buffer.getvalue()


def with_golden(bundle: Bundle, golden: bytes) -> Bundle:
    files = {name: bundle.files[name] for name in bundle.manifest.files}
    return make_bundle(bundle.manifest, {**files, GOLDEN: golden})


def npz_of_huge_shape() -> bytes:
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000,)}\n"
    array = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("cnn.onnx/input.npy", array)
    return buffer.getvalue()


def test_archives_that_unpack_to_gigabytes(tmp_path: Path) -> None:
    path = tmp_path / "bundle.zip"
    path.write_bytes(zip_of("manifest.json", GIGABYTE, zipfile.ZIP_DEFLATED))
    assert path.stat().st_size < 2e6
    assert "bundle.zip: has 1000 MB; a bundle has at most 34" in refused("bundle", "verify", path)


def test_a_file_of_gigabytes_is_not_read(tmp_path: Path) -> None:
    for name in ("bundle.zip", "manifest.json"):
        folder = tmp_path / name.split(".")[0]
        folder.mkdir()
        (folder / "manifest.json").write_bytes(b"{}")
        os.truncate(folder / "manifest.json", 2)
        with (folder / name).open("wb") as file:
            file.truncate(4 * GIGABYTE)
        path = folder / name if name == "bundle.zip" else folder
        assert "has 4000 MB; a bundle has at most 34" in refused("bundle", "verify", path)


@pytest.mark.parametrize("text", [BRACKETS, b'{"a":' * 100_000, b" " * 10**7])
def test_manifests_of_brackets(tmp_path: Path, text: bytes) -> None:
    (tmp_path / "manifest.json").write_bytes(text)
    (tmp_path / "bundle.id").write_text("")
    refused("bundle", "verify", tmp_path)
    (tmp_path / "bundle.id").write_text(f"{hashlib.sha256(text).hexdigest()}\n")
    line = refused("bundle", "verify", tmp_path)
    assert "manifest.json is not JSON" in line or "manifest.json has 10000000 bytes" in line


@pytest.mark.parametrize(
    "golden",
    [
        lambda: zip_of("cnn.onnx/input.npy", GIGABYTE, zipfile.ZIP_DEFLATED),
        npz_of_huge_shape,
        lambda: BRACKETS,
    ],
)
def test_golden_outputs_that_unpack_to_gigabytes(
    tmp_path: Path, golden: Callable[[], bytes]
) -> None:
    bundle = with_golden(load_bundle(SHIPPED), golden())
    for name, content in bundle.files.items():
        (tmp_path / name).write_bytes(content)
    assert "golden.npz: " in refused("bundle", "verify", tmp_path)


def chunk(content: bytes, stated: int | None = None, name: bytes = b"zstd") -> bytes:
    """A record of MCAP with messages, packed; `stated` is how many bytes it says that it has."""
    size = len(content) if stated is None else stated
    packed = zstandard.compress(content) if name == b"zstd" else content
    body = struct.pack("<QQQI", 0, 0, size, zlib.crc32(content))
    body += struct.pack("<I", len(name)) + name + struct.pack("<Q", len(packed)) + packed
    return b"\x06" + struct.pack("<Q", len(body)) + body


def begun(path: Path) -> Path:
    """A robot's log as it is at its begin."""
    bundle = load_bundle(SHIPPED)
    log = FlightLog(path.parent, FlightMetadata(0, 1, bundle.id, str(SHIPPED), "{}", "0.2.0"))
    log.flush()
    first = path.parent / "robot-0-0001.mcap"
    path.write_bytes(first.read_bytes())
    log.close()
    first.unlink()
    return path


def messages(*texts: bytes, topic: str = "policy") -> Callable[[Path], None]:
    """Writes a log with these messages, as the robot's program packs them."""

    def write(path: Path) -> None:
        bundle_id = load_bundle(SHIPPED).id
        with path.open("wb") as file:
            writer = Writer(file, 2**24, CompressionType.ZSTD)
            writer.start()
            metadata = {
                "robot_id": "0", "boot_nonce": "1", "bundle_id": bundle_id,
                "bundle_path": str(SHIPPED), "configuration": "{}", "version": "0.2.0",
            }  # fmt: skip
            writer.add_metadata("lpac", metadata)
            channel = writer.register_channel(topic, "json", 0)
            for text in texts:
                writer.add_message(channel, 1, text, 1)
            writer.finish()  # type: ignore[no-untyped-call]

    return write


def appended(record: bytes) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        begun(path)
        path.write_bytes(path.read_bytes() + record)

    return write


def said(**values: Any) -> bytes:
    return json.dumps(values).encode()


ARRAY = {"dtype": "<f4", "shape": [1], "data": base64.b64encode(bytes(4)).decode()}
STATUS = {"robot_id": 0, "boot_nonce": 1, "sequence": 1, "uptime_s": 1.0, "unix_time_s": 1.0}
LOGS: dict[str, Callable[[Path], None]] = {
    "unpacks to a gigabyte": appended(chunk(bytes(GIGABYTE // 2))),
    "says that it is small": appended(chunk(bytes(GIGABYTE // 2), stated=100)),
    "unpacks to very much": appended(chunk(bytes(10**7))),
    "another compression": appended(chunk(b"", name=b"lz4")),
    "brackets": messages(BRACKETS),
    "an integer of many digits": messages(b'{"a": ' + b"9" * 100_000 + b"}"),
    "no object": messages(b"[]"),
    "array of objects": messages(said(features={**ARRAY, "dtype": "|O8"})),
    "array of a large type": messages(said(features={**ARRAY, "dtype": "|V1000000000"})),
    "array of a huge shape": messages(said(features={**ARRAY, "shape": [10**12]})),
    "array of a negative shape": messages(said(features={**ARRAY, "shape": [-1]})),
    "array of nothing": messages(said(features={"dtype": 1, "shape": 2, "data": 3})),
    "odd fields": messages(said(features=ARRAY, velocity=3, payloads=4, degree="x", message=1)),
    "a trial that is no text": messages(said(**STATUS, trial={"a": 1}), topic="status"),
    "a status of lists": messages(said(**{key: [] for key in STATUS}, trial=[]), topic="status"),
}


@pytest.mark.parametrize("name", LOGS)
def test_logs(tmp_path: Path, name: str) -> None:
    """Nothing is made of them, and they are listed all the same."""
    folder = tmp_path / "logs"
    folder.mkdir()
    LOGS[name](folder / "robot-0-0007.mcap")
    replayed, reported, listed = lpac(
        ("replay", folder), ("report", folder, "--out", tmp_path / "report"),
        ("log", "trials", folder, "--json"),
    )  # fmt: skip
    line_of(replayed)
    line_of(reported)
    assert listed.code == 0
    json.loads(listed.out)
    assert all(line.startswith("lpac: ") for line in listed.err.splitlines())


def test_a_log_whose_writer_was_stopped_for_long_is_whole(tmp_path: Path) -> None:
    """The chunks that it then writes are not larger than those that are read."""
    metadata = FlightMetadata(0, 1, "0", "", "{}", "0.2.0")
    noise = np.random.default_rng(0).random((100, 2**17))
    with contextlib.closing(FlightLog(tmp_path, metadata, max_segment_bytes=2**28)) as log:
        for n, row in enumerate(noise):
            log.record("perception", float(n), {"images": row})
        log.flush()
    (path,) = tmp_path.glob("*.mcap")
    assert [int(time_s) for _, time_s, _ in read(path)] == list(range(100))
