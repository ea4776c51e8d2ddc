"""What the operator's orders ask for: where each is taken, and why it is refused.

`ORDERS` says it of each kind; docs/safety.md shows the same table to people.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

from edge.flight.alarms import failsafe, position_not_good, remote_control_lost, too_close
from edge.flight.state import FlightInputs, FlightMemory, Robot, Tick
from edge.messages.mission import (
    AIRBORNE,
    AT_SLOT_M,
    ORDER_LIFETIME_S,
    FlightState,
    Order,
    OrderKind,
    OrderResult,
)

_S = FlightState

_ANSWERS_KEPT = 8

_Check = Callable[[Tick], str | None]


@dataclass(frozen=True, slots=True, kw_only=True)
class OrderRule:
    """Where one kind of order is taken, and what it does besides the transition that it leads to.

    Each check says why the order is refused, or None: `first` whatever the state is, `checks` where
    it is taken. `from_anybody`: who commands, and what was obeyed before, does not matter.
    `moves_nothing`: it is obeyed even if a transition comes before it. `arms`: the vehicle is then
    armed in the name of whoever ordered it. `trial`: a mission begins by it, or none has begun.
    """

    taken_in: tuple[FlightState, ...]
    first: tuple[_Check, ...] = ()
    checks: tuple[_Check, ...] = ()
    from_anybody: bool = False
    moves_nothing: bool = False
    arms: bool = False
    trial: Literal["kept", "begins", "forgotten"] = "kept"


def _ground_commands(t: Tick) -> str | None:
    action = t.safety_action
    return None if action == "none" else f"the ground commands {action}"


def _cannot_disarm(t: Tick) -> str | None:
    vehicle = t.inputs.vehicle
    arming = t.flight.state is _S.ARMING  # It may be armed before that is heard.
    if vehicle.armed is False and not arming:
        return "is not armed"
    if vehicle.in_air:
        return "in the air: land it first"
    known = arming or (vehicle.armed and vehicle.in_air is False)
    return None if known else "not known to be armed, and on the ground"


def _not_ready(t: Tick) -> str | None:
    failed = t.inputs.failed_checks
    if failed is None:
        return "not ready: the checks are still running"
    return f"not ready: {'; '.join(failed)}" if failed else None


def _not_in_place(t: Tick) -> str | None:
    """Why the mission cannot be flown from here."""
    odometry, height = t.inputs.odometry, t.height_m
    vehicle = t.inputs.vehicle
    if not t.knows_place:
        return position_not_good(t)
    if odometry is None or height is None:
        return "position or height is not known"
    if not (vehicle.armed and vehicle.in_air):
        return "the vehicle is not in the air"
    if t.failsafe_acts:
        return failsafe(t)
    slot_height_m = t.robot.parameters.slot_height_m
    if abs(height - slot_height_m) > AT_SLOT_M:
        return f"at {height:.1f} m; its height is {slot_height_m:g} m (within {AT_SLOT_M:g} m)"
    x_m, y_m, _ = odometry.position_m
    if t.robot.fence.distance_m(x_m, y_m) <= 0.0:
        return f"outside the fence, at ({x_m:.1f}, {y_m:.1f}) m"
    return None


def _cannot_start(t: Tick) -> str | None:
    if not t.flight.reached:
        return "the autopilot is not in offboard yet"
    if t.inputs.policy_velocity_m_s is None:
        return "the policy has no fresh answer"
    if t.inputs.not_taken:
        return "; ".join(t.inputs.not_taken)
    if t.robot.on_remote_control_lost in ("hold", "land") and (lost := remote_control_lost(t)):
        return lost
    if t.inputs.busy_neighbours:
        busy = ", ".join(map(str, t.inputs.busy_neighbours))
        return f"robots still taking off: {busy}"
    return too_close(t)


ORDERS: Mapping[OrderKind, OrderRule] = {
    "takeoff": OrderRule(
        taken_in=(_S.PREFLIGHT,), checks=(_ground_commands, _not_ready), arms=True
    ),
    "start": OrderRule(
        taken_in=(_S.HOLD,), checks=(_ground_commands, _not_in_place, _cannot_start),
        trial="begins",
    ),
    # PILOT too, since there it is so already.
    "pilot": OrderRule(taken_in=(_S.HOLD, _S.MISSION, _S.RETURN, _S.PILOT)),
    "rejoin": OrderRule(taken_in=(_S.PILOT,), checks=(_ground_commands, _not_in_place)),
    "reset": OrderRule(
        taken_in=tuple(s for s in _S if s not in (_S.ARMING, _S.TAKEOFF, _S.MISSION)),
        moves_nothing=True, trial="forgotten",
    ),
    "disarm": OrderRule(taken_in=(_S.ARMING, *AIRBORNE, _S.PILOT), first=(_cannot_disarm,)),
    "kill": OrderRule(taken_in=tuple(_S), from_anybody=True),
}  # fmt: skip


def new_order(robot: Robot, flight: FlightMemory, inputs: FlightInputs) -> Order | None:
    """The tick's order, unless it is another robot's, or was answered before."""
    order = inputs.order
    if order is None or order.robot_id != robot.robot_id:
        return None
    return None if any(a.order_id == order.order_id for a in flight.answers) else order


def refusal(t: Tick, order: Order) -> str | None:
    """Why the order is refused; None if it is taken."""
    if order.boot_nonce != t.robot.boot_nonce:
        return "meant for another start of this robot's program"
    left_s = order.expires_at_uptime_s - t.inputs.uptime_s
    if not 0.0 <= left_s <= ORDER_LIFETIME_S:
        return "expired" if left_s < 0.0 else f"would be valid for {left_s:.0f} s: too long"
    rule, ground = ORDERS[order.kind], t.inputs.ground
    if rule.from_anybody:
        return None
    if ground is not None and order.operator != ground.operator:
        return f"{ground.operator} commands, not {order.operator}"
    first = _first_problem(t, rule.first)
    if first is not None:
        return first
    state, sources = t.flight.state, rule.taken_in
    if state not in sources:
        alone = f"taken in {sources[0]} only, the robot is" if len(sources) == 1 else "not taken"
        return f"{order.kind} is {alone} in {state}: {t.flight.reason}"
    if order.expires_at_uptime_s <= t.flight.obeyed_expiry_s:
        return "older than an order that was obeyed"
    if t.silent:
        return "the control loop was silent just before"
    if not t.ground_heard:
        return "the ground's state is not heard"
    return _first_problem(t, rule.checks)


def answered(flight: FlightMemory, order: Order, refused: str | None) -> FlightMemory:
    """The memory, with the order's answer in it; `refused` is None if it was obeyed."""
    answer = OrderResult(order.order_id, refused is None, refused or "")
    expiry_s = flight.obeyed_expiry_s
    if refused is None:
        expiry_s = max(expiry_s, order.expires_at_uptime_s)
    answers = (*flight.answers, answer)[-_ANSWERS_KEPT:]
    return replace(flight, answers=answers, obeyed_expiry_s=expiry_s)


def obeyed(flight: FlightMemory, order: Order) -> tuple[FlightMemory, bool]:
    """The memory after an order that was obeyed, and whether its trial is a new one."""
    rule = ORDERS[order.kind]
    if rule.arms:
        flight = replace(flight, armed_by=order.operator)
    if rule.trial == "kept":
        return flight, False
    if rule.trial == "forgotten":
        return replace(flight, trial=""), True
    return replace(flight, trial=order.trial), order.trial != flight.trial


def _first_problem(t: Tick, checks: tuple[_Check, ...]) -> str | None:
    return next((problem for check in checks if (problem := check(t)) is not None), None)
