"""`lpac fleet pull` from real robot computers: what belongs to a trial, whole, and once."""

import asyncio
import contextlib
import json
import os
import shutil
import subprocess
import time
from collections.abc import Coroutine
from pathlib import Path

import pytest

from edge.drivers.flight_log import FlightLog, FlightMetadata
from edge.drivers.log_reader import read
from lpac.fleet.pull import Pulled, pull
from lpac.fleet.session import FleetError
from lpac.fleet.settings import load_fleet
from tests.host.fleet.field import armed, deploy_to, lpac_fleet, unwatched
from tests.host.hosts import FrailHost, FrailHosts

LOGS = "var/lib/private/lpac/logs"
# In the past, so that no file is taken for one that still grows.
FIRST_S = int(time.time()) - 1000
BIG_BYTES = 80_000_000


def write_logs(folder: Path, robot_id: int, trials: list[tuple[str, float]]) -> None:
    """A flight log each: ten seconds of that trial, after one without."""
    for trial, began_s in trials:
        log = FlightLog(folder, FlightMetadata(robot_id, 1, "b", "/release/bundle", "{}", "0"))
        log.record("status", began_s - 1.0, {"trial": ""})
        for second in range(11):
            log.record("status", began_s + second, {"trial": trial})
        log.close()
        newest = max(folder.glob("*.mcap"))
        os.utime(newest, (began_s + 11.0, began_s + 11.0))


def write_ulog(host: FrailHost, session: str, ended_s: float, data: bytes) -> None:
    path = host.root / f"data/px4/log/{session}/log100.ulg"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    os.utime(path, (ended_s, ended_s))


@pytest.fixture(scope="module")
def flown(hosts: FrailHosts) -> FrailHosts:
    """r1 has flown the trials A and B; r4, a spare, nothing."""
    deploy_to(hosts, "r1", "r4")
    r1 = hosts[0]
    r1.run("systemctl stop lpac-robot; rm -f /var/lib/private/lpac/logs/*")
    write_logs(r1.root / LOGS, 1, [("A", FIRST_S), ("B", FIRST_S + 100.0)])
    write_ulog(r1, "sess001", FIRST_S - 500.0, b"before")
    write_ulog(r1, "sess002", FIRST_S + 12.0, b"of A")
    write_ulog(r1, "sess003", FIRST_S + 112.0, b"of B")
    (r1.root / "data/px4/param/parameters").write_bytes(b"EKF2_HGT_REF")
    return hosts


def pulled(hosts: FrailHosts, trial: str | None, out: Path) -> Coroutine[None, None, Pulled]:
    """What is to be awaited: r1's part."""
    config = load_fleet(hosts.fleet_toml)
    return pull(config, config.robots["r1"], trial, out, unwatched)


def fetch(hosts: FrailHosts, trial: str | None, out: Path) -> Pulled:
    return asyncio.run(pulled(hosts, trial, out))


def names(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def test_what_belongs_to_the_trial_comes_whole_and_only_once(
    flown: FrailHosts, tmp_path: Path
) -> None:
    arguments = ("pull", "--trial", "A", "--robots", "r1", "--out", tmp_path)
    done = lpac_fleet(flown.fleet_toml, *arguments)
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "A" / "r1"
    assert names(folder) == {
        "logs/robot-1-0001.mcap", "px4/sess002/log100.ulg", "px4/parameters", "robot.toml",
        "versions.json", "journal.jsonl", "SHA256SUMS",
    }  # fmt: skip
    statuses = list(read(folder / "logs/robot-1-0001.mcap"))
    assert [message["trial"] for _, _, message in statuses] == ["", *["A"] * 11]
    subprocess.run(["sha256sum", "--check", "--quiet", "SHA256SUMS"], cwd=folder, check=True)
    again = fetch(flown, "A", tmp_path)
    assert (again.sent_bytes, again.files, again.summary) == (0, 6, "was here already")
    # What was damaged here is mended from there.
    (folder / "px4/sess002/log100.ulg").write_bytes(b"ofXA")
    assert fetch(flown, "A", tmp_path).sent_bytes > 0
    assert (folder / "px4/sess002/log100.ulg").read_bytes() == b"of A"
    assert flown[0].run("ls /var/tmp") == ""


def test_a_robot_without_the_trial_says_so(flown: FrailHosts, tmp_path: Path) -> None:
    done = lpac_fleet(
        flown.fleet_toml, "pull", "--trial", "Z", "--robots", "r1,r4", "--out", tmp_path
    )
    assert done.returncode == 1
    assert "it has no logs of trial 'Z'; it has 'A', 'B'" in done.stdout
    assert "a spare that never flew" in done.stdout
    assert "pulled from 1 of 2 robots; failed: r1" in done.stderr


def test_without_a_trial_comes_what_is_new(flown: FrailHosts, tmp_path: Path) -> None:
    host, folder = flown[0], tmp_path / "all" / "r1"
    first = fetch(flown, None, tmp_path)
    assert first.sent_bytes > 0
    assert {"logs/robot-1-0001.mcap", "logs/robot-1-0002.mcap", "px4/sess001/log100.ulg"} < names(
        folder
    )
    lines = next(folder.glob("journal-*.jsonl")).read_text().splitlines()
    assert any("Started" in json.loads(line)["MESSAGE"] for line in lines)
    write_logs(host.root / LOGS, 1, [("C", FIRST_S + 200.0)])
    try:
        done = lpac_fleet(flown.fleet_toml, "pull", "--robots", "r1", "--out", tmp_path, "--json")
        assert done.returncode == 0, done.stderr
        # The newest that was here is looked at again, since it might have grown.
        pulled = json.loads(done.stdout)["robots"]["r1"]
        assert "logs/robot-1-0003.mcap" in names(folder)
        assert pulled["files"] == 6
    finally:
        (host.root / LOGS / "robot-1-0003.mcap").unlink()


def test_a_cut_in_the_middle_is_made_up_for(flown: FrailHosts, tmp_path: Path) -> None:
    host = flown[0]
    big = os.urandom(BIG_BYTES)
    write_ulog(host, "sess009", FIRST_S + 11.0, big)
    folder = tmp_path / "A/r1/px4/sess009"

    def is_under_way() -> bool:
        # rsync's own file, as long as it is not whole.
        with contextlib.suppress(FileNotFoundError):
            return any(path.stat().st_size for path in folder.glob(".log100.ulg.*"))
        return False

    async def cut_in_the_middle() -> None:
        fetching = asyncio.create_task(pulled(flown, "A", tmp_path))
        while not is_under_way() and not fetching.done():
            await asyncio.sleep(0.005)
        host.cut()
        await fetching

    def is_cut_in_the_middle() -> bool:
        try:
            asyncio.run(cut_in_the_middle())
        except FleetError as error:
            assert "it does not answer" in str(error)
            return True
        finally:
            host.heal()
        (folder / "log100.ulg").unlink()
        return False

    try:
        # Where this machine is held up itself, all may have come before the cut.
        assert any(is_cut_in_the_middle() for _ in range(10))
        done = fetch(flown, "A", tmp_path)
        assert 0 < done.sent_bytes < BIG_BYTES
        assert (folder / "log100.ulg").read_bytes() == big
    finally:
        host.heal()
        host.run("rm -r /data/px4/log/sess009")


def test_a_log_that_grows_comes_as_far_as_it_is(flown: FrailHosts, tmp_path: Path) -> None:
    host = flown[0]
    host.run("systemctl start lpac-robot")
    log = host.root / LOGS / "robot-1-0003.mcap"
    try:
        began_bytes = log.stat().st_size
        host.run(
            f"until [ $(stat -c %s /{LOGS}/{log.name}) -gt {began_bytes} ]; do sleep 0.1; done"
        )
        done = fetch(flown, None, tmp_path)
        folder = Path(done.folder)
        assert next(read(folder / "logs" / log.name))
        subprocess.run(["sha256sum", "--check", "--quiet", "SHA256SUMS"], cwd=folder, check=True)
    finally:
        host.run("systemctl stop lpac-robot")
        log.unlink()


def test_another_file_of_the_same_name_takes_nobodys_place(
    flown: FrailHosts, tmp_path: Path
) -> None:
    """Once its logs are removed, or its board is flashed anew, a robot numbers from 1 again."""
    host = flown[0]
    logs, aside = host.root / LOGS, host.root / "var/tmp/aside"
    write_ulog(host, "sess003", FIRST_S + 112.0, b"of B")
    fetch(flown, None, tmp_path)
    folder = tmp_path / "all" / "r1"
    first = {name: (folder / name).read_bytes() for name in names(folder) if "journal" not in name}
    logs.rename(aside)
    try:
        logs.mkdir()
        write_logs(logs, 1, [("D", FIRST_S + 300.0)])
        write_ulog(host, "sess003", FIRST_S + 312.0, b"of B, continued")
        write_ulog(host, "sess002", FIRST_S + 311.0, b"of D")
        done = fetch(flown, None, tmp_path)
        assert done.summary == "complete; older files of the same names are in earlier-1"
        kept = {"logs/robot-1-0001.mcap", "px4/sess002/log100.ulg"}
        assert names(folder / "earlier-1") == kept
        for name in kept:
            assert (folder / "earlier-1" / name).read_bytes() == first[name]
            assert (folder / name).read_bytes() != first[name]
        assert (folder / "px4/sess003/log100.ulg").read_bytes() == b"of B, continued"
        subprocess.run(["sha256sum", "--check", "--quiet", "SHA256SUMS"], cwd=folder, check=True)
        # Nothing is kept twice.
        assert "earlier" not in fetch(flown, None, tmp_path).summary
    finally:
        host.run("rm -r /data/px4/log/sess002 /data/px4/log/sess003")
        shutil.rmtree(logs)
        aside.rename(logs)
        write_ulog(host, "sess002", FIRST_S + 12.0, b"of A")
        write_ulog(host, "sess003", FIRST_S + 112.0, b"of B")


def test_a_robot_in_flight_is_left_alone(flown: FrailHosts, tmp_path: Path) -> None:
    host = flown[0]
    with (
        armed(host),
        pytest.raises(FleetError, match="the vehicle is armed: pulling is refused"),
    ):
        fetch(flown, "A", tmp_path)
