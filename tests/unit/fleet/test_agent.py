"""The robot's agent, and what is asked of it, as far as that needs no robot and no root."""

import ast
import asyncio
import contextlib
import json
import stat
import time
from collections.abc import AsyncIterator, Callable, Coroutine, Mapping
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from edge.drivers.px4 import raw_mavlink
from lpac.fleet import agent, deploy, members, program, pull, setup, up
from lpac.fleet.agent import Refused, write_whole
from lpac.fleet.authority import create_authority
from lpac.fleet.hold import Held, earlier_than
from lpac.fleet.release import Image, Release, _entry
from lpac.fleet.session import Done, RemoteError
from lpac.fleet.settings import load_fleet
from tests.conftest import ROOT
from tests.local_session import LocalSession


@pytest.mark.parametrize(
    "path",
    [Path(str(module.__file__)) for module in (agent, raw_mavlink)],
    ids=lambda path: path.name,
)
def test_the_robots_python_3_6_can_read_it(path: Path) -> None:
    ast.parse(path.read_text(), feature_version=(3, 6))


def test_a_file_is_written_past_a_link_that_somebody_put_there(tmp_path: Path) -> None:
    others, path = tmp_path / "others", tmp_path / "key.pem"
    others.write_text("theirs")
    (tmp_path / "key.pem.part").symlink_to(others)
    write_whole(str(path), b"ours", 0o600)
    assert (path.read_text(), others.read_text()) == ("ours", "theirs")
    assert not path.is_symlink() and stat.S_IMODE(path.stat().st_mode) == 0o600


def make(folder: Path, files: dict[str, str]) -> None:
    """A folder with a manifest."""
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    (folder / "link").symlink_to("somewhere")
    entries = {
        str(path.relative_to(folder)): _entry(path, path.lstat())
        for path in folder.rglob("*")
        if path.is_symlink() or path.is_file()
    }
    (folder / "manifest.json").write_text(json.dumps({"files": entries}))


def make_spare(folder: Path) -> None:
    """Make the release one without a slot."""
    for name in ("robot.toml", "link", "manifest.json"):
        (folder / name).unlink()
    make(folder, {"world.env": ""})


def test_a_release_runs_only_if_every_file_is_what_the_manifest_says(tmp_path: Path) -> None:
    make(tmp_path, {"root/usr/bin/lpac": "run", "robot.toml": "a = 1"})
    agent.check(str(tmp_path))

    def refused(name: str) -> None:
        with pytest.raises(Refused, match=f"^{name} differs from the release: deploy again$"):
            agent.check(str(tmp_path))

    (tmp_path / "robot.toml").write_text("a = 2")
    refused("robot.toml")
    (tmp_path / "robot.toml").write_text("a = 1")
    (tmp_path / "robot.toml").chmod(0o777)
    refused("robot.toml")
    (tmp_path / "robot.toml").unlink()
    refused("robot.toml")
    (tmp_path / "robot.toml").write_text("a = 1")
    (tmp_path / "robot.toml").chmod(0o644)
    (tmp_path / "more").write_text("")
    refused("more")
    (tmp_path / "more").unlink()
    (tmp_path / "link").unlink()
    (tmp_path / "link").symlink_to("elsewhere")
    refused("link")
    (tmp_path / "manifest.json").write_text('{"files": {}}')
    refused("link")
    for torn in ("", '{"fil', "{}", "[]", '{"files": 1}'):
        (tmp_path / "manifest.json").write_text(torn)
        with pytest.raises(Refused, match=r"^manifest.json is damaged: deploy again$"):
            agent.check(str(tmp_path))


class Systemd:
    """Systemd as the agent sees it: what was done, and what its program says after a restart."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
        self.done: list[str] = []
        self.armed: Callable[[], bool] = lambda: False
        self.status: Callable[[], dict[str, Any]] = lambda: {}
        clock_s = [0.0]

        def run(command: list[str], timeout_s: float = 10.0) -> dict[str, Any]:
            if command[0] == "ln":
                Path(command[3]).symlink_to(command[2])
            elif command[0] == "systemctl":
                self.done.append(command[1])
            return {"code": 0, "out": "", "err": ""}

        def service() -> dict[str, Any]:
            clock_s[0] += 1.0
            restarts = self.done.count("restart")
            return {"active": "active", "fresh": True, "restarts": 0, "result": "",
                    "invocation": restarts, "status": self.status()}  # fmt: skip

        monkeypatch.setattr(agent, "run", run)
        monkeypatch.setattr(agent, "service", service)
        monkeypatch.setattr(agent, "armed", lambda _: self.armed())
        monkeypatch.setattr(agent, "_lock", [0])
        monkeypatch.setattr(agent, "_UNIT_PATH", f"{folder}/")
        monkeypatch.setattr(agent, "_sync", lambda *_: None)
        monkeypatch.setattr(agent, "_send", lambda _: None)
        monkeypatch.setattr("time.monotonic", lambda: clock_s[0])
        monkeypatch.setattr("time.sleep", lambda _: None)

    def well(self) -> dict[str, Any]:
        loops = {"control": {"failures": 0, "ticks": time.monotonic()}}
        return {"link": True, "boot_nonce": self.done.count("restart"), "loops": loops}


@pytest.fixture
def systemd(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Systemd:
    """Two releases, of which the first runs."""
    for name in ("1", "2"):
        make(tmp_path / "opt" / "releases" / name, {"robot.toml": ""})
    (tmp_path / "opt" / "current").symlink_to("releases/1")
    (tmp_path / "units").mkdir()
    found = Systemd(monkeypatch, tmp_path / "units")
    found.status = found.well
    return found


@pytest.mark.parametrize("spare", [False, True])
def test_a_vehicle_that_is_armed_during_a_switch_is_not_restarted(
    systemd: Systemd, tmp_path: Path, spare: bool
) -> None:
    folder = tmp_path / "opt"
    if spare:
        make_spare(folder / "releases" / "2")
    systemd.armed = lambda: "daemon-reload" in systemd.done
    with pytest.raises(Refused, match=r"armed meanwhile: nothing restarts .* switch is pending"):
        agent.switch(str(folder), "2", PORT)
    assert "interrupted; the vehicle was armed meanwhile" in str(agent._recover(str(folder), PORT))
    assert systemd.done == ["daemon-reload"] and (folder / "pending").exists()
    systemd.armed = lambda: False
    assert "was finished: the robot runs" in str(agent._recover(str(folder), PORT))
    assert agent.linked(str(folder)) == "2" and not (folder / "pending").exists()
    assert ("disable" if spare else "restart") in systemd.done


def test_a_release_that_is_not_whole_is_not_switched_to(systemd: Systemd, tmp_path: Path) -> None:
    folder = tmp_path / "opt"
    (folder / "releases" / "2" / "manifest.json").write_text("{")
    with pytest.raises(Refused, match=r"^manifest.json is damaged: deploy again$"):
        agent.switch(str(folder), "2", PORT)
    assert not systemd.done and not (folder / "pending").exists()


@pytest.mark.parametrize(
    "status", [{}, {"link": True}, {"link": True, "boot_nonce": 1, "loops": {"control": {}}}]
)
def test_a_program_whose_status_lacks_something_is_taken_back(
    systemd: Systemd, tmp_path: Path, status: dict[str, Any]
) -> None:
    folder = tmp_path / "opt"
    systemd.status = lambda: status if agent.linked(str(folder)) == "2" else systemd.well()
    with pytest.raises(Refused, match=r"its status cannot be read: .* the robot runs .* again"):
        agent.switch(str(folder), "2", PORT)
    assert agent.linked(str(folder)) == "1" and not (folder / "pending").exists()


def test_a_first_release_that_never_became_current_is_taken_back(
    systemd: Systemd, tmp_path: Path
) -> None:
    folder = tmp_path / "opt"
    (folder / "current").unlink()
    assert "first release" in agent._revert(str(folder), None, PORT)
    assert systemd.done == ["disable"]


@given(names=st.sets(st.integers(1, 9), max_size=6), current=st.integers(1, 9))
def test_a_rollback_goes_to_the_next_smaller_number(names: set[int], current: int) -> None:
    releases = {str(name): None for name in sorted(names, reverse=True)}
    older = [name for name in names if name < current]
    wanted = str(max(older)) if older and current in names else None
    assert earlier_than(str(current), releases) == wanted
    assert earlier_than(None, releases) is None


@given(st.binary(max_size=300))
@example(bytes(8))
def test_no_datagram_breaks_the_listener(data: bytes) -> None:
    agent.datagram(data, 14551)
    agent.datagram(b"\x45" + data, 14551)


@pytest.mark.parametrize(
    ("status", "heard", "armed"),
    [
        ({"armed": True, "autopilot": True}, False, True),
        ({"armed": False, "autopilot": True}, True, False),
        # The program's last word from before it lost the vehicle.
        ({"armed": True, "autopilot": False}, False, False),
        ({"armed": True, "autopilot": False}, None, True),
        ({"armed": False, "autopilot": False}, True, True),
        ({"armed": None, "autopilot": False}, True, True),
        (None, True, True),
    ],
)
def test_the_programs_word_counts_while_it_has_the_vehicle(
    status: dict[str, bool | None] | None,
    heard: bool | None,
    armed: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    heartbeat = None if heard is None else {"armed": heard}
    monkeypatch.setattr(agent, "receive_heartbeat", lambda _: {"heartbeat": heartbeat})
    for active in ("active", "reloading", "deactivating"):
        state = {"active": active, "status": status}
        monkeypatch.setattr(agent, "service", lambda state=state: state)
        assert agent.armed(14551) is armed
    # What a program said that has ended is no word of now.
    monkeypatch.setattr(agent, "service", lambda: {"active": "failed", "status": status})
    assert agent.armed(14551) is bool(heard)


CONFIG = load_fleet(ROOT / "docs" / "fleet.toml")
R1 = CONFIG.robots["r1"]
PORT = R1.mavlink_port
RUNNING = "Id=old.service\nLoadState=loaded\nActiveState=active\nUnitFileState=enabled\n"


class Robot(LocalSession):
    """Runs nothing; what it was asked to change is kept."""

    def __init__(self, out: str = "{}") -> None:
        self.out = out
        self.changed: list[object] = []

    async def run(self, *command: str, timeout_s: float = 60.0) -> Done:
        if command[:2] == ("systemctl", "show"):
            return Done(0, RUNNING, "")
        if command[0] not in ("cat", "date", "test"):
            self.changed.append(command)
        return Done(0, self.out, "")

    async def write(self, files: Mapping[str, bytes], mode: int = 0o644) -> None:
        self.changed += files

    async def capture(self, commands: Mapping[str, str], *, each_s: float = 5.0) -> dict[str, str]:
        return dict.fromkeys(commands, RUNNING)


FOUND: dict[str, Any] = {
    "machine": "aarch64", "current": None, "number": "2", "earlier": "b", "pending": None,
    "service": {"fresh": False, "active": "active"}, "releases": {"2": {}, "1": {}},
}  # fmt: skip
IMAGE = Image(Path(), "i", "aarch64", {}, {}, 1)
GROUNDED: tuple[Callable[[Robot], Coroutine[Any, Any, object]], ...] = (
    lambda robot: deploy.deploy(CONFIG, R1, Release("a", 1, IMAGE, Path(), 1), unwatched),
    lambda robot: deploy.rollback(CONFIG, R1, unwatched),
    lambda robot: pull.pull(CONFIG, R1, "A", Path(), unwatched),
    lambda robot: setup.set_vision_hub(robot, R1),
    lambda robot: setup.stop_predecessors(robot, R1, ["old"], lambda _: None),
    lambda robot: setup.set_up_px4(robot, CONFIG, R1, lambda _: None),
    lambda robot: program.stop(robot, R1, in_flight=False, disable=False),
    lambda robot: up.set_clock(robot, R1, 0.0),
)


def unwatched(_: str, __: float | None) -> None:
    """A report that nobody reads."""


@pytest.mark.parametrize("ask", GROUNDED)
def test_a_robot_in_flight_is_left_as_it_is(
    monkeypatch: pytest.MonkeyPatch, ask: Callable[[Robot], Coroutine[Any, Any, object]]
) -> None:
    robot = Robot()

    @contextlib.asynccontextmanager
    async def held(*_: object) -> AsyncIterator[Held]:
        yield Held(robot, FOUND, None)

    @contextlib.asynccontextmanager
    async def visited(*_: object) -> AsyncIterator[tuple[Robot, object]]:
        yield robot, FOUND

    monkeypatch.setattr(agent, "armed", lambda _: True)
    monkeypatch.setattr(deploy, "hold", held)
    monkeypatch.setattr(pull, "visit", visited)
    with pytest.raises(RemoteError, match="the vehicle is armed"):
        asyncio.run(ask(robot))
    assert not robot.changed


def test_a_robot_that_flies_or_is_not_held_keeps_what_it_has(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    folder = tmp_path / "opt"
    make(folder / "releases" / "1", {"robot.toml": ""})
    authority = create_authority(tmp_path / "keys", CONFIG.fleet)

    def refused(why: str) -> None:
        robot = Robot()
        with pytest.raises(Refused, match=why):
            agent.switch(str(folder), "1", PORT)
        for fresh in (False, True):
            with pytest.raises(RemoteError, match=why):
                asyncio.run(members._admit(robot, authority, R1, fresh=fresh))
        assert not robot.changed and not authority.members.members
        assert [path.name for path in folder.iterdir()] == ["releases"]

    refused("lock was not called")
    monkeypatch.setattr(agent, "armed", lambda _: True)
    monkeypatch.setattr(agent, "_lock", [0])
    refused("the vehicle is armed")


@pytest.mark.parametrize(
    ("at", "problem", "known_s"),
    [
        (lambda s: {}, None, 2.0),
        (lambda s: {"failures": int(s > 1.0)}, "its control loop fails", 40.25),
        (lambda s: {"ticks": 5}, "its control loop does not tick", 40.25),
        (lambda s: {"link": False}, "the radio link is not open", 40.25),
        (lambda s: {"fresh": False}, "the program reports no status", 40.25),
        (lambda s: {"active": "failed"}, "the unit is failed", 0.0),
        # One restart is no fault, if it is well then; again and again it is.
        (lambda s: {"nonce": int(s >= 1.0), "restarts": int(s >= 1.0)}, None, 3.0),
        (lambda s: {"nonce": int(s), "restarts": int(s)}, "its control loop does not tick", 2.0),
    ],
)
def test_a_program_is_well_once_its_loops_have_ticked_for_a_while(
    monkeypatch: pytest.MonkeyPatch,
    at: Callable[[float], dict[str, Any]],
    problem: str | None,
    known_s: float,
) -> None:
    clock_s = [0.0]

    def state() -> dict[str, Any]:
        usual = {"failures": 0, "ticks": clock_s[0], "link": True, "fresh": True,
                 "active": "active", "nonce": 0, "restarts": 0}  # fmt: skip
        now = usual | at(clock_s[0])
        loop = {"failures": now["failures"], "ticks": now["ticks"]}
        status = {"link": now["link"], "boot_nonce": now["nonce"], "loops": {"control": loop}}
        return {key: now[key] for key in ("active", "fresh", "restarts")} | {
            "result": "", "status": status
        }  # fmt: skip

    def sleep(duration_s: float) -> None:
        clock_s[0] += duration_s

    monkeypatch.setattr(agent, "service", state)
    monkeypatch.setattr(agent, "last_words", lambda: {"text": "see the logs"})
    monkeypatch.setattr("time.monotonic", lambda: clock_s[0])
    monkeypatch.setattr("time.sleep", sleep)
    if problem is None:
        agent.health()
    else:
        with pytest.raises(Refused, match=f"^{problem}"):
            agent.health()
    assert clock_s[0] == known_s


def test_a_container_engine_that_is_silent_keeps_nobody_from_being_enrolled(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Silent(Robot):
        async def capture(
            self, commands: Mapping[str, str], *, each_s: float = 5.0
        ) -> dict[str, str]:
            return dict.fromkeys(commands, "")

    monkeypatch.setattr(f"{__name__}.RUNNING", "Id=old.service\nLoadState=not-found\n")
    step = asyncio.run(setup.stop_predecessors(Silent(), R1, ["old_stack"], lambda _: None))
    assert step.outcome == "left to do"
    assert "docker does not answer" in step.notes[0]
    # Systemd could start what is taken for stopped.
    monkeypatch.setattr(f"{__name__}.RUNNING", "")
    with pytest.raises(RemoteError, match="systemd reports nothing about unit old_stack"):
        asyncio.run(setup.stop_predecessors(Silent(), R1, ["old_stack"], lambda _: None))


def test_no_release_is_removed_while_the_current_one_is_not_known() -> None:
    robot, release = Robot(), Release("a", 1, IMAGE, Path(), 1)
    found = FOUND | {"number": None}
    with pytest.raises(RemoteError, match="its current release cannot be read"):
        asyncio.run(deploy._make_room(robot, CONFIG, release, found, "/opt/lpac/incoming/a"))
    assert not robot.changed


def test_a_program_that_could_not_start_again_is_not_stopped_for_px4(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def damaged(folder: str) -> dict[str, Any]:
        raise Refused(f"{folder} differs from the release: deploy again")

    robot = Robot()
    monkeypatch.setattr(agent, "armed", lambda _: False)
    monkeypatch.setitem(agent._CALLS, "check", damaged)
    monkeypatch.setitem(agent._CALLS, "service", lambda: {"active": "active"})
    with pytest.raises(RemoteError, match="differs from the release"):
        asyncio.run(setup.set_up_px4(robot, CONFIG, R1, lambda _: None))
    assert not robot.changed


@pytest.mark.parametrize(("failures", "is_proven"), [(0, True), (1, True), (2, False)])
def test_a_benchmark_that_something_else_disturbed_is_run_again(
    failures: int, is_proven: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = [failures]
    release = Release("a" * 16, 1, IMAGE, Path(), 1)

    async def inside(_: object, __: str, *command: str) -> Done:
        fails = "benchmark" in command and left[0] > 0
        left[0] -= fails
        return Done(int(fails), '{"steps": {"infer": 1}}', "lpac: too slow")

    monkeypatch.setattr(deploy, "lpac_inside", inside)
    monkeypatch.setitem(agent._CALLS, "check", lambda folder: {})
    proof = deploy._prove(Robot(out="a" * 64), release, "/incoming", unwatched)
    if is_proven:
        assert asyncio.run(proof) == {"infer": 1}
    else:
        with pytest.raises(RemoteError, match="too slow"):
            asyncio.run(proof)


@pytest.mark.parametrize(
    ("active", "age_s", "fresh"),
    [
        ("active", 0.5, True),
        ("active", 3.0, False),
        ("active", -2.0, False),
        ("active", None, False),
        ("failed", 0.5, False),
    ],
)
def test_a_programs_word_is_fresh_while_it_runs(
    monkeypatch: pytest.MonkeyPatch, active: str, age_s: float | None, fresh: bool
) -> None:
    told = "" if age_s is None else json.dumps({"monotonic_s": 100.0 - age_s})
    shown = f"ActiveState={active}\nStatusText={told}\nNRestarts=2\nUnitFileState=enabled\n"
    monkeypatch.setattr(agent, "check_output", lambda *_: shown)
    monkeypatch.setattr("time.monotonic", lambda: 100.0)
    state = agent.service()
    assert (state["fresh"], state["active"]) == (fresh, active)
    assert (state["restarts"], state["enabled"]) == (2, True)


def test_a_datagram_is_for_the_port_that_it_is_sent_to() -> None:
    header = bytes([0x45, *bytes(8), 17, *bytes(2), 127, 0, 0, 1, *bytes(4)])
    packet = header + (14580).to_bytes(2) + (14551).to_bytes(2) + bytes(4) + b"beat"
    sender = ("127.0.0.1", 14580)
    assert agent.datagram(packet, 14551) == (sender, b"beat")
    assert agent.datagram(packet, 14580)[1] == b""
    assert agent.datagram(packet.replace(b"\x11", b"\x06", 1), 14551)[1] == b""
