"""A robot under 10,000 messages a second: how late its control loop is, and its memory.

Two robot programs fly a mission, once in peace, once while a process beside them floods their radio
for as long: without keys as whoever reaches it, with keys as a thief with the
certificate of one of the two. Half of the flood comes on one key, half on thousands.
"""

import json
import tempfile
import time
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from multiprocessing.queues import Queue
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Self

import zenoh

from bench import BUNDLE
from bench.report import Report, Table, Target, progress
from edge.drivers.identity_folder import load_identity
from edge.messages.mission import FlightState
from edge.messages.topics import TlsFiles
from lpac.sim.fleet.flight import fly
from lpac.sim.fleet.processes import Fleet
from lpac.sim.scenario import Scenario

_RATE_HZ = 10_000
_BURST_S = 0.01
_MESSAGE = b"x" * 64
_FORGED_KEYS = 3000
# The thief has robot 1's key, and robot 0 hears it.
_VICTIM, _STOLEN = 0, 1


@dataclass(frozen=True, slots=True)
class Flooded:
    """A mission of robot 0: the lateness of its control loop over the last minute, memory, holds.

    `sent_hz` is what the flood had of messages a second, `refused` how many of all the robot did
    not look at, `holds` how often it held.
    """

    sent_hz: float
    refused: int
    lateness_p50_ms: float
    lateness_p99_ms: float
    lateness_max_ms: float
    resident_mb: float
    holds: int


def measure(mission_s: float = 70.0, rate_hz: int = _RATE_HZ) -> Report:
    """Four missions, of which two are flooded throughout."""
    flights = {}
    for secure in (False, True):
        keys = "with keys" if secure else "without keys"
        for rate in (0, rate_hz):
            name = f"{keys}, {'flooded' if rate else 'in peace'}"
            progress(f"flood: {name}, about two minutes")
            flights[name] = _fly(mission_s, rate, secure=secure)
    secured = flights["with keys, flooded"]
    return Report(
        "flood",
        {name: asdict(flight) for name, flight in flights.items()},
        [
            Table(
                f"A robot under {rate_hz} messages a second, for {mission_s:g} s",
                (
                    "", "sent, 1/s", "not looked at", "control late by, ms: p50", "p99", "max",
                    "resident, MB", "holds",
                ),
                [
                    (
                        name, f"{f.sent_hz:.0f}", f"{f.refused}", f"{f.lateness_p50_ms:.1f}",
                        f"{f.lateness_p99_ms:.1f}", f"{f.lateness_max_ms:.1f}",
                        f"{f.resident_mb:.0f}", f"{f.holds}",
                    )
                    for name, f in flights.items()
                ],
            )
        ],
        [
            Target("control's lateness, p99, ms", secured.lateness_p99_ms, 20.0, at_least=False),
            Target("resident memory, MB", secured.resident_mb, 200.0, at_least=False),
            Target("holds", secured.holds, 0.0, at_least=False),
        ],
        [
            "Robots, vehicles, ground and flood share this machine's cores. A robot looks at so "
            "many messages of a key, and of so many keys, and no more."
        ],
    )  # fmt: skip


def _fly(mission_s: float, rate_hz: int, *, secure: bool) -> Flooded:
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        scenario = Scenario(robots=2, seed=7, duration_s=mission_s, secure=secure)
        fleet = Fleet(scenario, Path(folder), BUNDLE)
        flood: _Flood | None = None

        def watch(step: str) -> None:
            nonlocal flood
            if step == "mission" and flood is None:
                flood = stack.enter_context(_Flood(fleet, rate_hz, secure))
            elif step != "mission":
                stack.close()

        flight = fly(fleet, watch=watch)
    if flight.problem is not None:
        raise RuntimeError(f"the flight did not go as planned: {flight.problem}")
    victim = flight.robots[_VICTIM]
    assert flood is not None and victim.last is not None
    control = victim.last.loops["control"]
    began_s, until_s = flight.began_s["mission"], flight.began_s["return"]
    return Flooded(
        flood.sent_hz,
        victim.last.message_counts.get("not_admitted", 0),
        control.lateness_p50_ms,
        control.lateness_p99_ms,
        control.lateness_max_ms,
        victim.peak_memory_mb,
        sum(
            change.state is FlightState.HOLD and began_s < change.time_s < until_s
            for change in victim.changes
        ),
    )


class _Flood:
    """A process that says so much while the context lasts; then `sent_hz` is how much it was."""

    def __init__(self, fleet: Fleet, rate_hz: int, secure: bool) -> None:
        spawn = get_context("spawn")
        self.sent_hz = 0.0
        self._stop = spawn.Event()
        self._queue = spawn.Queue()
        tls = None
        if secure:
            identity = fleet.robots[_STOLEN].folder / "identity"
            tls = load_identity(identity, fleet=fleet.name, unix_s=1.0).tls
        self._process = spawn.Process(
            target=_flood,
            args=(fleet.endpoints[_VICTIM], fleet.name, tls, rate_hz, self._stop, self._queue),
        )

    def __enter__(self) -> Self:
        self._process.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self.sent_hz = self._queue.get(timeout=30.0)
        self._process.join()


def _flood(
    endpoint: str,
    fleet: str,
    tls: TlsFiles | None,
    rate_hz: int,
    stop: Event,
    sent_hz: "Queue[float]",
) -> None:
    config = zenoh.Config()
    for key, value in {
        "mode": "client",
        "scouting/multicast/enabled": False,
        "connect/endpoints": [endpoint],
        **({} if tls is None else {"transport/link/tls": _certified(tls)}),
    }.items():
        config.insert_json5(key, json.dumps(value))
    robot = f"lpac/{fleet}/robot"
    own = f"{robot}/{_STOLEN}/message"
    with zenoh.open(config) as session:
        began_s, sent = time.monotonic(), 0
        while not stop.wait(_BURST_S):
            due = int((time.monotonic() - began_s) * rate_hz)
            for number in range(sent, due):
                key = own if number % 2 else f"{robot}/{number % _FORGED_KEYS}/message"
                session.put(key, _MESSAGE)
            sent = due
        sent_hz.put(sent / (time.monotonic() - began_s))


def _certified(files: TlsFiles) -> dict[str, object]:
    return {
        "root_ca_certificate": files.authority, "enable_mtls": True,
        "verify_name_on_connect": False,
        "connect_private_key": files.key, "connect_certificate": files.certificate,
    }  # fmt: skip
