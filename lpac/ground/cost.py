"""Coverage cost of a fleet over its missions: J, its share of J at the start, and Lloyd's J."""

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
    """Cost of the robots' positions now: the paper's J, model units.

    `robots` are those that count, by name (see `lpac.analysis.coverage.LastPositions`);
    `flying_mission` whether one of them flies its mission, which begins anew as
    `lpac.analysis.mission_tracker` says. `initial` is J when the first of this trial did;
    `normalized` is J over that; `bound` is what Lloyd's algorithm comes to, which
    knows the world, with so many robots: no bound, though logs call it so. These are None before.
    """

    trial: str
    robots: tuple[str, ...]
    flying_mission: bool
    cost: float
    initial: float | None
    normalized: float | None
    bound: float | None


class MissionCosts:
    """Follows a fleet's missions; pictures come in order.

    `coverage` is that of the fleet's world, None if it is not known. `began_s` is when the mission
    of the last cost began, Unix time, None before any; `whole` whether that was seen.
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
        # Of the mission that began last, by world, trial and number of robots.
        self._bounds: dict[tuple[str, str, int], Future[float]] = {}

    def take_setup(self, setup: FleetSetup) -> None:
        """Take the fleet's world. No cost of another one can be compared with those to come."""
        if setup.world != self._world:
            self.coverage = Coverage.known(setup)
            self._initial.clear()
            self.began_s, self._waited = None, False
        self._world, self._world_id = setup.world, setup.world_id

    def interrupt(self) -> None:
        """Pictures are missed: a mission may begin meanwhile."""
        self._waited = False

    def close(self) -> None:
        """Leave what is being computed."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    def follow(self, snapshot: FleetSnapshot) -> dict[str, tuple[float, float]]:
        """Take the next picture; the robots that count for J, and where they are, m."""
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
        """The mission time; None if none is flown now."""
        if self.began_s is None or not _flies(snapshot, _IN_MISSION, self._tracker.robots):
            return None
        return max(0.0, snapshot.unix_time_s - self.began_s)

    def cost(
        self, snapshot: FleetSnapshot, places_m: Mapping[str, tuple[float, float]], cost: float
    ) -> Cost:
        """Judge J of at least one place, as `follow` gave them and `coverage` computes it."""
        statuses = [
            r.status for r in snapshot.robots if r.name in places_m and r.status is not None
        ]
        flying = [status for status in statuses if status.state is FlightState.MISSION]
        # As the robots say: a ground that has just started does not know it yet.
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
        """Computed beside all else, once per world, trial and number; None until it is known."""
        assert self.coverage is not None
        key = self._world_id, trial, len(positions_m)
        if key not in self._bounds:
            self._bounds[key] = self._pool.submit(self.coverage.lloyd, positions_m)
        return self._bounds[key].result() if self._bounds[key].done() else None


def positions_of(places_m: Mapping[str, tuple[float, float]]) -> F64:
    """The places as an array (N, 2)."""
    return np.array(list(places_m.values())).reshape(-1, 2)


def _flies(
    snapshot: FleetSnapshot, states: tuple[FlightState, ...], robots: set[int] | None = None
) -> bool:
    """Whether one of these robots (None: of all) is heard in one of these states."""
    return any(
        robot.fresh and robot.status is not None and robot.status.state in states
        for robot in snapshot.robots
        if robots is None or robot.robot_id in robots
    )
