"""PX4's modes, what each needs, and what its failsafe parameters mean."""

from enum import Enum, IntEnum


class Mode(IntEnum):
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


# (main mode, sub mode). Nobody can ask for DESCEND, and who looks sees LAND.
CUSTOM_MODES = {
    Mode.MANUAL: (1, 0),
    Mode.ALTCTL: (2, 0),
    Mode.POSCTL: (3, 0),
    Mode.TAKEOFF: (4, 2),
    Mode.HOLD: (4, 3),
    Mode.RETURN: (4, 5),
    Mode.DESCEND: (4, 6),
    Mode.LAND: (4, 6),
    Mode.OFFBOARD: (6, 0),
    Mode.STABILIZED: (7, 0),
}
PILOTED = frozenset({Mode.MANUAL, Mode.ALTCTL, Mode.POSCTL, Mode.STABILIZED})
NEED_POSITION = frozenset(
    {Mode.POSCTL, Mode.HOLD, Mode.RETURN, Mode.OFFBOARD, Mode.TAKEOFF, Mode.LAND}
)
PREVENT_ARMING = frozenset({Mode.RETURN, Mode.DESCEND, Mode.LAND})
CAN_LEAVE_GROUND = frozenset({Mode.TAKEOFF, Mode.OFFBOARD}) | PILOTED


class Result(IntEnum):
    """MAV_RESULT."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4


class Action(IntEnum):
    """What a failsafe does, the gravest last."""

    NONE = 0
    WARN = 1
    POSCTL = 2
    HOLD = 3
    RETURN = 4
    LAND = 5
    DESCEND = 6
    STOP_MOTORS = 7


class Cause(Enum):
    """Why a failsafe acts."""

    OFFBOARD_LOST = "offboard signal lost"
    MANUAL_CONTROL_LOST = "manual control lost"
    GROUND_STATION_LOST = "ground station lost"
    BATTERY = "battery"
    BATTERY_SILENT = "battery silent"
    GEOFENCE = "geofence"
    POSITION_LOST = "position lost"


# For these there is COM_FAIL_ACT_T to take over; a mode that lost what it needs is left at once.
DELAYED = frozenset({Cause.MANUAL_CONTROL_LOST, Cause.GROUND_STATION_LOST, Cause.BATTERY})
# Another mode that somebody asks for does not end these.
NO_TAKEOVER = frozenset({Cause.OFFBOARD_LOST, Cause.POSITION_LOST})

ACTION_MODES = {
    Action.POSCTL: Mode.POSCTL,
    Action.HOLD: Mode.HOLD,
    Action.RETURN: Mode.RETURN,
    Action.LAND: Mode.LAND,
    Action.DESCEND: Mode.DESCEND,
}
# Parameter value -> action; a value that is missing does nothing.
LINK_LOSS_ACTIONS = {
    1: Action.HOLD,
    2: Action.RETURN,
    3: Action.LAND,
    5: Action.STOP_MOTORS,
    6: Action.STOP_MOTORS,
}
OFFBOARD_LOSS_ACTIONS = {
    3: Action.RETURN,
    4: Action.LAND,
    5: Action.HOLD,
    6: Action.STOP_MOTORS,
    7: Action.STOP_MOTORS,
}
FENCE_ACTIONS = {
    1: Action.WARN,
    2: Action.HOLD,
    3: Action.RETURN,
    4: Action.STOP_MOTORS,
    5: Action.LAND,
}
