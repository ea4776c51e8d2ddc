"""Unauthorised senders do not fly the fleet: real programs and radio, judged by true positions.

Two robots and their ground fly with keys of their own; whoever attacks has what an outsider has,
or another fleet's keys, or those of a stolen robot.
"""

import secrets
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import zenoh

from bench.flood import certified, unruly_session
from edge.drivers.identity_folder import Identity, load_identity
from edge.drivers.zenoh_link import ZenohLink
from edge.identity.guard import SignedGuard
from edge.identity.members import Role
from edge.messages.codec import encode
from edge.messages.codes import ReasonCode
from edge.messages.mission import FlightState, GroundState, Order, RobotStatus
from edge.messages.topics import HOLD, ORDER, STATE, STATUS, TOPICS, Topic
from lpac.fleet.authority import Authority, create_authority, new_member
from lpac.ground.station.protocol import Resume, RobotCommand, SafetyCommand
from lpac.sim.fleet.ground import GroundProgram
from lpac.sim.fleet.keys import give_list
from lpac.sim.fleet.processes import Fleet
from lpac.sim.px4.modes import Px4Mode
from lpac.sim.scenario import Scenario
from tests.command import error_line, lpac
from tests.conftest import SHIPPED
from tests.flown import QUICK
from tests.process.sim.fleet_rig import FleetRig, flies_on

pytestmark = pytest.mark.real_time

ROBOTS = range(2)
STOLEN = 1
# A TLS record that promises more than comes: the first bytes of a ClientHello.
HALF_A_HELLO = bytes.fromhex("1603010200010001fc0303")
_S = FlightState
Repeated = Callable[[Callable[[], None]], None]


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FleetRig]:
    """A fleet with keys, in its mission."""
    scenario = Scenario(robots=len(ROBOTS), secure=True)
    fleet = Fleet(scenario, tmp_path_factory.mktemp("secure"), SHIPPED)
    assert fleet.simulated is not None
    for vehicle in fleet.simulated.vehicles:
        vehicle.parameters |= QUICK
    with fleet, GroundProgram(fleet.fleet_toml, fleet.name) as ground:
        rig = FleetRig(fleet, ground)
        rig.assemble()
        rig.make_ready()
        rig.take_off()
        rig.start()
        yield rig


def attack(rig: FleetRig, session: zenoh.Session, seal: Callable[[Topic, bytes], bytes]) -> None:
    """In the operator's name, and a robot's: states that land all, kills, and false statuses."""
    prefix = f"lpac/{rig.fleet.name}/"
    state = rig.ground.subscriber.snapshot.ground
    assert state is not None
    lands = GroundState(
        **{
            **{name: getattr(state, name) for name in GroundState.__dataclass_fields__},
            "sequence": state.sequence + 100,
            "safety_action": "land",
        }
    )
    for robot in ROBOTS:
        status = rig.status(robot)
        kill = Order(
            order_id=secrets.token_hex(6),
            robot_id=robot,
            boot_nonce=status.boot_nonce,
            kind="kill",
            expires_at_uptime_s=status.uptime_s + 5.0,
            operator=status.operator,
        )
        for data in (encode(kill), seal(ORDER, encode(kill))):
            session.put(f"{prefix}ground/order", data)
        for data in (encode(status), seal(STATUS, encode(status))):
            session.put(f"{prefix}robot/{robot}/status", data)
    for data in (encode(lands), seal(STATE, encode(lands))):
        session.put(f"{prefix}ground/state", data)


@pytest.fixture
def nothing_comes_of(rig: FleetRig, pytestconfig: pytest.Config) -> Repeated:
    """Repeat an attack while the robots fly, and check that all go on with their mission."""

    def is_done(once: Callable[[], None]) -> None:
        rig.start()
        sequence = rig.status(0).obeyed_sequence
        for _ in range(rounds(pytestconfig, 8)):
            once()
            # Long enough for something to come of it.
            rig.wait_status(0, partial(_is_later, rig.status(0).sequence))
        for robot in ROBOTS:
            vehicle, status = rig.vehicle(robot), rig.status(robot)
            assert vehicle.armed and not vehicle.landed
            assert flies_on(status), (robot, status.state, status.reason)
            assert (status.operator, status.obeyed_sequence) == ("sim", sequence)
        snapshot = rig.ground.subscriber.snapshot
        assert rig.ground.running and snapshot.commander == "sim"
        assert all(robot.fresh and not robot.duplicate for robot in snapshot.robots)

    return is_done


def _is_later(sequence: int, status: RobotStatus) -> bool:
    return status.sequence > sequence


def as_it_is(_: Topic, data: bytes) -> bytes:
    return data


def test_without_a_key_nobody_gets_in(rig: FleetRig, nothing_comes_of: Repeated) -> None:
    keys = rig.fleet.folder / "keys"
    one_sided = {
        "root_ca_certificate": str(keys / "authority.pem"), "enable_mtls": False,
        "verify_name_on_connect": False,
        "listen_private_key": str(keys / "key.pem"),
        "listen_certificate": str(keys / "certificate.pem"),
    }  # fmt: skip
    with (
        unruly_session(rig.fleet.endpoints, None) as plain,
        unruly_session(rig.fleet.endpoints, one_sided) as nameless,
    ):

        def once() -> None:
            for opened in (plain, nameless):
                attack(rig, opened, as_it_is)

        nothing_comes_of(once)
        assert not plain.info.peers_zid() and not nameless.info.peers_zid()


def test_another_fleet_of_the_same_name_does_not_meet_this_one(
    rig: FleetRig, nothing_comes_of: Repeated, tmp_path: Path
) -> None:
    authority = create_authority(tmp_path / "keys", rig.fleet.name)
    new_member(authority, tmp_path / "keys", Role.OPERATOR, "sim")
    other = load_identity(tmp_path / "keys", fleet=rig.fleet.name, unix_s=2e9)
    heard = threading.Event()
    with (
        ZenohLink(
            fleet=rig.fleet.name,
            connect=rig.fleet.endpoints,
            tls=other.tls,
            subscriptions={STATUS: lambda *_: heard.set()},
        ) as link,
        unruly_session(rig.fleet.endpoints, certified(other.tls)) as opened,
    ):
        guard = SignedGuard(other.membership, lambda: 0.0)
        nothing_comes_of(lambda: attack(rig, opened, guard.seal))
        assert link.peers() == 0 and not opened.info.peers_zid()
    assert not heard.is_set()


@pytest.mark.parametrize("mode", ["peer", "router"])
def test_a_stolen_robots_key_commands_nobody(
    rig: FleetRig, nothing_comes_of: Repeated, mode: str
) -> None:
    """Nor do the operator's own messages, said again by whoever has heard them, or routes them."""
    stolen = stolen_identity(rig)
    # It does not speak as itself here: then the others would take it for that robot's next start.
    guard = SignedGuard(stolen.membership, lambda: 0.0)
    recorded: dict[str, bytes] = {}
    prefix = f"lpac/{rig.fleet.name}/"
    with unruly_session(rig.fleet.endpoints, certified(stolen.tls), mode) as opened:
        for topic in TOPICS:
            opened.declare_subscriber(
                prefix + topic.pattern,
                lambda sample: recorded.update({str(sample.key_expr): sample.payload.to_bytes()}),
            )

        def seal(topic: Topic, data: bytes) -> bytes:
            return data if topic is STATUS else guard.seal(topic, data)

        def once() -> None:
            attack(rig, opened, seal)
            for key, data in dict(recorded).items():
                if not key.startswith(f"{prefix}robot/{STOLEN}/"):
                    opened.put(key, data)

        nothing_comes_of(once)
        # It was in, and heard what members hear.
        if mode == "peer":
            assert len(opened.info.peers_zid()) >= len(ROBOTS)
        assert f"{prefix}ground/state" in recorded


def stolen_identity(rig: FleetRig) -> Identity:
    folder = rig.fleet.robots[STOLEN].folder / "identity"
    return load_identity(folder, fleet=rig.fleet.name, unix_s=1.0)


def test_half_open_connections_hold_nobody_up(rig: FleetRig, nothing_comes_of: Repeated) -> None:
    """Those that say nothing, and those that begin with TLS and do not go on."""
    places = [e.removeprefix("tls/").rsplit(":", 1) for e in rig.fleet.endpoints]
    with ExitStack() as stack:
        for i in range(300):
            host, port = places[i % len(places)]
            half = stack.enter_context(socket.create_connection((host, int(port)), 5.0))
            if i % 2:
                half.sendall(HALF_A_HELLO)
        nothing_comes_of(lambda: None)
        rig.done(SafetyCommand("hold"))
        rig.command(Resume())
        rig.start()


def test_a_hold_acts_after_any_single_forged_message(
    rig: FleetRig, pytestconfig: pytest.Config
) -> None:
    """From within, with a robot's certificate, in the ground's name and another robot's."""
    with thief(rig) as says:
        for i in range(rounds(pytestconfig, 4)):
            says(i)
            rig.done(SafetyCommand("hold"))
            for robot in ROBOTS:
                rig.wait_state(robot, _S.HOLD)
            rig.command(Resume())
            rig.start()


def test_a_landing_and_a_kill_act_after_any_single_forged_message(
    rig: FleetRig, pytestconfig: pytest.Config
) -> None:
    with thief(rig) as says:
        for i in range(rounds(pytestconfig, 1)):
            for command in (SafetyCommand("land"), RobotCommand("kill", rig.names)):
                says(i)
                rig.done(command)
                for robot in ROBOTS:
                    rig.wait_vehicle(robot, lambda vehicle: vehicle.landed and not vehicle.armed)
                # It hears of it a moment later.
                assert rig.ground.subscriber.wait_for(
                    lambda told: all(r.status and r.status.armed is False for r in told.robots),
                    60.0,
                )
                rig.command(Resume())
                if isinstance(command, RobotCommand):
                    begin_again(rig)
                rig.make_ready()
                rig.take_off()
                rig.start()


def begin_again(rig: FleetRig) -> None:
    """Recover a robot killed in offboard: a pilot's mode, and a new start of its program."""
    for robot in ROBOTS:
        with rig.simulated.stepped:
            rig.vehicle(robot).set_mode(Px4Mode.HOLD)
        program, before = rig.fleet.robots[robot], rig.status(robot).boot_nonce
        program.send_signal(signal.SIGTERM)
        assert program.wait(60.0) == 0
        program.start()
        rig.wait_status(robot, partial(_is_another_start, before))


def _is_another_start(before: int, status: RobotStatus) -> bool:
    return status.boot_nonce != before


def rounds(config: pytest.Config, few: int) -> int:
    return 20 if config.getoption("tries") >= 1000 else few


@contextmanager
def thief(rig: FleetRig) -> Iterator[Callable[[int], None]]:
    """On the radio with a stolen robot's certificate; says one of four forged messages."""
    stolen = stolen_identity(rig)
    guard = SignedGuard(stolen.membership, lambda: 0.0)
    prefix = f"lpac/{rig.fleet.name}/"
    with unruly_session(rig.fleet.endpoints, certified(stolen.tls)) as opened:

        def says(which: int) -> None:
            status = rig.status(0)
            kill = Order(
                secrets.token_hex(6), 0, status.boot_nonce, "kill", status.uptime_s + 5.0,
                status.operator,
            )  # fmt: skip
            lie = replace(status, sequence=10**6 + which, operator="mallory", obeyed_sequence=2**48)
            key, data = (
                ("ground/order", guard.seal(ORDER, encode(kill))),
                ("robot/0/status", guard.seal(STATUS, encode(lie))),
                ("ground/state", guard.seal(STATE, b"[" * 100_000)),
                ("ground/state", secrets.token_bytes(500)),
            )[which % 4]
            opened.put(prefix + key, data)

        yield says


@pytest.mark.parametrize(
    ("role", "topic"), [(Role.OBSERVER, HOLD), (Role.OPERATOR, STATE), (Role.OPERATOR, HOLD)]
)
def test_a_flood_of_a_laptop_drowns_no_command(
    rig: FleetRig, tmp_path: Path, role: Role, topic: Topic
) -> None:
    """Of an observer's, and of one that was an operator's and is no member any more.

    The robots do not know it: as if it had been taken off their list.
    """
    authority = Authority(rig.fleet.folder / "keys", rig.fleet.name)
    new_member(authority, tmp_path, role, "eve")
    eve = load_identity(tmp_path, fleet=rig.fleet.name, unix_s=1.0)
    over = threading.Event()
    with unruly_session(rig.fleet.endpoints, certified(eve.tls)) as opened:

        def flood() -> None:
            # The vehicles are simulated in this process, too.
            while not over.wait(0.002):
                for _ in range(20):
                    opened.put(f"lpac/{rig.fleet.name}/{topic.pattern}", bytes(100))

        flooding = threading.Thread(target=flood)
        flooding.start()
        try:
            for _ in range(5):
                rig.done(SafetyCommand("hold"))
                for robot in ROBOTS:
                    rig.wait_state(robot, _S.HOLD)
                rig.command(Resume())
                rig.start()
        finally:
            over.set()
            flooding.join()
    for robot in ROBOTS:
        assert flies_on(rig.status(robot))
        assert rig.status(robot).message_counts["no_envelope"] > 100


def test_the_operator_goes_on_commanding(rig: FleetRig) -> None:
    rig.start()
    rig.done(SafetyCommand("hold"))
    for robot in ROBOTS:
        rig.wait_state(robot, _S.HOLD)


def codes(status: RobotStatus) -> set[ReasonCode]:
    return {alarm.code for alarm in status.alarms}


def test_who_is_revoked_in_flight_is_heard_no_more_and_still_obeys(rig: FleetRig) -> None:
    rig.command(Resume())
    rig.start()
    stolen, fleet = f"r{STOLEN}", ("--fleet", rig.fleet.fleet_toml)
    for command, why in (
        (("revoke", stolen), f"{stolen} was in the air when last heard: add --in-flight"),
        (("revoke", "sim"), "sim commands the fleet: add --in-flight"),
        (("operator", "sim", "--out", rig.fleet.folder / "new"), "and would lose its key"),
        (("rotate",), "r0, r1: in the air when last heard, and would lose this computer's"),
    ):
        assert why in error_line(lpac("fleet", *command, *fleet))
    assert flies_on(rig.status(0)) and flies_on(rig.status(STOLEN))
    done = lpac("fleet", "revoke", stolen, "--in-flight", *fleet)
    assert done.returncode == 0, done.stderr
    assert "these keep their old list of members" in done.stdout
    # SSH reaches the other one alone.
    give_list(
        Authority(rig.fleet.folder / "keys", rig.fleet.name),
        rig.fleet.robots[0].folder / "identity",
    )
    rig.wait_status(0, lambda status: not status.neighbour_ages_s)
    assert flies_on(rig.status(0))
    # Whoever kept the old list says so, and flies on.
    rig.wait_status(STOLEN, lambda status: ReasonCode.MEMBERS_DIFFER in codes(status))
    assert rig.ground.subscriber.wait_for(
        lambda told: {robot.name for robot in told.robots if robot.fresh} == {"r0"}, 60.0
    )
    rig.command(SafetyCommand("land"))
    for robot in ROBOTS:
        rig.wait_vehicle(robot, lambda vehicle: vehicle.landed and not vehicle.armed)
