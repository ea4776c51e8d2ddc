"""Leader election among ground stations: one commands, the others observe.

The commander is the `operator` of the state that the robots obey. A robot's report of the state
that it obeys counts only if most robots agree: one alone may be cut off or lie.
"""

import math
import statistics
from dataclasses import replace

from edge.identity.guard import Sender
from edge.identity.members import Role
from edge.messages.mission import FlightState, GroundState, RobotStatus
from lpac.analysis.commonest import commonest
from lpac.analysis.snapshot import COMMANDER_SILENT_S, FleetSetup
from lpac.ground.station.orders import Orders
from lpac.ground.station.places import places_of
from lpac.ground.station.states import describe_changes, is_safer, rank
from lpac.ground.station.statuses import Notify, RobotStatuses

# Listening time before a new station commands; a state is published every 0.4 s.
LISTEN_S = 0.7
# A commander is also gone once robots have not heard it for this long.
_UNHEARD_BY_ROBOTS_S = 1.0
_OVERTAKEN_S = 1.0
# If robots heard this station's name within this time, another station has it: a state comes every
# 0.4 s, a status every 0.5 s, and one of either may be lost.
_NAME_HEARD_S = 1.4
_NAME_TAKEN_S = 3.0
_NAME_SHARED_S = 10.0
# Bound on how far one robot may report to be ahead of most others.
_MAX_OBEYED_AHEAD = 10**6


class Election:
    """The commander's `state` (None if there is none yet), and whether this station `commands`.

    `interruption` tells what another station did that ends this one's running commands, "" if
    nothing.
    """

    def __init__(
        self, setup: FleetSetup, robots: RobotStatuses, orders: Orders, notify: Notify, *,
        may_command: bool,
    ) -> None:  # fmt: skip
        self.state: GroundState | None = None
        self.commands = False
        self.interruption = ""
        self.may_command = may_command
        self._setup = setup
        self._robots = robots
        self._orders = orders
        self._notify = notify
        self._commander_at_s = robots.now_s
        self._obeyed_since_s: float | None = None
        self._decided = False
        self._name_shared_at_s = -math.inf
        self._ahead_since_s: dict[int, float] = {}
        self._restored: GroundState | None = None

    @property
    def is_settled(self) -> bool:
        """Whether this station has listened long enough to know the commander."""
        if self.state is not None or self._decided:
            return True
        return self._robots.age_s >= LISTEN_S and self._obeyed_since_s is None

    @property
    def commander(self) -> str:
        """Name of the station that commands, or did last; "" if there is none yet."""
        if self.state is not None:
            return self.state.operator
        named: dict[str, list[int]] = {}
        for status in self._robots.statuses().values():
            if status.operator:
                named.setdefault(status.operator, []).append(status.obeyed_sequence)
        return max(named, key=lambda o: (len(named[o]), max(named[o])), default="")

    @property
    def commander_age_s(self) -> float:
        """Time since this station or a robot last heard the commander, s.

        0 if this station commands or nobody does.
        """
        commander = self.commander
        if self.commands or not commander:
            return 0.0
        now_s, age_s = self._robots.now_s, self._robots.age_s
        own_s = age_s if self.state is None else now_s - self._commander_at_s
        reported_s = [
            status.ground_age_s
            for status in self._robots.statuses().values()
            if status.operator == commander and status.ground_age_s is not None
        ]
        return min(reported_s if reported_s and self.state is None else [own_s, *reported_s])

    @property
    def shares_name(self) -> bool:
        """Whether another station used this one's name within the last 10 s."""
        return self._robots.now_s - self._name_shared_at_s <= _NAME_SHARED_S

    @property
    def greatest_obeyed(self) -> int:
        """Greatest sequence that robots report to obey, bounded against a single robot's lie."""
        obeyed = [s.obeyed_sequence for s in self._robots.statuses().values()] or [0]
        return min(max(obeyed), max(statistics.median_low(obeyed), 0) + _MAX_OBEYED_AHEAD)

    def take_command(self) -> GroundState:
        """Command from now on, starting from the fleet's present state; return the state."""
        if self.commands and self.state is not None:
            return self.state
        operator, before = self._setup.operator, self._known_state()
        by = before.safety_action_by or before.operator
        self.state = replace(
            before,
            sequence=max(before.sequence, self.greatest_obeyed) + 1,
            operator=operator,
            safety_action_by="" if by == operator or before.safety_action == "none" else by,
        )
        self.commands = True
        self._notify_commander(operator)
        return self.state

    def restore(self, state: GroundState) -> None:
        """Restore the state that this computer published last; used if robots still obey it."""
        self._restored = state

    def _is_obeyed_still(self) -> bool:
        """Whether most of the fleet still obeys the restored state.

        Another commander's state would have a greater sequence.
        """
        if self._restored is None:
            return False
        known = rank(self._restored)
        statuses = self._robots.statuses().values()
        obeying = sum((s.obeyed_sequence, s.operator) == known for s in statuses)
        return 2 * obeying > len(self._setup.robots)

    def _known_state(self) -> GroundState:
        """The fleet's state as received, restored, or else derived from the robots' statuses."""
        if self.state is not None:
            return self.state
        statuses = [s for s in self._robots.statuses().values() if s.operator]
        obeyed = max(((s.obeyed_sequence, s.operator) for s in statuses), default=None)
        if self._restored is not None and rank(self._restored) == obeyed:
            return self._restored
        return state_of_robots(self._setup, statuses, self.commander or self._setup.operator)

    def receive_state(self, state: GroundState, sender: Sender) -> None:
        """Take another station's state, if its operator's key signed it."""
        if sender.name not in ("", state.operator) or sender.role is not Role.OPERATOR:
            return
        before = self.state
        if state.operator == self._setup.operator:
            if self.commands and before is not None and state.sequence <= before.sequence:
                return  # This station's own, from before its restart.
            self._notify_shared_name()
        silent = not self.commands and self.commander_age_s > COMMANDER_SILENT_S
        if before is not None and rank(state) < rank(before) and not silent:
            return
        if self.commands:
            self._step_down(state.operator)
        if before is None or before.operator != state.operator:
            self._notify_commander(state.operator)
        elif before.sequence != state.sequence:
            by = state.safety_action_by if is_safer(before, state) else ""
            self.notify_changes(before, state, by or state.operator)
        self.state, self.commands, self._commander_at_s = state, False, self._robots.now_s

    def receive_status(self, status: RobotStatus) -> None:
        """Step down, or raise the sequence, if most robots obey a state of greater rank."""
        self.elect()
        state = self.state
        obeyed = status.obeyed_sequence, status.operator
        # Robots that no longer hear their station will obey this one.
        current = status.operator == self._setup.operator or (
            status.ground_age_s is not None and status.ground_age_s <= _UNHEARD_BY_ROBOTS_S
        )
        if not self.commands or state is None or obeyed <= rank(state) or not current:
            self._ahead_since_s.pop(status.robot_id, None)
            return
        # Wait: the other commander's state usually arrives here too.
        now_s, statuses = self._robots.now_s, self._robots.statuses()
        self._ahead_since_s.setdefault(status.robot_id, now_s)
        ahead = [
            s
            for robot, s in statuses.items()
            if now_s - self._ahead_since_s.get(robot, now_s) > _OVERTAKEN_S
            and (s.obeyed_sequence, s.operator) > rank(state)
        ]
        if 2 * len(ahead) <= len(statuses):
            return
        operator = commonest(status.operator for status in ahead)
        if operator in (None, self._setup.operator):
            self.state = replace(state, sequence=self.greatest_obeyed + 1)
            return
        self._step_down(operator)
        self._notify_commander(operator)
        # The other one's state is not known.
        self.state, self._decided = None, True

    def elect(self) -> None:
        """Decide once whether to command robots that obey a station which is gone."""
        if self.state is not None or self._decided or not self.commander:
            self._obeyed_since_s = None
            return
        if self._obeyed_since_s is None:
            self._obeyed_since_s = self._robots.now_s
        # Robots may hear a commander that this station does not.
        abandoned = self.commander_age_s > _UNHEARD_BY_ROBOTS_S
        most_report = 2 * len(self._robots.statuses()) > len(self._setup.robots)
        resumes = self._is_obeyed_still()
        listened_s = self._robots.now_s - self._obeyed_since_s
        if listened_s < LISTEN_S and not (resumes or (abandoned and most_report)):
            return
        if not resumes and self._own_name_age_s() < _NAME_HEARD_S:
            if listened_s > _NAME_TAKEN_S:
                self._notify_shared_name()
                self._decided = True
            return
        self._decided = True
        if self.may_command and (abandoned or self.commander == self._setup.operator):
            self.take_command()

    def _own_name_age_s(self) -> float:
        """Median time since robots heard a station of this name, s; infinite if most did not."""
        own = self._setup.operator
        ages_s = [
            self._robots.ground_age_s(robot) if status.operator == own else math.inf
            for robot, status in self._robots.statuses().items()
        ]
        return statistics.median_high(ages_s) if ages_s else math.inf

    def _step_down(self, operator: str) -> None:
        """Stop commanding, and end running commands and orders."""
        self.commands = False
        self._ahead_since_s.clear()
        self.interruption = f"{operator} commands the fleet"
        self._orders.interrupt(self.interruption)

    def notify_changes(self, before: GroundState, after: GroundState, by: str) -> None:
        """Notify of another station's changes."""
        for text in describe_changes(before, after):
            self._notify("command", "", text, by)

    def _notify_commander(self, operator: str) -> None:
        self._notify("commander", "", f"{operator} commands the fleet", operator)

    def _notify_shared_name(self) -> None:
        if not self.shares_name:
            text = "another ground station has this one's name: give one another with --name"
            self._notify("commander", "", text, self._setup.operator)
        self._name_shared_at_s = self._robots.now_s


def state_of_robots(setup: FleetSetup, statuses: list[RobotStatus], operator: str) -> GroundState:
    """Derive a station's state from the statuses of the robots that obey it."""
    idle = {str(s.robot_id): False for s in statuses if s.state is FlightState.IDLE}
    # A robot that is not heard yet may be in the air.
    enabled = bool(statuses) and len(idle) < len(setup.robots)
    # In a tie, prefer a fence that is not the configured one: the ground must have set it.
    fence = commonest(sorted((s.fence for s in statuses), key=lambda fence: fence == setup.fence))
    return GroundState(
        sequence=0,
        operator=operator,
        origin=commonest(s.origin for s in statuses),
        enabled=enabled,
        robot_enabled=idle if enabled else {},
        fence=None if fence == setup.fence else fence,
        places=places_of(setup, statuses),
        world_id=commonest(s.world_id for s in statuses),
        trial=commonest(s.trial for s in statuses) or "",
    )
