"""Writes to a disk that is full or read-only: a real file system, in memory."""

import contextlib
import errno
import os
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from edge.drivers.flight_log import FlightLog, FlightMetadata
from edge.drivers.identity_folder import load_identity
from edge.drivers.log_reader import LogGap, read
from edge.identity.members import Role
from lpac.fleet.authority import create_authority, new_member
from tests.needs import missing
from tests.said import lines_said

METADATA = FlightMetadata(3, 77, "ab" * 32, "policies/x", "{}", "0.1.0")
NOISE = np.random.default_rng(0).integers(0, 256, 20_000, np.uint8)  # does not compress
NOW_S = 1.7e9


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """It has 2 MB."""
    if lacks := missing(root=True):
        pytest.skip(lacks)
    folder = tmp_path / "disk"
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", folder], check=True)
    yield folder
    subprocess.run(["umount", folder], check=True)


@contextlib.contextmanager
def read_only(disk: Path) -> Iterator[None]:
    subprocess.run(["mount", "-o", "remount,ro", disk], check=True)
    yield
    subprocess.run(["mount", "-o", "remount,rw", disk], check=True)


def free_share(disk: Path) -> float:
    told = os.statvfs(disk)
    return told.f_bavail / told.f_blocks


def fill(disk: Path) -> Path:
    filler = disk / "filler"
    with contextlib.suppress(OSError), filler.open("wb") as file:
        while True:
            file.write(bytes(4096))
            file.flush()
    return filler


def numbers(folder: Path) -> list[int]:
    missing: list[LogGap] = []
    return [
        message["number"]
        for path in sorted(folder.glob("robot-*.mcap"))
        for _, _, message in read(path, on_gap=missing.append)
    ]


def test_a_disk_that_others_fill_does_not_cost_the_flight_so_far(disk: Path) -> None:
    folder = disk / "logs"
    with contextlib.closing(FlightLog(folder, METADATA, sync_period_s=0)) as log:
        for number in range(16):
            log.record("policy", NOW_S, {"number": number, "array": NOISE})
            log.flush()
        filler = disk / "filler"
        with filler.open("wb", buffering=0) as file:
            while free_share(disk) >= 0.1:
                file.write(bytes(4096))
        for number in range(16, 30):
            log.record("policy", NOW_S, {"number": number, "array": NOISE})
            log.flush()
        assert not log.recording and numbers(folder)[:16] == list(range(16))
        filler.unlink()
        log.flush()
        assert log.recording
    assert numbers(folder)[:16] == list(range(16))


def test_a_log_leaves_room_and_deletes_its_oldest(disk: Path) -> None:
    folder = disk / "logs"
    folder.mkdir()
    old = folder / "robot-3-0001.mcap"
    old.write_bytes(bytes(1_900_000))
    with contextlib.closing(FlightLog(folder, METADATA, sync_period_s=0)) as log:
        assert log.recording and not old.exists()
        for number in range(300):  # 6 MB
            log.record("policy", NOW_S, {"number": number, "array": NOISE})
            log.flush()
            assert log.recording and free_share(disk) >= 0.09
    found = numbers(folder)
    assert log.dropped == 0 and len(found) > 20 and found == list(range(300))[-len(found) :]


def test_a_disk_that_others_fill_stops_the_log_until_there_is_room(disk: Path) -> None:
    folder = disk / "logs"
    with (
        lines_said() as lines,
        contextlib.closing(
            FlightLog(folder, METADATA, sync_period_s=0, max_queued_messages=10)
        ) as log,
    ):
        log.record("policy", NOW_S, {"number": 0})
        log.flush()
        filler = fill(disk)
        for number in range(1, 100):
            log.record("policy", NOW_S, {"number": number, "array": NOISE})
            log.flush()
        assert not log.recording and log.dropped
        stopped = [line for line in lines if line["event"] == "flight log stopped"]
        assert len(stopped) == 1 and stopped[0]["path"] == str(folder / "robot-3-0001.mcap")
        dropped = log.dropped
        filler.unlink()
        log.flush()
        assert log.recording
        log.flush()
    found = numbers(folder)
    # The last ones that were recorded meanwhile waited.
    assert found[-10:] == list(range(90, 100)) and len(found) + dropped == 100
    assert any(line["event"] == "flight log goes on" for line in lines)
    assert [line["dropped"] for line in lines if "dropped" in line] == [dropped]


def test_a_read_only_disk_stops_the_log_until_it_is_mended(disk: Path) -> None:
    with contextlib.ExitStack() as until_mended:
        until_mended.enter_context(read_only(disk))
        with contextlib.closing(FlightLog(disk, METADATA, sync_period_s=0)) as log:
            log.record("policy", NOW_S, {"number": 1})
            log.flush()
            assert not log.recording
            until_mended.close()
            log.flush()
            assert log.recording
    assert numbers(disk) == [1] and log.dropped == 0


def test_an_identity_has_room_kept_for_it(disk: Path, tmp_path: Path) -> None:
    authority = create_authority(tmp_path / "keys", "demo")
    folder = disk / "identity"
    new_member(authority, folder, Role.ROBOT, "r3", 3)
    load_identity(folder, fleet="demo", unix_s=2e9)
    fill(disk)
    identity = load_identity(folder, fleet="demo", unix_s=3e9)
    assert (folder / "start").read_text() == f"{identity.membership.start}\n" == "3000000000000\n"
    identity.update(identity.guard(lambda: 0.0))


def test_an_identity_on_a_read_only_disk_starts_all_the_same(disk: Path, tmp_path: Path) -> None:
    authority = create_authority(tmp_path / "keys", "demo")
    folder = disk / "identity"
    new_member(authority, folder, Role.ROBOT, "r3", 3)
    load_identity(folder, fleet="demo", unix_s=2e9)
    with read_only(disk):
        starts = [load_identity(folder, fleet="demo", unix_s=5.0)]
        began_ms = time.monotonic_ns() // 10**6
        while time.monotonic_ns() // 10**6 == began_ms:
            pass  # No two programs start within a millisecond.
        starts += [load_identity(folder, fleet="demo", unix_s=5.0)]
        assert 2e12 < starts[0].membership.start < starts[1].membership.start
        guard = starts[1].guard(lambda: 0.0)
        with pytest.raises(OSError) as raised:
            starts[1].update(guard)
        assert (raised.value.errno, raised.value.filename) == (errno.EROFS, str(folder / "start"))
    starts[1].update(guard)
    later = load_identity(folder, fleet="demo", unix_s=5.0)
    assert later.membership.start == starts[1].membership.start + 1
