"""Leader election among ground stations: one commands, and the others observe.

The commander is the `operator` named in the state that the robots obey. A robot's report of whom it
obeys counts only if most robots agree: one alone may be cut off, or lie.
"""

import math
import statistics
from dataclasses import replace

from edge.identity.guard import Sender
from edge.identity.members import Role
from edge.messages.mission import FlightState, GroundState, RobotStatus
from lpac.analysis.commonest import commonest
from lpac.analysis.snapshot import COMMANDER_SILENT_S, FleetSetup
from lpac.ground.station.heard import HeardRobots, Tell
from lpac.ground.station.orders import Orders
from lpac.ground.station.places import places_of
from lpac.ground.station.wishes import changes_in_words, is_safer, rank

# Listening time before a new station commands; a state is published every 0.4 s.
LISTEN_S = 0.7
# A commander is gone also if robots say so, who hear what this station may not.
_ROBOTS_HEAR_NOBODY_S = 1.0
_OVERTAKEN_S = 1.0
# Robots that heard this station's name more recently have heard another station of that name: a
# state comes every 0.4 s, a status every 0.5 s, and one of either may be lost.
_SPOKE_S = 1.4
_NAME_TAKEN_S = 3.0
_NAME_SHARED_S = 10.0
# Beyond what most robots obey, none has heard a station.
_MOST_OBEYED_AHEAD = 10**6


class Election:
    """`state` is what the fleet is told, by whoever commands; `commands`: by this station.

    The state is None as long as nobody was heard to say anything. `interruption` is what another
    station did that ends this one's running commands; "" if nothing.
    """

    def __init__(
        self, setup: FleetSetup, robots: HeardRobots, orders: Orders, tell: Tell, *,
        may_command: bool,
    ) -> None:  # fmt: skip
        self.state: GroundState | None = None
        self.commands = False
        self.interruption = ""
        self.may_command = may_command
        self._setup = setup
        self._robots = robots
        self._orders = orders
        self._tell = tell
        self._heard_s = robots.now_s  # when the commander was
        self._obeyed_since_s: float | None = None
        self._decided = False
        self._name_shared_at_s = -math.inf
        self._ahead_since_s: dict[int, float] = {}
        self._remembered: GroundState | None = None

    @property
    def listened(self) -> bool:
        """Whether this station has listened long enough to know who commands."""
        if self.state is not None or self._decided:
            return True
        return self._robots.age_s >= LISTEN_S and self._obeyed_since_s is None

    @property
    def commander(self) -> str:
        """Station that commands, or did last; "" if none does yet."""
        if self.state is not None:
            return self.state.operator
        named: dict[str, list[int]] = {}
        for status in self._robots.statuses().values():
            if status.operator:
                named.setdefault(status.operator, []).append(status.obeyed_sequence)
        return max(named, key=lambda o: (len(named[o]), max(named[o])), default="")

    @property
    def commander_age_s(self) -> float:
        """How long ago the commander was heard, by this station or by a robot, s.

        0 if that is this station, or nobody.
        """
        commander = self.commander
        if self.commands or not commander:
            return 0.0
        now_s, age_s = self._robots.now_s, self._robots.age_s
        own_s = age_s if self.state is None else now_s - self._heard_s
        told_s = [
            status.ground_age_s
            for status in self._robots.statuses().values()
            if status.operator == commander and status.ground_age_s is not None
        ]
        return min(told_s if told_s and self.state is None else [own_s, *told_s])

    @property
    def shares_name(self) -> bool:
        """Whether another station spoke in this one's name lately."""
        return self._robots.now_s - self._name_shared_at_s <= _NAME_SHARED_S

    @property
    def greatest_obeyed(self) -> int:
        """As far as that can be: no robot alone makes it so great that no state goes beyond."""
        obeyed = [s.obeyed_sequence for s in self._robots.statuses().values()] or [0]
        return min(max(obeyed), max(statistics.median_low(obeyed), 0) + _MOST_OBEYED_AHEAD)

    def take_command(self) -> GroundState:
        """Command from now on, with what the fleet is told already; that state."""
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
        self._tell_commander(operator)
        return self.state

    def remember(self, state: GroundState) -> None:
        """Take the state that this computer published last: it counts if robots still obey it."""
        self._remembered = state

    def _is_obeyed_still(self) -> bool:
        """Whether most of the fleet obeys the state that this computer published last.

        Any other commander's state would have a greater sequence.
        """
        if self._remembered is None:
            return False
        known = rank(self._remembered)
        statuses = self._robots.statuses().values()
        obeying = sum((s.obeyed_sequence, s.operator) == known for s in statuses)
        return 2 * obeying > len(self._setup.robots)

    def _known_state(self) -> GroundState:
        """State of the fleet: as last heard, remembered, or seen in the robots."""
        if self.state is not None:
            return self.state
        statuses = [s for s in self._robots.statuses().values() if s.operator]
        obeyed = max(((s.obeyed_sequence, s.operator) for s in statuses), default=None)
        if self._remembered is not None and rank(self._remembered) == obeyed:
            return self._remembered
        return state_of_robots(self._setup, statuses, self.commander or self._setup.operator)

    # What it hears

    def hear_state(self, state: GroundState, sender: Sender) -> None:
        """Another station's state came. It counts if its operator's key signed it."""
        if sender.name not in ("", state.operator) or sender.role is not Role.OPERATOR:
            return
        before = self.state
        if state.operator == self._setup.operator:
            if self.commands and before is not None and state.sequence <= before.sequence:
                return  # Of this station's former life.
            self._tell_shared_name()
        silent = not self.commands and self.commander_age_s > COMMANDER_SILENT_S
        if before is not None and rank(state) < rank(before) and not silent:
            return
        if self.commands:
            self._step_down(state.operator)
        if before is None or before.operator != state.operator:
            self._tell_commander(state.operator)
        elif before.sequence != state.sequence:
            by = state.safety_action_by if is_safer(before, state) else ""
            self.tell_changes(before, state, by or state.operator)
        self.state, self.commands, self._heard_s = state, False, self._robots.now_s

    def hear_status(self, status: RobotStatus) -> None:
        """A robot may obey what this station does not know of: its former life, or another one."""
        self.listen()
        state = self.state
        obeyed = status.obeyed_sequence, status.operator
        # Who obeys a station that is gone does so no longer than it takes to hear this one.
        heard = status.operator == self._setup.operator or (
            status.ground_age_s is not None and status.ground_age_s <= _ROBOTS_HEAR_NOBODY_S
        )
        if not self.commands or state is None or obeyed <= rank(state) or not heard:
            self._ahead_since_s.pop(status.robot_id, None)
            return
        # Another commander mostly comes here too.
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
        operator = commonest(told.operator for told in ahead)
        if operator in (None, self._setup.operator):
            self.state = replace(state, sequence=self.greatest_obeyed + 1)
            return
        self._step_down(operator)
        self._tell_commander(operator)
        # What the other one wants is not known.
        self.state, self._decided = None, True

    def listen(self) -> None:
        """Find out who commands robots that obey somebody; take those that were left alone."""
        if self.state is not None or self._decided or not self.commander:
            self._obeyed_since_s = None
            return
        if self._obeyed_since_s is None:
            self._obeyed_since_s = self._robots.now_s
        # The robots' ages tell of a commander that this station does not hear, but they do.
        alone = self.commander_age_s > _ROBOTS_HEAR_NOBODY_S
        most_tell = 2 * len(self._robots.statuses()) > len(self._setup.robots)
        resumes = self._is_obeyed_still()
        listened_s = self._robots.now_s - self._obeyed_since_s
        if listened_s < LISTEN_S and not (resumes or (alone and most_tell)):
            return
        if not resumes and self._own_name_age_s() < _SPOKE_S:
            if listened_s > _NAME_TAKEN_S:
                self._tell_shared_name()
                self._decided = True
            return
        self._decided = True
        if self.may_command and (alone or self.commander == self._setup.operator):
            self.take_command()

    def _own_name_age_s(self) -> float:
        """How long ago most robots had heard a station of this name; infinite if not, s."""
        lasts = map(self._robots.last, self._robots.statuses())
        ages_s = [
            status.ground_age_s + age_s
            if status.operator == self._setup.operator and status.ground_age_s is not None
            else math.inf
            for status, age_s in filter(None, lasts)
        ]
        return statistics.median_high(ages_s) if ages_s else math.inf

    def _step_down(self, operator: str) -> None:
        """Another station commands from now on."""
        self.commands = False
        self._ahead_since_s.clear()
        self.interruption = f"{operator} commands the fleet"
        self._orders.interrupt(self.interruption)

    # What it tells

    def tell_changes(self, before: GroundState, after: GroundState, by: str) -> None:
        """Tell what another station newly wants."""
        for text in changes_in_words(before, after):
            self._tell("command", "", text, by)

    def _tell_commander(self, operator: str) -> None:
        self._tell("commander", "", f"{operator} commands the fleet", operator)

    def _tell_shared_name(self) -> None:
        if not self.shares_name:
            text = "another ground station has this one's name: give one another with --name"
            self._tell("commander", "", text, self._setup.operator)
        self._name_shared_at_s = self._robots.now_s


def state_of_robots(setup: FleetSetup, statuses: list[RobotStatus], operator: str) -> GroundState:
    """State by a station that is not heard, as far as the robots that obey it show it."""
    idle = {str(s.robot_id): False for s in statuses if s.state is FlightState.IDLE}
    # Who is not heard yet may be in the air.
    enabled = bool(statuses) and len(idle) < len(setup.robots)
    # Of two fences that as many have, the configured one is not what the ground asked for.
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
