"""PX4's modes, what each needs, and what its failsafe parameters mean."""

from enum import IntEnum, StrEnum


class Px4Mode(IntEnum):
    """PX4's navigation states, by PX4's numbers."""

    MANUAL = 0
    ALTCTL = 1
    POSCTL = 2
    HOLD = 4
    RETURN = 5
    DESCEND = 12
    OFFBOARD = 14
    STABILIZED = 15
    TAKEOFF = 17
    LAND = 18


# (main mode, sub mode). DESCEND cannot be commanded, and is reported as LAND.
CUSTOM_MODES = {
    Px4Mode.MANUAL: (1, 0),
    Px4Mode.ALTCTL: (2, 0),
    Px4Mode.POSCTL: (3, 0),
    Px4Mode.TAKEOFF: (4, 2),
    Px4Mode.HOLD: (4, 3),
    Px4Mode.RETURN: (4, 5),
    Px4Mode.DESCEND: (4, 6),
    Px4Mode.LAND: (4, 6),
    Px4Mode.OFFBOARD: (6, 0),
    Px4Mode.STABILIZED: (7, 0),
}
# The commandable mode of each (main mode, sub mode).
MODE_BY_CUSTOM = {c: mode for mode, c in CUSTOM_MODES.items() if mode is not Px4Mode.DESCEND}
PILOTED = frozenset({Px4Mode.MANUAL, Px4Mode.ALTCTL, Px4Mode.POSCTL, Px4Mode.STABILIZED})
NEED_POSITION = frozenset(
    {Px4Mode.POSCTL, Px4Mode.HOLD, Px4Mode.RETURN, Px4Mode.OFFBOARD, Px4Mode.TAKEOFF, Px4Mode.LAND}
)
PREVENT_ARMING = frozenset({Px4Mode.RETURN, Px4Mode.DESCEND, Px4Mode.LAND})
CAN_LEAVE_GROUND = frozenset({Px4Mode.TAKEOFF, Px4Mode.OFFBOARD}) | PILOTED


class MavResult(IntEnum):
    """MAV_RESULT."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4


class FailsafeAction(IntEnum):
    """Actions of a failsafe, the most severe last."""

    NONE = 0
    WARN = 1
    POSCTL = 2
    HOLD = 3
    RETURN = 4
    LAND = 5
    DESCEND = 6
    STOP_MOTORS = 7


class FailsafeCause(StrEnum):
    """Why a failsafe acts."""

    OFFBOARD_LOST = "offboard signal lost"
    MANUAL_CONTROL_LOST = "manual control lost"
    GROUND_STATION_LOST = "ground station lost"
    BATTERY = "battery"
    BATTERY_SILENT = "battery silent"
    GEOFENCE = "geofence"
    POSITION_LOST = "position lost"


# These wait COM_FAIL_ACT_T for a takeover; a mode that lost its requirements is left at once.
DELAYED = frozenset(
    {FailsafeCause.MANUAL_CONTROL_LOST, FailsafeCause.GROUND_STATION_LOST, FailsafeCause.BATTERY}
)
# A mode command does not end these.
NO_TAKEOVER = frozenset({FailsafeCause.OFFBOARD_LOST, FailsafeCause.POSITION_LOST})

ACTION_MODES = {
    FailsafeAction.POSCTL: Px4Mode.POSCTL,
    FailsafeAction.HOLD: Px4Mode.HOLD,
    FailsafeAction.RETURN: Px4Mode.RETURN,
    FailsafeAction.LAND: Px4Mode.LAND,
    FailsafeAction.DESCEND: Px4Mode.DESCEND,
}
# Parameter value -> action; other values do nothing.
LINK_LOSS_ACTIONS = {
    1: FailsafeAction.HOLD,
    2: FailsafeAction.RETURN,
    3: FailsafeAction.LAND,
    5: FailsafeAction.STOP_MOTORS,
    6: FailsafeAction.STOP_MOTORS,
}
OFFBOARD_LOSS_ACTIONS = {
    3: FailsafeAction.RETURN,
    4: FailsafeAction.LAND,
    5: FailsafeAction.HOLD,
    6: FailsafeAction.STOP_MOTORS,
    7: FailsafeAction.STOP_MOTORS,
}
FENCE_ACTIONS = {
    1: FailsafeAction.WARN,
    2: FailsafeAction.HOLD,
    3: FailsafeAction.RETURN,
    4: FailsafeAction.STOP_MOTORS,
    5: FailsafeAction.LAND,
}
