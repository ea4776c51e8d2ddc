"""The operator's orders: states in which each is accepted, and reasons of refusals.

`ORDERS` has a rule for each kind; docs/safety.md shows the same table.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

from msgspec.structs import replace

from edge.flight.alarms import (
    failsafe,
    policy_stale,
    position_doubtful,
    position_lost,
    remote_control_lost,
    too_close,
)
from edge.flight.state import FlightInputs, FlightMemory, Robot, Tick
from edge.messages.codes import CheckCode, Refusal, RefusalCode, texts
from edge.messages.mission import (
    AIRBORNE,
    AT_SLOT_M,
    ORDER_LIFETIME_S,
    FlightState,
    Order,
    OrderResult,
)

_S = FlightState

_ANSWERS_KEPT = 8

_Check = Callable[[Tick], Refusal | None]


@dataclass(frozen=True, slots=True, kw_only=True)
class OrderRule:
    """States that accept one kind of order, and its effects besides the transition.

    Each check gives a reason of refusal, or None: `first` in any state, `checks` where it is
    accepted. `from_anybody`: independent of the commander and of earlier orders. `moves_nothing`:
    obeyed even if another transition comes first. `arms`: the vehicle is armed in the operator's
    name. `trial`: the order's effect on the mission.
    """

    states: tuple[FlightState, ...]
    first: tuple[_Check, ...] = ()
    checks: tuple[_Check, ...] = ()
    from_anybody: bool = False
    moves_nothing: bool = False
    arms: bool = False
    trial: Literal["kept", "begins", "forgotten"] = "kept"


def _other_release(t: Tick) -> Refusal | None:
    release = t.inputs.other_release
    text = f"the ground flies another release ({release}) than this robot: deploy one to all"
    return Refusal(RefusalCode.OTHER_RELEASE, text) if release else None


def _ground_commands(t: Tick) -> Refusal | None:
    action = t.safety_action
    if action == "none":
        return None
    return Refusal(RefusalCode.GROUND_COMMANDS, f"the ground commands {action}")


def _cannot_disarm(t: Tick) -> Refusal | None:
    vehicle = t.inputs.vehicle
    arming = t.flight.state is _S.ARMING  # it may be armed before that is reported
    if vehicle.armed is False and not arming:
        return Refusal(RefusalCode.NOT_ARMED, "is not armed")
    if t.in_air:
        return Refusal(RefusalCode.IN_THE_AIR, "in the air: land it first")
    known = arming or (vehicle.armed and t.in_air is False)
    if known:
        return None
    return Refusal(RefusalCode.ARMED_NOT_KNOWN, "not known to be armed, and on the ground")


def _not_ready(t: Tick) -> Refusal | None:
    failed = t.inputs.failed_checks
    if failed is None:
        return Refusal(RefusalCode.CHECKS_RUNNING, "not ready: the checks are still running")
    return Refusal(RefusalCode.NOT_READY, f"not ready: {texts(failed)}") if failed else None


def _not_a_member(t: Tick) -> Refusal | None:
    """The one preflight check without which a flight goes on, but no mission begins."""
    failed = [c for c in t.inputs.failed_checks or () if c.code is CheckCode.NOT_A_MEMBER]
    return Refusal(RefusalCode.NOT_READY, texts(failed)) if failed else None


def _not_in_place(t: Tick) -> Refusal | None:
    """Reason why the mission cannot be flown from here."""
    odometry, height = t.inputs.odometry, t.height_m
    vehicle = t.inputs.vehicle
    if doubtful := position_lost(t) or position_doubtful(t):
        return Refusal(RefusalCode.POSITION_NOT_GOOD, doubtful)
    if odometry is None or height is None:
        return Refusal(RefusalCode.PLACE_NOT_KNOWN, "position or height is not known")
    if not (vehicle.armed and t.in_air):
        return Refusal(RefusalCode.NOT_IN_THE_AIR, "the vehicle is not in the air")
    if acts := failsafe(t):
        return Refusal(RefusalCode.FAILSAFE, acts)
    slot_height_m = t.robot.parameters.slot_height_m
    if abs(height - slot_height_m) > AT_SLOT_M:
        return Refusal(
            RefusalCode.NOT_AT_HEIGHT,
            f"at {height:.1f} m; its height is {slot_height_m:g} m (within {AT_SLOT_M:g} m)",
        )
    x_m, y_m, _ = odometry.position_m
    if t.robot.fence.distance_m(x_m, y_m) <= 0.0:
        return Refusal(RefusalCode.OUTSIDE_FENCE, f"outside the fence, at ({x_m:.1f}, {y_m:.1f}) m")
    return None


def _cannot_start(t: Tick) -> Refusal | None:
    if not t.flight.reached:
        return Refusal(RefusalCode.NOT_IN_OFFBOARD, "the autopilot is not in offboard yet")
    if stale := policy_stale(t):
        return Refusal(RefusalCode.POLICY_STALE, stale)
    if t.inputs.not_taken:
        return Refusal(RefusalCode.NOT_TAKEN_UP, texts(t.inputs.not_taken))
    if t.robot.on_remote_control_lost in ("hold", "land") and (lost := remote_control_lost(t)):
        return Refusal(RefusalCode.REMOTE_CONTROL_LOST, lost)
    if t.inputs.busy_neighbours:
        busy = ", ".join(map(str, t.inputs.busy_neighbours))
        return Refusal(RefusalCode.OTHERS_TAKE_OFF, f"robots still taking off: {busy}")
    near = too_close(t)
    return None if near is None else Refusal(RefusalCode.TOO_CLOSE, near)


ORDERS: Mapping[str, OrderRule] = {
    "takeoff": OrderRule(
        states=(_S.PREFLIGHT,), checks=(_other_release, _ground_commands, _not_ready), arms=True
    ),
    "start": OrderRule(
        states=(_S.HOLD,),
        checks=(_other_release, _ground_commands, _not_a_member, _not_in_place, _cannot_start),
        trial="begins",
    ),
    # Also in PILOT, where it has no effect.
    "pilot": OrderRule(states=(_S.HOLD, _S.MISSION, _S.RETURN, _S.PILOT)),
    "rejoin": OrderRule(
        states=(_S.PILOT,), checks=(_other_release, _ground_commands, _not_in_place)
    ),
    "reset": OrderRule(
        states=tuple(s for s in _S if s not in (_S.ARMING, _S.TAKEOFF, _S.MISSION)),
        moves_nothing=True, trial="forgotten",
    ),
    "disarm": OrderRule(states=(_S.ARMING, *AIRBORNE, _S.PILOT), first=(_cannot_disarm,)),
    "kill": OrderRule(states=tuple(_S), from_anybody=True),
}  # fmt: skip


def new_order(robot: Robot, flight: FlightMemory, inputs: FlightInputs) -> Order | None:
    """The tick's order, unless it is for another robot or was answered before."""
    order = inputs.order
    if order is None or order.robot_id != robot.robot_id:
        return None
    return None if any(a.order_id == order.order_id for a in flight.answers) else order


def refusal(t: Tick, order: Order) -> Refusal | None:
    """Reason of a refusal; None if the order is accepted."""
    if order.boot_nonce != t.robot.boot_nonce:
        return Refusal(RefusalCode.OTHER_START, "meant for another start of this robot's program")
    left_s = order.expires_at_uptime_s - t.inputs.uptime_s
    if not 0.0 <= left_s <= ORDER_LIFETIME_S:
        if left_s < 0.0:
            return Refusal(RefusalCode.EXPIRED, "expired")
        text = f"would be valid for {left_s:.0f} s: too long"
        return Refusal(RefusalCode.VALID_TOO_LONG, text)
    rule, ground = ORDERS.get(order.kind), t.inputs.ground
    if rule is None:
        return Refusal(RefusalCode.NOT_UNDERSTOOD, f"this program does not understand {order.kind}")
    if rule.from_anybody:
        return None
    if ground is not None and order.operator != ground.operator:
        return Refusal(
            RefusalCode.OTHER_COMMANDER, f"{ground.operator} commands, not {order.operator}"
        )
    first = _first_problem(t, rule.first)
    if first is not None:
        return first
    state = t.flight.state
    if state not in rule.states:
        only = len(rule.states) == 1
        where = f"accepted in {rule.states[0]} only; the robot is" if only else "not accepted"
        return Refusal(
            RefusalCode.WRONG_STATE, f"{order.kind} is {where} in {state}: {t.flight.reason.text}"
        )
    if order.expires_at_uptime_s <= t.flight.obeyed_expiry_s:
        return Refusal(RefusalCode.OLDER, "older than an order that was obeyed")
    if t.silent:
        return Refusal(RefusalCode.CONTROL_SILENT, "the control loop was silent just before")
    if not t.ground_heard:
        return Refusal(RefusalCode.GROUND_NOT_HEARD, "the ground's state is not heard")
    return _first_problem(t, rule.checks)


def answered(flight: FlightMemory, order: Order, refused: Refusal | None) -> FlightMemory:
    """The memory with the order's answer; `refused` is None if it was obeyed."""
    answer = OrderResult(order.order_id, refused)
    expiry_s = flight.obeyed_expiry_s
    if refused is None:
        expiry_s = max(expiry_s, order.expires_at_uptime_s)
    answers = (*flight.answers, answer)[-_ANSWERS_KEPT:]
    return replace(flight, answers=answers, obeyed_expiry_s=expiry_s)


def obeyed(flight: FlightMemory, order: Order) -> tuple[FlightMemory, bool]:
    """The memory after an obeyed order, and whether its trial is new."""
    rule = ORDERS[order.kind]
    if rule.arms:
        flight = replace(flight, armed_by=order.operator)
    if rule.trial == "kept":
        return flight, False
    if rule.trial == "forgotten":
        return replace(flight, trial=""), True
    return replace(flight, trial=order.trial), order.trial != flight.trial


def _first_problem(t: Tick, checks: tuple[_Check, ...]) -> Refusal | None:
    return next((problem for check in checks if (problem := check(t)) is not None), None)
