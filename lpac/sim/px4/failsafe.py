"""Selection and timing of PX4's failsafe actions."""

import math
from collections.abc import Mapping

from lpac.sim.px4.modes import (
    ACTION_MODES,
    DELAYED,
    NO_TAKEOVER,
    FailsafeAction,
    FailsafeCause,
    Px4Mode,
)


class Failsafe:
    """PX4's reaction to failures; `action` is the current one."""

    def __init__(self) -> None:
        self.action = FailsafeAction.NONE
        self._wanted: dict[FailsafeCause, FailsafeAction] = {}
        self._acts_at_s = -math.inf
        self._taken_over = False

    @property
    def is_active(self) -> bool:
        """Whether it determines the mode."""
        return self.action > FailsafeAction.WARN

    def reset(self) -> None:
        """Reset on arming or disarming."""
        self.end()
        self._taken_over = False

    def end(self) -> None:
        """Clear the action, as nothing is wrong."""
        self.action = FailsafeAction.NONE
        self._wanted = {}

    def take_over(self) -> bool:
        """Handle a mode command; returns whether it ends an active failsafe."""
        ends = self.is_active and not self._taken_over
        self._taken_over = self._taken_over or ends
        return ends

    def decide(
        self,
        wanted: Mapping[FailsafeCause, FailsafeAction],
        now_s: float,
        delay_s: float,
        *,
        intended_mode: Px4Mode,
        position_valid: bool,
    ) -> FailsafeCause:
        """Set `action`; returns its cause.

        `wanted` is the action for each cause; call `end` instead if there is none. `delay_s` is
        COM_FAIL_ACT_T: the vehicle first holds this long, to allow a takeover.
        """
        for cause, action in wanted.items():
            if action >= FailsafeAction.HOLD > self._wanted.get(cause, FailsafeAction.NONE):
                self._taken_over = False
                if (
                    cause in DELAYED
                    and self.action <= FailsafeAction.HOLD
                    and now_s >= self._acts_at_s
                ):
                    self._acts_at_s = now_s + delay_s
        self._wanted = dict(wanted)
        worst = max(wanted, key=lambda cause: wanted[cause])
        action = wanted[worst]
        if (
            action in (FailsafeAction.RETURN, FailsafeAction.LAND)
            and worst in DELAYED
            and now_s < self._acts_at_s
        ):
            action = FailsafeAction.HOLD
        if wanted[worst] is FailsafeAction.RETURN and intended_mode in (
            Px4Mode.LAND,
            Px4Mode.RETURN,
        ):
            action = FailsafeAction.WARN
        if action in ACTION_MODES and self._taken_over and worst not in NO_TAKEOVER:
            action = FailsafeAction.WARN
        if action in ACTION_MODES and not position_valid:
            action = FailsafeAction.DESCEND
        self.action = action
        return worst
