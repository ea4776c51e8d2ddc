"""Coverage cost J of a fleet's missions, relative to J at the start and to Lloyd's algorithm."""

from collections import Counter
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from edge.core import F64
from edge.messages.mission import FlightState
from lpac.analysis.coverage import Coverage, LastPositions
from lpac.analysis.mission_tracker import MissionTracker
from lpac.analysis.snapshot import FleetSetup, FleetSnapshot

# A mission may be interrupted; return and land end it.
_IN_MISSION = (FlightState.MISSION, FlightState.HOLD, FlightState.PILOT)


@dataclass(frozen=True, slots=True)
class Cost:
    """Cost of the robots' present positions: the paper's J, model units.

    `robots` are the names of those that count (see `lpac.analysis.coverage.LastPositions`),
    `flying_mission` whether one of them flies its mission. `initial` is J when the first robot
    began this trial's mission (see `lpac.analysis.mission_tracker`), `normalized` is J / `initial`.
    `bound` is the J that Lloyd's algorithm reaches with as many robots, knowing the world; it is
    not a bound, though logs call it so. These three are None before the mission.
    """

    trial: str
    robots: tuple[str, ...]
    flying_mission: bool
    cost: float
    initial: float | None
    normalized: float | None
    bound: float | None


class MissionCosts:
    """Tracks a fleet's missions through its snapshots, in order.

    `coverage` is that of the fleet's world, None if unknown. `began_s` is when the mission of the
    last cost began, Unix time, None before any; `whole` whether that beginning was observed.
    """

    def __init__(self) -> None:
        self.coverage: Coverage | None = None
        self.began_s: float | None = None
        self.whole = False
        self._world: str | None = None
        self._world_id = ""
        self._waited = False
        self._last_positions = LastPositions()
        self._tracker = MissionTracker()
        # J at the start of each trial's last mission.
        self._initial: dict[str, float] = {}
        self._pool = ThreadPoolExecutor(1)
        # Of the last mission, by world, trial and number of robots.
        self._bounds: dict[tuple[str, str, int], Future[float]] = {}

    def take_setup(self, setup: FleetSetup) -> None:
        """Set the fleet's world. A new world resets the mission: costs are not comparable."""
        if setup.world != self._world:
            self.coverage = Coverage.known(setup)
            self._initial.clear()
            self.began_s, self._waited = None, False
        self._world, self._world_id = setup.world, setup.world_id

    def interrupt(self) -> None:
        """Note that snapshots are missed, in which a mission may begin."""
        self._waited = False

    def close(self) -> None:
        """Abandon pending computations."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    def follow(self, snapshot: FleetSnapshot) -> dict[str, tuple[float, float]]:
        """Take the next snapshot; return the positions, m, of the robots that count for J."""
        if not _flies(snapshot, (FlightState.MISSION,)):
            self._waited = True
        for robot in snapshot.robots:
            status, age_s = robot.status, robot.age_s
            if status is None or age_s is None:
                continue
            if self._tracker.begins(robot.robot_id, status, snapshot.unix_time_s - age_s):
                self._initial.pop(status.trial, None)
                self._bounds.clear()
                self.began_s = None
        return self._last_positions.counted(snapshot)

    def mission_s(self, snapshot: FleetSnapshot) -> float | None:
        """Time since the mission began, s; None if none is being flown."""
        if self.began_s is None or not _flies(snapshot, _IN_MISSION, self._tracker.robots):
            return None
        return max(0.0, snapshot.unix_time_s - self.began_s)

    def cost(
        self, snapshot: FleetSnapshot, places_m: Mapping[str, tuple[float, float]], cost: float
    ) -> Cost:
        """Compare the J of at least one position, from `follow`, with the mission's start."""
        statuses = [
            r.status for r in snapshot.robots if r.name in places_m and r.status is not None
        ]
        flying = [status for status in statuses if status.state is FlightState.MISSION]
        # From the robots: a ground that has just started does not know the trial yet.
        ((trial, _),) = Counter(s.trial for s in flying or statuses).most_common(1)
        if flying:
            self._initial.setdefault(trial, cost)
            if self.began_s is None:
                self.began_s, self.whole = snapshot.unix_time_s, self._waited
        initial = self._initial.get(trial)
        return Cost(
            trial, tuple(places_m), bool(flying), cost, initial,
            normalized=cost / initial if initial else None,
            bound=None if initial is None else self._bound(trial, positions_of(places_m)),
        )  # fmt: skip

    def _bound(self, trial: str, positions_m: F64) -> float | None:
        """Compute in a thread, once per world, trial and number; None until it is done."""
        assert self.coverage is not None
        key = self._world_id, trial, len(positions_m)
        if key not in self._bounds:
            self._bounds[key] = self._pool.submit(self.coverage.lloyd, positions_m)
        return self._bounds[key].result() if self._bounds[key].done() else None


def positions_of(places_m: Mapping[str, tuple[float, float]]) -> F64:
    """Positions as an array (N, 2), m."""
    return np.array(list(places_m.values())).reshape(-1, 2)


def _flies(
    snapshot: FleetSnapshot, states: tuple[FlightState, ...], robots: set[int] | None = None
) -> bool:
    """Whether one of these robots (None: any) is fresh and in one of these states."""
    return any(
        robot.fresh and robot.status is not None and robot.status.state in states
        for robot in snapshot.robots
        if robots is None or robot.robot_id in robots
    )
