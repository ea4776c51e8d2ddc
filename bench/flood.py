"""Lateness of control without a flood, and while an outsider or a member floods the radio."""

import itertools
import json
import multiprocessing
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from multiprocessing.sharedctypes import Synchronized
from multiprocessing.synchronize import Event
from pathlib import Path

import zenoh

from bench import BUNDLE
from bench.result import Result, Table, Target, progress
from edge.drivers.identity_folder import load_identity
from edge.messages.topics import MESSAGE, TlsFiles
from lpac.sim.engines import require_flown
from lpac.sim.fleet.flight import FleetMoment, fly_programs
from lpac.sim.fleet.processes import Fleet
from lpac.sim.scenario import Scenario

RATE_HZ = 10_000
# Keys to publish on in turn: a robot's, the ground's, and those of robots that do not exist.
_OUTSIDERS = ("robot/2/message", "ground/state", *(f"robot/{id_}/message" for id_ in range(9, 109)))
_MEMBERS = ("robot/2/message",)
_WHO = ("nobody", "an outsider", "a member", "a member who signs")
_STEP_S = 0.01


def measure(robots: int = 3, mission_s: float = 60.0) -> Result:
    """Fly a mission of `robots` robots with each kind of flood; members have robot 2's keys."""
    rows, p99_ms = [], {}
    for who in _WHO:
        progress(f"flood: {robots} robots fly, {who} floods, about two minutes")
        late_ms, rate_hz = _fly(who, robots, mission_s)
        p99_ms[who] = max(late_ms)
        rows.append((who, f"{rate_hz:.0f}", *(f"{each:.1f}" for each in sorted(late_ms))))
    return Result(
        "flood",
        {"p99_ms": p99_ms},
        [
            Table(
                "Lateness of each robot's control loop in a mission, ms, p99 of a minute",
                ("who floods", "messages/s", *(["a robot"] * robots)),
                rows,
            )
        ],
        [
            Target(f"control is late, p99 ms, {who} floods", p99_ms[who], 20, at_least=False)
            for who in _WHO[1:]
        ],
        ["Every message goes to every robot. Vehicles, operator and flood share the cores."],
    )


def _fly(who: str, robots: int, mission_s: float) -> tuple[list[float], float]:
    """Lateness of each robot at the mission's end, p99 ms, and messages sent per second."""
    spawning = multiprocessing.get_context("spawn")
    over, sent, began_s, lasted_s = spawning.Event(), spawning.Value("q", 0), 0.0, 1.0
    late_ms: list[float] = []

    def watch(moment: FleetMoment) -> None:
        nonlocal began_s, lasted_s, late_ms
        if moment.step == "mission":
            loops = [status.loops.get("control") for status in moment.statuses.values()]
            late_ms = [loop.lateness_p99_ms for loop in loops if loop is not None]
            if not began_s:
                began_s = time.monotonic()
                if who != "nobody":
                    flood.start()
        elif began_s and not over.is_set():
            over.set()
            lasted_s = time.monotonic() - began_s

    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        scenario = Scenario(robots=robots, seed=7, duration_s=mission_s, secure=who in _WHO[2:])
        fleet = Fleet(scenario, Path(folder), BUNDLE)
        keys = fleet.robots[2].folder / "identity" if scenario.secure else None
        flood = spawning.Process(
            target=_flood,
            args=(fleet.name, fleet.endpoints, keys, who == _WHO[3], over, sent),
            daemon=True,
        )
        stack.callback(over.set)
        flight = fly_programs(fleet, watch=watch)
    require_flown(flight)
    return late_ms, sent.value / lasted_s


def _flood(
    fleet: str,
    endpoints: tuple[str, ...],
    keys: Path | None,
    signs: bool,
    over: Event,
    sent: "Synchronized[int]",
) -> None:
    """Publish `RATE_HZ` messages a second until `over`, with the keys in that folder, if any."""
    data, tls = partial(bytes, 100), None
    if keys is not None:
        identity = load_identity(keys, fleet=fleet, unix_s=time.time())
        tls = certified(identity.tls)
        if signs:
            data = partial(identity.guard(time.monotonic).seal, MESSAGE, bytes(100))
    names = itertools.cycle(_OUTSIDERS if keys is None else _MEMBERS)
    began_s, count = time.monotonic(), 0
    with unruly_session(endpoints, tls) as session:
        while not over.wait(_STEP_S):
            due = int((time.monotonic() - began_s) * RATE_HZ)
            for name in itertools.islice(names, due - count):
                session.put(f"lpac/{fleet}/{name}", data())
            count = sent.value = due


@contextmanager
def unruly_session(
    endpoints: Sequence[str], tls: Mapping[str, object] | None, mode: str = "peer"
) -> Iterator[zenoh.Session]:
    """Open a zenoh session on the robots' radio, without our link's checks and limits.

    `tls` is zenoh's own setting, such as that of `certified`; without it the session speaks TCP.
    """
    scheme = "tcp" if tls is None else "tls"
    config = zenoh.Config()
    for key, value in {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "listen/endpoints": [f"{scheme}/127.0.0.1:0"],
        "connect/endpoints": [e.replace("tls/", f"{scheme}/") for e in endpoints],
        **({} if tls is None else {"transport/link/tls": tls}),
    }.items():
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config) as opened:
        yield opened


def certified(files: TlsFiles) -> dict[str, object]:
    """Return zenoh's TLS setting with a member's certificate."""
    return {
        "root_ca_certificate": files.authority, "enable_mtls": True,
        "verify_name_on_connect": False,
        "listen_private_key": files.key, "listen_certificate": files.certificate,
        "connect_private_key": files.key, "connect_certificate": files.certificate,
    }  # fmt: skip
