"""Which failsafe of several acts, and when."""

import math
from collections.abc import Mapping

from sim.px4.modes import ACTION_MODES, DELAYED, NO_TAKEOVER, Action, Cause, Mode


class Failsafe:
    """What PX4 does of all that has gone wrong. `action` is what it does now."""

    def __init__(self) -> None:
        self.action = Action.NONE
        self._wanted: dict[Cause, Action] = {}
        self._acts_at_s = -math.inf
        self._taken_over = False

    @property
    def is_active(self) -> bool:
        """Whether it decides the mode."""
        return self.action > Action.WARN

    def reset(self) -> None:
        """The vehicle was armed or disarmed."""
        self.action = Action.NONE
        self._wanted = {}
        self._taken_over = False

    def take_over(self) -> bool:
        """Somebody asks for a mode; whether that ends a failsafe which was active."""
        ends = self.is_active and not self._taken_over
        self._taken_over = self._taken_over or ends
        return ends

    def decide(
        self,
        wanted: Mapping[Cause, Action],
        now_s: float,
        delay_s: float,
        *,
        intended_mode: Mode,
        position_valid: bool,
    ) -> Cause:
        """Set `action`; returns whose it is, any cause if there is none.

        `wanted` is what each cause calls for. `delay_s` is COM_FAIL_ACT_T: for so long the vehicle
        holds, for somebody to take it over.
        """
        if not any(wanted.values()):
            self._wanted, self.action = {}, Action.NONE
            return next(iter(wanted))
        for cause, action in wanted.items():
            if action >= Action.HOLD > self._wanted.get(cause, Action.NONE):
                self._taken_over = False
                if cause in DELAYED and self.action <= Action.HOLD and now_s >= self._acts_at_s:
                    self._acts_at_s = now_s + delay_s
        self._wanted = dict(wanted)
        worst = max(wanted, key=lambda cause: wanted[cause])
        action = wanted[worst]
        if action in (Action.RETURN, Action.LAND) and worst in DELAYED and now_s < self._acts_at_s:
            action = Action.HOLD
        if wanted[worst] is Action.RETURN and intended_mode in (Mode.LAND, Mode.RETURN):
            action = Action.WARN
        if action in ACTION_MODES and self._taken_over and worst not in NO_TAKEOVER:
            action = Action.WARN
        if action in ACTION_MODES and not position_valid:
            action = Action.DESCEND
        self.action = action
        return worst
