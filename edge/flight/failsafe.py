"""PX4's failsafe parameters, and their required values.

Statements about PX4 hold for v1.14 and later. With its delay COM_FAIL_ACT_T, it holds before it
acts on a lost remote control or ground station, a critical battery, a failing motor or propeller,
and before the fence actions return and land. A lost offboard signal or position, and traffic, are
acted on at once.

No parameter controls the action on a lost position.
"""

import math
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field
from typing import Annotated, Literal

from msgspec import Meta

from edge.core.schema import Positive, require
from edge.core.vehicle import GPS_CONTROL

RemoteControl = Literal["pilot", "none"]
CommandTimeout = Annotated[float, Meta(gt=0.2, le=0.7)]
Parameters = Mapping[str, int | float | None]

# Altitude drifts by 1.6 m under velocity setpoints.
_CEILING_MARGIN_M = 2.0
_ROUNDING = 1e-6  # a REAL32 parameter holds 0.3 as 0.30000001

_NO_FAILSAFE = "fly on with the last command: NO FAILSAFE"
_STOP_MOTORS = "STOP ITS MOTORS and fall"
_LAND = "land"
_RETURN = "RETURN to where it was armed, at a height that all robots share"
_RETURN_AND_LAND = f"{_RETURN}; land when it is nearly empty"
# Actions that PX4 delays by a hold.
_DELAYED = (_LAND, _RETURN, _RETURN_AND_LAND)
_OFFBOARD_LOSS = {
    0: "hand over to the sticks, in position mode",
    1: "hand over to the sticks, in altitude mode",
    2: "hand over to the sticks, stabilized",
    3: _RETURN,
    4: "land where it is",
    5: "hold where it is",
    6: _STOP_MOTORS,
    7: _STOP_MOTORS,
}
_LINK_LOSS = {0: "do nothing", 1: "hold", 2: _RETURN, 3: _LAND, 5: _STOP_MOTORS, 6: _STOP_MOTORS}
_FENCE = {0: "do nothing", 1: "warn", 2: "hold", 3: _RETURN, 4: _STOP_MOTORS, 5: _LAND}
_BATTERY = {0: "warn, and fly until it falls", 1: _RETURN, 2: _LAND, 3: _RETURN_AND_LAND}
_REMOTE_CONTROL = {
    0: "only a remote control's sticks count",
    1: "only a ground station's sticks count",
    2: "a ground station's sticks count when the remote control is silent",
    3: "whoever moves sticks first, remote control or ground station, counts until a reboot",
    4: "no sticks count",
    5: "the remote control's sticks count, or a ground station's (the first before the second) "
    "while it is silent",
    6: "a ground station's sticks count (the first before the second), or the remote control's "
    "while they are silent",
    7: "the remote control's sticks count, or a ground station's (the second before the first) "
    "while it is silent",
    8: "a ground station's sticks count (the second before the first), or the remote control's "
    "while they are silent",
}
_HEIGHT = {0: "barometer", 1: "GPS", 2: "rangefinder", 3: "vision"}
_MOTOR_FAILURE = {0: "warn", 1: "hold", 2: _LAND, 3: _RETURN, 4: _STOP_MOTORS}
_PROPELLER = {-1: "do nothing", 0: "warn", 1: _RETURN, 2: _LAND}
_TRAFFIC = {0: "do nothing", 1: "warn", 2: _RETURN, 3: _LAND, 4: "hold"}
_REMAINING_TIME = {0: "do nothing", 1: "warn", 3: _RETURN}
_OVERRIDE = {
    0: "sticks never take over by themselves",
    1: "sticks take over, but not from offboard mode",
    2: "sticks take over from offboard mode only",
    3: "sticks take over from every mode",
}


@dataclass(frozen=True, slots=True)
class Requirement:
    """Requirement of one parameter: one of `values`, or above `above` and up to `up_to`.

    `value_to_set` has the parameter's own type (int or float); None if it must be set by hand,
    since it takes a reboot. `means` describes PX4's action for a value. With `may_be_absent`, a PX4
    without the parameter is just as safe.
    """

    name: str
    value_to_set: int | float | None
    values: tuple[int, ...] = ()
    _: KW_ONLY
    why: str
    above: float = math.inf
    up_to: float = math.inf
    means: Mapping[int, str] = field(default_factory=dict)
    may_be_absent: bool = False

    def allows(self, value: float) -> bool:
        """Whether PX4 may have this value."""
        return value in self.values or self.above < value <= self.up_to * (1.0 + _ROUNDING)

    def wanted(self) -> str:
        """Text of the allowed values."""
        options = [self._in_words(value) for value in self.values]
        if self.above < math.inf:
            up_to = f" and up to {self.up_to:g}" if self.up_to < math.inf else ""
            options.append(f"above {self.above:g}{up_to}")
        return " or ".join(options)

    def problem(self, value: float | None) -> str | None:
        """Text of the fault of the vehicle's value; None if there is none."""
        if value is None:
            if self.may_be_absent:
                return None
            return f"{self.name} is not known; wanted is {self.wanted()}: {self.why}"
        if self.allows(value):
            return None
        return f"{self.name} = {self._in_words(value)}; wanted is {self.wanted()}: {self.why}"

    def _in_words(self, value: float) -> str:
        meaning = self.means.get(int(value), "") if math.isfinite(value) else ""
        return f"{value:g} ({meaning})" if meaning else f"{value:g}"


def required(
    rc: RemoteControl, ceiling_m: float, command_timeout_s: float = 0.5
) -> tuple[Requirement, ...]:
    """Requirements of the vehicle's parameters.

    `rc` "pilot": somebody holds a remote control and may take the vehicle at any time; "none":
    there is none, and PX4 must not wait for one. `ceiling_m` is the fence's. `command_timeout_s` is
    the watchdog's, after which it makes a hanging robot hold; PX4 takes over later.

    Raises ValueError if one of them is out of range.
    """
    require(RemoteControl, rc, "rc")
    require(Positive, ceiling_m, "ceiling_m")
    require(CommandTimeout, command_timeout_s, "command_timeout_s")
    meet = "robots that return meet"
    would_meet = "returning robots would meet"
    return (
        Requirement("COM_OF_LOSS_T", 1.0, above=command_timeout_s + 0.2, up_to=1.5,
                    why="s without a command until PX4 takes over; the watchdog, which holds a "
                    "robot that hangs, comes first"),
        Requirement("COM_OBL_RC_ACT", 4, (4,), means=_OFFBOARD_LOSS,
                    why=f"a robot whose program died must land where it is; {meet}"),
        Requirement("COM_FAIL_ACT_T", 5.0, above=0.1, up_to=10.0,
                    why="s of hold before PX4 acts, in which sticks do not take over and the "
                    "battery drains"),
        Requirement("NAV_RCL_ACT", 3, (3, 1), means=_LINK_LOSS,
                    why=f"a robot that lost its remote control must stay where it is; {meet}"),
        *_remote_control(rc),
        Requirement("NAV_DLL_ACT", 0, (0,), means=_LINK_LOSS,
                    why="PX4 must not act on a MAVLink ground station; the fleet's ground is none"),
        Requirement("GF_ACTION", 2, (2, 5), means=_FENCE,
                    why=f"PX4's fence is the second line, and {meet}"),
        Requirement("GF_MAX_HOR_DIST", 0.0, (0,), means={0: "off"},
                    why="m from where it was armed: that circle may cut through the fence"),
        Requirement("GF_MAX_VER_DIST", 0.0, (0,), above=ceiling_m + _CEILING_MARGIN_M,
                    means={0: "off"},
                    why=f"m above where it was armed, clear of the ceiling of {ceiling_m:g} m"),
        Requirement("COM_LOW_BAT_ACT", 2, (2,), means=_BATTERY,
                    why=f"with a critical battery a robot must land where it is; {meet}"),
        Requirement("BAT_LOW_THR", 0.15, above=0.1, up_to=0.5,
                    why="share of the battery below which PX4 warns"),
        Requirement("BAT_CRIT_THR", 0.07, above=0.045, up_to=0.4,
                    why="share of the battery below which PX4 acts; a landing must fit into it"),
        Requirement("BAT_EMERGEN_THR", 0.05, above=0.02, up_to=0.3,
                    why="share of the battery that is PX4's last resort"),
        Requirement("COM_POS_LOW_ACT", 2, (2, 1, 0, 5), means=_FENCE, may_be_absent=True,
                    why=f"what PX4 does in hold when its position gets poor; {would_meet}"),
        Requirement("COM_ACT_FAIL_ACT", 2, (2, 1, 0), means=_MOTOR_FAILURE,
                    why=f"with a motor that fails a robot must land where it is; {meet}"),
        Requirement("COM_IMB_PROP_ACT", 0, (0, 2, -1), means=_PROPELLER,
                    why=f"what PX4 does when a propeller shakes the vehicle; {would_meet}"),
        Requirement("NAV_TRAFF_AVOID", 1, (1, 0, 4, 3), means=_TRAFFIC, may_be_absent=True,
                    why=f"what PX4 does when an ADS-B receiver reports traffic; {would_meet}"),
        Requirement("COM_WIND_MAX_ACT", 0, (0, 1, 2, 5), means=_FENCE, may_be_absent=True,
                    why=f"what PX4 does in a strong wind; {would_meet}"),
        Requirement("COM_FLTT_LOW_ACT", 1, (1, 0), means=_REMAINING_TIME, may_be_absent=True,
                    why="robots that return because the battery would just last meet"),
        Requirement("COM_FLT_TIME_MAX", -1, (-1, 0), means={-1: "never"}, may_be_absent=True,
                    why=f"s of flight after which PX4 returns; {meet}"),
        Requirement("COM_DISARM_LAND", 2.0, above=0.5, up_to=5.0,
                    why="s from a landing until the motors stop, late enough to be reported; "
                    "0 or less is never"),
        Requirement("COM_DISARM_PRFLT", 10.0, above=0.0, up_to=20.0,
                    why="s armed on the ground until the motors stop; 0 or less is never"),
        Requirement("COM_ARM_ON_BOOT", 0, (0,), may_be_absent=True,
                    means={1: "PX4 arms by itself after power-up"},
                    why="nothing but an order may start the motors"),
        Requirement("CBRK_FLIGHTTERM", 121212, (121212,),
                    why="with any other value PX4 may stop the motors in the air"),
        Requirement(GPS_CONTROL, 7, (7, 5, 13, 15),
                    why="the position comes from the GPS receiver; a robot has PX4 ignore one that "
                    "contradicts itself, and sets it back"),
        Requirement("EKF2_HGT_REF", None, (1, 0), means=_HEIGHT,
                    why="outdoors a height comes from nothing else; set it by hand, and reboot the "
                    "autopilot"),
    )  # fmt: skip


def _remote_control(rc: RemoteControl) -> tuple[Requirement, ...]:
    if rc == "none":
        return (
            Requirement("COM_RC_IN_MODE", 4, (4,), means=_REMOTE_CONTROL,
                        why="nobody has a remote control: PX4 must not miss one, nor obey a stray "
                        "one"),
        )  # fmt: skip
    return (
        Requirement("COM_RC_IN_MODE", 0, (0,), means=_REMOTE_CONTROL,
                    why="the pilot's remote control must be what PX4 obeys"),
        Requirement("COM_RCL_EXCEPT", 4, (4, 6),
                    why="a lost remote control must not end a mission (4), and need not end a hold "
                    "(6)"),
        Requirement("COM_RC_OVERRIDE", 3, (3,), means=_OVERRIDE,
                    why="moving the sticks must give the pilot the vehicle at once"),
    )  # fmt: skip


# All parameters used by `check` and `explain`, to read from the vehicle.
PARAMETERS = tuple(requirement.name for requirement in required("pilot", ceiling_m=1.0))


def check(requirements: tuple[Requirement, ...], parameters: Parameters) -> tuple[str, ...]:
    """One line for each fault of the vehicle's parameters; empty if there is none.

    A parameter that is missing from `parameters`, or None, is unknown.
    """
    problems = [
        problem
        for requirement in requirements
        if (problem := requirement.problem(parameters.get(requirement.name))) is not None
    ]
    names = ("BAT_LOW_THR", "BAT_CRIT_THR", "BAT_EMERGEN_THR")
    low, critical, emergency = (parameters.get(name) for name in names)
    if (
        low is not None
        and critical is not None
        and emergency is not None
        and not low > critical > emergency
    ):
        problems.append(
            f"BAT_LOW_THR = {low:g}, BAT_CRIT_THR = {critical:g}, BAT_EMERGEN_THR = "
            f"{emergency:g}: PX4 would warn after it acts; wanted is each below the one before"
        )
    return tuple(problems)


def explain(parameters: Parameters) -> tuple[str, ...]:
    """Describe this vehicle's reactions to failures by its parameters, one line each."""
    look_up = _LookUp(parameters)
    return (
        f"if this program dies, PX4 will: {_on_program_loss(look_up)}",
        f"if the remote control is lost, PX4 will: {_on_remote_control_loss(look_up)}",
        "if a ground station's heartbeats stop, PX4 will: "
        + look_up.delayed("NAV_DLL_ACT", _LINK_LOSS),
        f"if the battery runs low, PX4 will: {_on_battery(look_up)}",
        f"outside PX4's own fence, it will: {_on_fence(look_up)}",
        "if a motor fails, and PX4 notices, it will: "
        + look_up.delayed("COM_ACT_FAIL_ACT", _MOTOR_FAILURE),
        "if a propeller shakes the vehicle, PX4 will: "
        + look_up.delayed("COM_IMB_PROP_ACT", _PROPELLER),
        "if traffic comes near, by an ADS-B receiver, PX4 will: "
        + look_up.action("NAV_TRAFF_AVOID", _TRAFFIC),
        "if the position is lost, PX4 will: land, and drift with the wind while it does "
        "(no parameter changes that)",
        f"if the pilot moves the sticks: {_on_sticks(look_up)}",
        *_others(look_up),
    )


@dataclass(frozen=True, slots=True)
class _LookUp:
    parameters: Parameters

    def number(self, name: str) -> str:
        value = self.parameters.get(name)
        return f"{name} (not known)" if value is None else f"{value:g}"

    def percent(self, name: str) -> str:
        value = self.parameters.get(name)
        return f"{name} (not known)" if value is None else f"{100.0 * value:.3g} %"

    def setting(self, name: str) -> int | None:
        value = self.parameters.get(name)
        return None if value is None or not math.isfinite(value) else int(value)

    def action(self, name: str, actions: Mapping[int, str]) -> str:
        setting = self.setting(name)
        if setting is None:
            return f"NOT KNOWN, since {name} is not"
        return actions.get(setting, f"NOT KNOWN, since {name} = {setting} is not")

    def delayed(self, name: str, actions: Mapping[int, str]) -> str:
        """The action, preceded by a hold where PX4 delays it."""
        action = self.action(name, actions)
        delay_s = self.parameters.get("COM_FAIL_ACT_T")
        if action not in _DELAYED or (delay_s is not None and delay_s <= 0.1):
            return action
        return f"hold for {self.number('COM_FAIL_ACT_T')} s, then {action}"


def _on_program_loss(look_up: _LookUp) -> str:
    action = look_up.action("COM_OBL_RC_ACT", _OFFBOARD_LOSS)
    if look_up.setting("COM_OBL_RC_ACT") in (0, 1, 2):
        nobody = look_up.action("NAV_RCL_ACT", _LINK_LOSS | {0: _NO_FAILSAFE})
        action += f"; without a remote control {nobody}"
    text = f"{action}, {look_up.number('COM_OF_LOSS_T')} s after the last command"
    return text if _STOP_MOTORS in text else f"{text}; it obeys again when commands come"


def _on_remote_control_loss(look_up: _LookUp) -> str:
    if look_up.setting("COM_RC_IN_MODE") == 4:
        return "not notice, since it listens to none"
    action = look_up.delayed("NAV_RCL_ACT", _LINK_LOSS)
    exceptions = look_up.setting("COM_RCL_EXCEPT")
    if exceptions is None:
        return f"{action}; whether in offboard mode too is NOT KNOWN, since COM_RCL_EXCEPT is not"
    calm = [
        mode for bit, mode in ((4, "offboard"), (2, "hold, takeoff or land")) if exceptions & bit
    ]
    if not calm:
        return action
    return f"go on in {' and '.join(calm)} mode; else {action}"


def _on_battery(look_up: _LookUp) -> str:
    text = (
        f"warn below {look_up.percent('BAT_LOW_THR')}; below "
        f"{look_up.percent('BAT_CRIT_THR')} {look_up.delayed('COM_LOW_BAT_ACT', _BATTERY)}"
    )
    if look_up.setting("COM_FLTT_LOW_ACT") == 3:
        text += f"; {_RETURN} before that when it would just last"
    return text


def _on_fence(look_up: _LookUp) -> str:
    text = look_up.delayed("GF_ACTION", _FENCE)
    for name, where in (("GF_MAX_HOR_DIST", "away from"), ("GF_MAX_VER_DIST", "above")):
        limit = look_up.parameters.get(name)
        if limit is not None and limit > 0.0:
            text += f"; the same {limit:g} m {where} where it was armed"
    return text


def _on_sticks(look_up: _LookUp) -> str:
    if look_up.setting("COM_RC_IN_MODE") == 4:
        return "nothing, PX4 listens to none"
    return look_up.action("COM_RC_OVERRIDE", _OVERRIDE)


def _others(look_up: _LookUp) -> tuple[str, ...]:
    lines = []
    if look_up.setting("CBRK_FLIGHTTERM") not in (121212, None):
        lines.append(f"if PX4 takes the vehicle for lost, it will: {_STOP_MOTORS}")
    flight_s = look_up.parameters.get("COM_FLT_TIME_MAX")
    if flight_s is not None and flight_s > 0.0:
        lines.append(f"after {flight_s:g} s of flight, PX4 will: {_RETURN}")
    if look_up.setting("COM_ARM_ON_BOOT") == 1:
        lines.append("after power-up, PX4 will: ARM BY ITSELF")
    return tuple(lines)
