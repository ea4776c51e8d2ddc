"""How often the judgement of position is wrong about one that is good: a day of simulated flights.

Each flight is one vehicle with its receiver's, barometer's and compass's errors, which flies about
and talks as PX4 does; what the robot's telemetry concludes is looked at ten times a second, as in
flight. Nobody takes its position away, so that whatever is doubted or lost is a false alarm.
"""

import math
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any, NamedTuple

import numpy as np
from pymavlink.dialects.v20 import common as mavlink
from rich.console import Console
from rich.progress import track

from bench.report import Report, Table, Target
from edge.core.position import PositionJudgement, PositionLimits, PositionQuality, judge
from edge.drivers.px4.telemetry import RATES_HZ, Px4Telemetry
from lpac.sim.px4.errors import Errors
from lpac.sim.px4.link import Px4Link
from lpac.sim.px4.modes import Px4Mode
from lpac.sim.px4.server import STEP_S
from lpac.sim.px4.vehicle import Airframe, Px4Setpoint, Px4Vehicle

# One look; and by when the vehicle flies at its height.
TICK_S, READY_S = 0.1, 20.0
_CORES = 2
_SPEED_M_S = 1.25
_HEIGHT_M = 8.0
_TURN_S = 10.0


class Watched:
    """A vehicle that flies about, and what its robot would take its position to be worth."""

    def __init__(self, seed: int, endurance_s: float) -> None:
        self.vehicle = Px4Vehicle(
            seed=seed,
            airframe=Airframe(endurance_s=endurance_s),
            errors=Errors(seed, fleet_seed=seed),
        )
        self.judgement = PositionJudgement()
        self.greatest_offset_m = 0.0
        self._rng = np.random.default_rng(seed)
        self._velocity_m_s = np.zeros(3)
        self._link, self._telemetry = Px4Link(self.vehicle, system_id=1), Px4Telemetry()
        self._parser: Any = mavlink.MAVLink(None)
        self._parser.robust_parsing = True
        _ask_for_streams(self._link)

    def tick(self) -> None:
        """Fly for a tenth of a second, and look."""
        vehicle, telemetry = self.vehicle, self._telemetry
        for _ in range(round(TICK_S / STEP_S)):
            vehicle.step(STEP_S)
            for datagram in self._link.due():
                for message in self._parser.parse_buffer(datagram) or ():
                    if message.get_type() in telemetry.messages:
                        telemetry.hear(message.get_type(), message.to_dict(), vehicle.time_s)
        now_s = vehicle.time_s
        heard = telemetry.state(now_s)
        self.judgement = judge(self.judgement, heard, PositionLimits(), now_s)
        if vehicle.armed and heard.gps is not None and heard.gps.offset_m is not None:
            self.greatest_offset_m = max(self.greatest_offset_m, heard.gps.offset_m)
        if now_s % _TURN_S < TICK_S:
            bearing = self._rng.uniform(0.0, math.tau)
            self._velocity_m_s[:2] = _SPEED_M_S * np.array([math.cos(bearing), math.sin(bearing)])
        height_m = -float(vehicle.local_position_m[2])
        self._velocity_m_s[2] = -min(_HEIGHT_M - height_m, 1.5)
        vehicle.offboard(Px4Setpoint(np.full(3, np.nan), self._velocity_m_s.copy()))
        if not vehicle.armed and vehicle.armable and now_s > READY_S / 2.0:
            vehicle.set_mode(Px4Mode.OFFBOARD)
            vehicle.arm()


class _WatchedFlight(NamedTuple):
    """One flight: its time in the air, s, and how often its position was doubted and lost."""

    flown_s: float
    doubted: Counter[str]
    lost: int
    stopped_s: float
    greatest_offset_m: float


def measure(hours: float = 24.0, flight_s: float = 600.0) -> Report:
    """Fly for so long in all, in flights of a battery's length."""
    flights = math.ceil(3600.0 * hours / flight_s)
    with ProcessPoolExecutor(_CORES, mp_context=get_context("spawn")) as processes:
        flown = list(
            track(
                processes.map(_fly, range(flights), [flight_s] * flights),
                "position: flights",
                flights,
                console=Console(stderr=True),
            )
        )
    flown_h = sum(flight.flown_s for flight in flown) / 3600.0
    doubted = sum((flight.doubted for flight in flown), Counter[str]())
    lost = sum(flight.lost for flight in flown)
    stopped_s = sum(flight.stopped_s for flight in flown)
    greatest_offset_m = max(flight.greatest_offset_m for flight in flown)
    figures: dict[str, Any] = {
        "flights": flights,
        "hours_in_the_air": flown_h,
        "doubted": dict(doubted),
        "stopped_s": stopped_s,
        "lost": lost,
        "greatest_offset_m": greatest_offset_m,
    }
    rows = [
        ("hours in the air", f"{flown_h:.1f}"),
        ("stops (position in doubt)", f"{doubted.total()}"),
        *((f"  because of {cause}", f"{count}") for cause, count in doubted.most_common()),
        ("seconds stood still", f"{stopped_s:.0f}"),
        ("landings (position lost)", f"{lost}"),
        ("fix from the estimate, greatest, m", f"{greatest_offset_m:.1f}"),
    ]
    table = Table("false alarms of position, simulated vehicles", ("", "count"), rows)
    targets = [
        Target("landings because of a position that was good", lost, 0, at_least=False),
        Target("stops per hour of flight", doubted.total() / flown_h, 0.1, at_least=False),
    ]
    return Report("position", figures, [table], targets)


def _fly(seed: int, flight_s: float) -> _WatchedFlight:
    watched = Watched(seed, endurance_s=10.0 * flight_s)
    doubted: Counter[str] = Counter()
    lost, stopped_s, flown_s = 0, 0.0, 0.0
    while watched.vehicle.time_s < READY_S + flight_s:
        before = watched.judgement
        watched.tick()
        judgement = watched.judgement
        if watched.vehicle.time_s >= READY_S:
            assert watched.vehicle.armed, "the vehicle must fly"
            flown_s += TICK_S
            stopped_s += TICK_S if judgement.quality is not PositionQuality.GOOD else 0.0
            if (
                judgement.quality is PositionQuality.DOUBTFUL
                and before.quality is PositionQuality.GOOD
            ):
                doubted[str(judgement.cause)] += 1
            lost += (
                judgement.quality is PositionQuality.LOST
                and before.quality is not PositionQuality.LOST
            )
    return _WatchedFlight(flown_s, doubted, lost, stopped_s, watched.greatest_offset_m)


def _ask_for_streams(link: Px4Link) -> None:
    """As the robot does; what it does not listen to is switched off, which saves time."""
    sender: Any = mavlink.MAVLink(None, srcSystem=1, srcComponent=195)
    unheard = (mavlink.MAVLINK_MSG_ID_ATTITUDE, mavlink.MAVLINK_MSG_ID_ODOMETRY)
    for message, interval_us in (
        *((message, 1e6 / rate_hz) for message, rate_hz in RATES_HZ.items()),
        *((message, -1.0) for message in unheard),
    ):
        command = mavlink.MAVLink_command_long_message(
            1, 1, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 0, message, interval_us, 0, 0, 0, 0, 0
        )
        link.receive(bytes(command.pack(sender)))
