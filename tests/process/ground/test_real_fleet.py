"""Real robot programs and a real ground process: what becomes of commands when things fail.

All tests have one fleet; each starts and leaves it on the ground, and has ground processes of its
own.
"""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from edge.flight.margins import ErrorBudget
from edge.messages.codes import ReasonCode, RefusalCode
from edge.messages.mission import ON_GROUND, FlightState, RobotStatus, world_id
from lpac.analysis.snapshot import FleetSnapshot
from lpac.analysis.worlds import format_world
from lpac.ground.station.client import GroundError, command, subscribe
from lpac.ground.station.protocol import (
    CommandReport,
    Enable,
    ProblemCode,
    Request,
    ResultCode,
    Resume,
    SafetyCommand,
    SetFence,
    SetOrigin,
    SetWorld,
    Start,
    Takeoff,
)
from lpac.sim.fleet.layout import ORIGIN
from lpac.sim.fleet.processes import Fleet
from lpac.sim.scenario import Scenario
from tests.conftest import ROOT, SHIPPED
from tests.needs import missing
from tests.process.ground.browser import MOST_TRIES, live_map, opened
from tests.said import problem

pytestmark = pytest.mark.real_time

_S = FlightState
# For other computers too.
OPEN = 'insecure = true\nlisten = ["tcp/0.0.0.0:'
NAMES = ("r0", "r1")
PATIENCE_S = 90.0
PATIENT = ErrorBudget(takeoffs_height_m=3.0)
# Of a command that is given again: nothing is wrong, and a robot was out of reach or not ready yet.
NOT_YET = (
    ResultCode.NOT_HEARD, ResultCode.NOT_OBEYING, ResultCode.NOT_READY, RefusalCode.NOT_ANSWERED,
    RefusalCode.NOT_READY, RefusalCode.CHECKS_RUNNING,
)  # fmt: skip
# Of robots that heard no ground for a while: in flight, before takeoff, and about to take off.
GROUND_WAS_LOST = (
    ReasonCode.GROUND_LOST, ReasonCode.NOT_ENABLED, ReasonCode.ARMING_CALLED_OFF,
)  # fmt: skip


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fleet]:
    """Robots that can also be reached from another network, and land quickly.

    They wait for another ground for as long as one may take to start on a busy machine. Over a link
    that loses much a takeoff is ordered again late: so they may take off within five minutes, which
    asks for heights further apart.
    """
    scenario = Scenario(robots=len(NAMES), budget=PATIENT)
    made = Fleet(scenario, tmp_path_factory.mktemp("fleet"), SHIPPED)
    assert made.simulated is not None
    for vehicle in made.simulated.vehicles:
        vehicle.parameters |= {
            "COM_SPOOLUP_TIME": 0.0, "MPC_TKO_RAMP_T": 0.0, "MPC_LAND_SPEED": 1.5,
            "COM_DISARM_LAND": 0.5,
        }  # fmt: skip
    for robot in made.robots:
        path = robot.folder / "robot.toml"
        text = path.read_text().replace('listen = ["tcp/127.0.0.1:', OPEN)
        path.write_text(text.replace("[flight]\n", "[flight]\nground_lost_land_s = 30.0\n"))
    with made:
        found_all = made.listener.wait_for(
            lambda statuses: [s.state for s in statuses.values()] == [_S.IDLE] * len(NAMES),
            PATIENCE_S,
        )
        assert found_all, made.listener.statuses()
        yield made


def statuses_of_all(fleet: Fleet) -> dict[int, RobotStatus]:
    """The newest of each robot, once all are heard."""
    heard: dict[int, RobotStatus] = {}

    def all_heard(statuses: Mapping[int, RobotStatus]) -> bool:
        heard.update(statuses)
        return len(statuses) == len(NAMES)

    assert fleet.listener.wait_for(all_heard, PATIENCE_S)
    return heard


class Ground:
    """`lpac ground` as a process, and a client of it."""

    def __init__(self, fleet: Fleet, fleet_toml: Path, enter: Sequence[str] = ()) -> None:
        self.fleet = fleet.name
        self._heard = fleet.listener
        self._log = fleet_toml.with_suffix(".log")
        with self._log.open("ab") as output:
            self.process = subprocess.Popen(
                [*enter, sys.executable, "-m", "lpac.cli.main", "ground", "--fleet",
                str(fleet_toml)],
                env={**os.environ, "PYTHONPATH": str(ROOT)},
                stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT,
            )  # fmt: skip

    def said(self) -> str:
        """What it has printed."""
        return self._log.read_text()

    def snapshots(self, timeout_s: float = PATIENCE_S) -> Iterator[FleetSnapshot]:
        """What it shows, from its start on; it must not end meanwhile."""
        until_s = time.monotonic() + timeout_s
        while time.monotonic() < until_s:
            try:
                with subscribe(self.fleet) as told:
                    for message in told:
                        if isinstance(message, FleetSnapshot):
                            yield message
                        if time.monotonic() > until_s:
                            return
            except GroundError:
                # It is not open yet, and nothing tells when it is.
                assert self.process.poll() is None, self.said()
                time.sleep(0.05)

    def wait(self, condition: Callable[[FleetSnapshot], bool]) -> FleetSnapshot:
        """Until it shows a fleet that is so."""
        snapshot = None
        for snapshot in self.snapshots():
            if condition(snapshot):
                return snapshot
        raise AssertionError((snapshot, self.said()))

    def wait_states(self, *states: FlightState) -> FleetSnapshot:
        """Until every robot is in one of these states."""
        return self.wait(lambda p: all(r.status and r.status.state in states for r in p.robots))

    def ask(self, request: Request) -> CommandReport:
        """Command something, once the ground hears all robots."""
        self.wait(lambda snapshot: all(robot.fresh for robot in snapshot.robots))
        return command(self.fleet, request)

    def do(self, request: Request) -> None:
        """Command something; all robots must do it."""
        report = self.ask(request)
        assert report.done, report

    def do_in_the_end(self, request: Request) -> None:
        """Command something, again if a command's time was too short for a robot."""
        for _ in range(MOST_TRIES):
            began_s = time.monotonic()
            report = self.ask(request)
            if report.done:
                return
            self.must_be_out_of_reach(report, began_s)
            print(f"again, since {refusals(report)}: {request}")
        raise AssertionError(report)

    def must_be_out_of_reach(self, report: CommandReport, since_s: float) -> None:
        """Nothing is wrong with those that did not do it: they did not hear the ground."""
        assert report.problem is None and report.results, report
        for result in report.results:
            heard = self._heard.history(NAMES.index(result.robot))
            # A robot that hears the ground again soon has another reason by now.
            lost = any(h.status.reason.code in GROUND_WAS_LOST for h in heard if h.at_s >= since_s)
            why = result.refusal or result.code
            assert result.done or lost or why in NOT_YET, report

    def make_ready(self) -> None:
        """Origin, enable, and the robots' checks; the last test's landing is over."""
        self.wait_states(_S.IDLE, _S.PREFLIGHT, _S.LANDED)
        self.do(SetOrigin(ORIGIN))
        self.do(Resume())
        self.do_in_the_end(Enable())
        self.wait(lambda p: all(r.status and r.status.ready for r in p.robots))

    def kill(self) -> None:
        """As a dead battery does it."""
        self.process.kill()
        self.process.wait()


@contextmanager
def run_ground(
    fleet: Fleet, fleet_toml: Path | None = None, enter: Sequence[str] = ()
) -> Iterator[Ground]:
    """A ground process in the fleet's network, or in one that `enter` enters."""
    ground = Ground(fleet, fleet_toml or fleet.fleet_toml, enter)
    try:
        yield ground
        if ground.process.poll() is None:
            ground.process.send_signal(signal.SIGINT)
            assert ground.process.wait(PATIENCE_S) == 0, ground.said()
            assert "Traceback" not in ground.said()
    finally:
        ground.kill()


def refusals(report: CommandReport) -> str:
    """Why a command was not done: one text."""
    assert not report.done
    problem = "" if report.problem is None else report.problem.text
    return " ".join([problem, *(r.text for r in report.results if not r.done)])


def test_nobody_takes_off_before_the_origin_is_set(fleet: Fleet) -> None:
    with run_ground(fleet) as ground:
        assert problem(ground.ask(Takeoff())) is ProblemCode.NO_ORIGIN
        ground.wait_states(*ON_GROUND)


def test_commands_under_another_fleets_name_reach_nobody(fleet: Fleet, tmp_path: Path) -> None:
    text = fleet.fleet_toml.read_text()
    other_toml = tmp_path / "fleet.toml"
    other = f"{fleet.name}-not"
    other_toml.write_text(
        text.replace(f'"{fleet.name}"', f'"{other}"').replace(
            '"world.env"', f'"{fleet.folder / "world.env"}"'
        )
    )
    before = {robot: status.operator for robot, status in statuses_of_all(fleet).items()}
    with run_ground(fleet, other_toml) as ground:
        ground.fleet = other
        ground.wait(lambda _: True)
        for request in (SetOrigin(ORIGIN), Enable(), Takeoff()):
            assert not command(other, request).done
        assert all(robot.status is None for robot in ground.wait(lambda _: True).robots)
    statuses = statuses_of_all(fleet)
    assert {robot: status.operator for robot, status in statuses.items()} == before
    assert {status.state for status in statuses.values()} <= {*ON_GROUND}


def test_a_robot_that_starts_later_is_told_origin_fence_and_world(fleet: Fleet) -> None:
    world = format_world(fleet.layout.features or ()) + "CircularBND 100 100 20 5\n"
    with run_ground(fleet) as ground:
        setup_fence = fleet.layout.fence
        fence = type(setup_fence)(
            vertices_m=((-1.0, -1.0), (33.0, -1.0), (33.0, 33.0), (-1.0, 33.0)),
            buffer_m=1.4, floor_m=setup_fence.floor_m, ceiling_m=setup_fence.ceiling_m,
        )  # fmt: skip
        ground.do(SetOrigin(ORIGIN))
        ground.do(SetFence(fence))
        ground.do(SetWorld(world, "changed.env"))

        def told(robot: int) -> bool:
            status = fleet.listener.statuses().get(robot)
            return (
                status is not None
                and (status.origin, status.fence, status.world_id)
                == (ORIGIN, fence, world_id(world))
            )  # fmt: skip

        assert fleet.listener.wait_for(lambda _: told(0) and told(1), PATIENCE_S)
        before = fleet.listener.history(1)[-1].status.boot_nonce
        fleet.robots[1].send_signal(signal.SIGKILL)
        fleet.robots[1].wait(PATIENCE_S)
        fleet.robots[1].start()

        def heard_again(_: object) -> bool:
            return fleet.listener.history(1)[-1].status.boot_nonce != before

        assert fleet.listener.wait_for(heard_again, PATIENCE_S)
        began_s = time.monotonic()
        assert fleet.listener.wait_for(lambda _: told(1), PATIENCE_S), fleet.listener.statuses()
        print(f"a robot that starts knows all {time.monotonic() - began_s:.2f} s after its radio")
        ground.do(SetFence(None))


def test_a_page_flies_the_fleet(fleet: Fleet, tmp_path: Path) -> None:
    """Take off, start, hold and land are clicked in a real browser."""
    with run_ground(fleet) as ground:
        ground.make_ready()
        snapshot = tmp_path / "map.png"
        with (
            live_map(fleet.fleet_toml, "--operate") as address,
            opened(address) as seen,
        ):
            for action, state in (
                ("takeoff", _S.HOLD), ("start", _S.MISSION), ("hold", _S.HOLD),
                ("land", _S.LANDED),
            ):  # fmt: skip
                # The browser may keep a busy machine's robots from being ready for a moment.
                seen.act_in_the_end(action, sure=action in ("takeoff", "land"))
                seen.wait_for_states(dict.fromkeys(NAMES, state.value))
                if action == "start":
                    seen.screenshot(snapshot)
            assert seen.errors == []
        assert snapshot.stat().st_size > 20_000


def test_a_lossy_link_and_then_a_new_ground_in_flight(fleet: Fleet, tmp_path: Path) -> None:
    """Every command arrives through a link that loses 30 % each way; then its ground dies.

    TCP doubles its pause at every retransmission that is lost, too: now and then a link says
    nothing for longer than commands wait.
    """
    with lossy_network() as (enter, address):
        far_toml = fleet.folder / "far.toml"
        text = fleet.fleet_toml.read_text()
        text = text.replace('address = "127.0.0.1"', f'address = "{address}"')
        far_toml.write_text(f"insecure = true\n{text}")
        with run_ground(fleet, far_toml, enter) as ground:
            for request in (
                SetOrigin(ORIGIN), Resume(), Enable(), Takeoff(interval_s=0.5), Start(),
                SafetyCommand("hold"), Resume(),
            ):  # fmt: skip
                ground.do_in_the_end(request)
            trial = ground.wait_states(_S.MISSION, _S.HOLD).ground
            assert trial is not None
            ground.kill()
    began_s = time.monotonic()
    with run_ground(fleet) as ground:
        snapshot = ground.wait(lambda p: p.ground is not None and all(r.fresh for r in p.robots))
        print(f"a new ground knows all {time.monotonic() - began_s:.2f} s after its start")
        assert snapshot.ground is not None
        assert (snapshot.ground.origin, snapshot.ground.trial) == (ORIGIN, trial.trial)
        # Robots that heard no ground for too long hold, and no longer.
        ground.wait_states(_S.MISSION, _S.HOLD)
        world = SetWorld("CircularBND 100 100 20 5\n", "other.env")
        assert problem(ground.ask(world)) is ProblemCode.ARMED
        ground.do(SafetyCommand("land", wait=True))


def test_a_ground_that_dies_while_robots_take_off(fleet: Fleet) -> None:
    """Robots in the air hold, and land after a while; no other takes off."""
    with run_ground(fleet) as ground:
        ground.make_ready()
        asked = threading.Thread(target=ask_until_it_dies, args=(ground, Takeoff(interval_s=60.0)))
        began_s = time.monotonic()
        asked.start()
        # The highest goes first.
        wait_for_states(fleet, 1, began_s, _S.TAKEOFF)
        ground.kill()
        asked.join()
        wait_for_states(fleet, 1, began_s, _S.TAKEOFF, _S.HOLD, _S.LAND, _S.LANDED)
    waiting = {h.status.state for h in fleet.listener.history(0) if h.at_s >= began_s}
    assert waiting <= {*ON_GROUND}


def wait_for_states(fleet: Fleet, robot: int, since_s: float, *states: FlightState) -> None:
    """Until a robot has been in all of these, one after another, whoever commands."""

    def said() -> list[FlightState]:
        return [h.status.state for h in fleet.listener.history(robot) if h.at_s >= since_s]

    def been(_: object) -> bool:
        later = iter(said())
        return all(state in later for state in states)

    assert fleet.listener.wait_for(been, PATIENCE_S), said()[-1:]


def ask_until_it_dies(ground: Ground, request: Request) -> None:
    with suppress(GroundError):
        command(ground.fleet, request)


@contextmanager
def lossy_network() -> Iterator[tuple[list[str], str]]:
    """A network that loses 30 % of the packets from and to this one.

    Yields what enters it, and this machine's address there.
    """
    if lacks := missing("ip", "iptables", root=True):
        pytest.skip(lacks)
    pid = os.getpid()
    name, here = f"lpac-{pid}", f"lp{pid}"
    # The range for tests of networks, four addresses for each process.
    host = 4 * (pid % (1 << 14))
    this, that = (f"198.18.{host >> 8}.{(host & 255) + i}" for i in (1, 2))
    enter = ["ip", "netns", "exec", name]
    lose = ["-m", "statistic", "--mode", "random", "--probability", "0.3", "-j", "DROP"]
    run("ip", "netns", "add", name)
    try:
        run("ip", "link", "add", here, "type", "veth", "peer", "name", "air", "netns", name)
        run("ip", "address", "add", f"{this}/30", "dev", here)
        run("ip", "link", "set", here, "up")
        run("ip", "-n", name, "address", "add", f"{that}/30", "dev", "air")
        for device in ("air", "lo"):
            run("ip", "-n", name, "link", "set", device, "up")
        run(*enter, "iptables", "-A", "INPUT", "-i", "air", *lose)
        run(*enter, "iptables", "-A", "OUTPUT", "-o", "air", *lose)
        yield enter, this
    finally:
        run("ip", "netns", "del", name)


def run(*command_line: str) -> None:
    done = subprocess.run(command_line, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"{' '.join(command_line)}: {done.stderr.strip()}")
