"""PX4's modes, what each needs, and what its failsafe parameters mean."""

from enum import Enum, IntEnum


class Mode(Enum):
    """PX4's custom modes: (main mode, sub mode)."""

    MANUAL = (1, 0)
    ALTCTL = (2, 0)
    POSCTL = (3, 0)
    TAKEOFF = (4, 2)
    HOLD = (4, 3)
    RETURN = (4, 5)
    LAND = (4, 6)
    OFFBOARD = (6, 0)
    STABILIZED = (7, 0)


PILOTED = frozenset({Mode.MANUAL, Mode.ALTCTL, Mode.POSCTL, Mode.STABILIZED})
NEED_POSITION = frozenset(Mode) - {Mode.MANUAL, Mode.ALTCTL, Mode.STABILIZED, Mode.LAND}
PREVENT_ARMING = frozenset({Mode.LAND, Mode.RETURN})
CAN_LEAVE_GROUND = frozenset({Mode.TAKEOFF, Mode.OFFBOARD}) | PILOTED


class Result(IntEnum):
    """MAV_RESULT."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3


class Action(IntEnum):
    """What a failsafe does, the gravest last."""

    NONE = 0
    WARN = 1
    POSCTL = 2
    HOLD = 3
    RETURN = 4
    LAND = 5
    STOP_MOTORS = 6


ACTION_MODES = {
    Action.POSCTL: Mode.POSCTL,
    Action.HOLD: Mode.HOLD,
    Action.RETURN: Mode.RETURN,
    Action.LAND: Mode.LAND,
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
