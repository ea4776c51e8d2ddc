"""A ground station that a program commands, and the script of one whole flight.

It speaks what any ground speaks (`edge.messages.mission`), over zenoh, and knows of the robots only
what they say of themselves.
"""

import math
import queue
import secrets
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from types import TracebackType
from typing import NamedTuple, Self

from edge.core.fence import Fence
from edge.core.vehicle import PILOTED
from edge.drivers.zenoh_link import ZenohLink
from edge.flight.margins import ErrorBudget
from edge.messages.codec import MessageError, decode, encode
from edge.messages.codes import CheckCode, ReasonCode, Refusal, RefusalCode
from edge.messages.mission import (
    ON_GROUND,
    ORDER_LIFETIME_S,
    FlightState,
    GroundState,
    Order,
    OrderKind,
    OrderResult,
    Origin,
    Place,
    RobotStatus,
    SafetyAction,
    is_over_landing_point,
    is_too_low,
    waiting_to_land,
    world_id,
)
from edge.messages.topics import ORDER, STATE, STATUS, WORLD

PERIOD_S = 0.2
WORLD_PERIOD_S = 1.0
STATUS_LIFETIME_S = 2.0

Statuses = Mapping[int, RobotStatus]
Say = Callable[[str], None]

_S = FlightState


class Heard(NamedTuple):
    """A status, and the `time.monotonic()` when it came."""

    at_s: float
    status: RobotStatus


class Operator:
    """Publishes the ground's state at 5 Hz and repeats each order until it is answered; a context.

    Nothing is published before the first `enable` or `safety_action`. Every method may be called
    from any thread. `refusals` are the orders that robots refused, in words; `silent` stops all
    that is sent, as if the ground were gone.
    """

    def __init__(
        self,
        *,
        fleet: str,
        connect: Sequence[str],
        name: str = "script",
        say: Say = lambda _: None,
    ) -> None:
        """`connect` are the robots' endpoints; `say` is told each refusal, from another thread."""
        self.silent = False
        self.refusals: list[str] = []
        self._link_settings = (fleet, tuple(connect))
        self._name = name
        self._say = say
        self._changed = threading.Condition()
        self._arrived: queue.SimpleQueue[tuple[float, bytes] | None] = queue.SimpleQueue()
        self._heard: dict[int, list[Heard]] = {}
        self._state: GroundState | None = None
        self._world = b""
        self._world_at_s = -math.inf
        self._open: dict[str, Order] = {}
        self._results: dict[str, OrderResult] = {}
        self._link: ZenohLink | None = None
        self._thread = threading.Thread(target=self._run, name="operator", daemon=True)

    def __enter__(self) -> Self:
        """Raises LinkError."""
        fleet, connect = self._link_settings
        self._link = ZenohLink(
            fleet=fleet,
            listen=("tcp/127.0.0.1:0",),
            connect=connect,
            subscriptions={STATUS: lambda _, data: self._arrived.put((time.monotonic(), data))},
        )
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._arrived.put(None)
        self._thread.join()
        assert self._link is not None
        self._link.close()

    # What the robots say

    def statuses(self) -> dict[int, RobotStatus]:
        """The newest status of each robot that was heard within 2 s, by robot id."""
        earliest_s = time.monotonic() - STATUS_LIFETIME_S
        with self._changed:
            newest = {robot: heard[-1] for robot, heard in self._heard.items()}
        return {robot: heard.status for robot, heard in newest.items() if heard.at_s >= earliest_s}

    def history(self, robot: int) -> tuple[Heard, ...]:
        """Everything that a robot has said of itself, in order."""
        with self._changed:
            return tuple(self._heard.get(robot, ()))

    def forget(self) -> None:
        """Keep of each robot only what it said last."""
        with self._changed:
            for heard in self._heard.values():
                del heard[:-1]

    def wait_for(self, condition: Callable[[Statuses], bool], timeout_s: float) -> bool:
        """Wait until `condition` holds of the statuses; False if that took too long."""
        deadline_s = time.monotonic() + timeout_s
        while not condition(self.statuses()):
            left_s = deadline_s - time.monotonic()
            if left_s <= 0.0:
                return False
            with self._changed:
                # Who falls silent changes nothing here, so look again.
                self._changed.wait(min(left_s, PERIOD_S))
        return True

    # What it wants of them

    def enable(self, origin: Origin) -> None:
        """Set the mission's origin, and let the robots run their checks."""
        self._change(origin=origin, enabled=True)

    def assign(
        self,
        *,
        fence: Fence | None = None,
        places: Mapping[int, Place] | None = None,
        world: str | None = None,
    ) -> None:
        """What the next flights are to fly by; without it, what the robots are configured for.

        `places` are by robot id, `world` is a world file's text.
        """
        with self._changed:
            self._world = (world or "").encode()
        self._change(
            fence=fence,
            places={str(robot): place for robot, place in (places or {}).items()},
            world_id=None if world is None else world_id(world),
        )

    def disable(self) -> None:
        """Nothing is to fly: robots in the air hold."""
        self._change(enabled=False)

    def safety_action(self, safety_action: SafetyAction, *robots: int) -> None:
        """Ask the fleet, or these robots alone, to hold, return or land; "none" withdraws it."""
        if not robots:
            self._change(safety_action=safety_action, robot_safety_actions={})
            return
        with self._changed:
            asked = dict(self._state.robot_safety_actions) if self._state else {}
        self._change(robot_safety_actions=asked | {str(robot): safety_action for robot in robots})

    def safety_action_each(
        self, safety_action: SafetyAction, others: Mapping[int, SafetyAction]
    ) -> None:
        """Ask `safety_action` of the fleet, and something else of single robots."""
        self._change(
            safety_action=safety_action,
            robot_safety_actions={str(r): c for r, c in sorted(others.items())},
        )

    def order(self, kind: OrderKind, robot: int, trial: str = "") -> str:
        """Order something once; returns the order's id. It counts for 10 s of the robot's time."""
        order_id = secrets.token_hex(6)
        status = self.statuses().get(robot)
        if status is None:
            self._settle(
                OrderResult(order_id, Refusal(RefusalCode.NOT_ANSWERED, "the robot is not heard")),
                kind,
                robot,
            )
            return order_id
        with self._changed:
            self._open[order_id] = Order(
                order_id=order_id,
                robot_id=robot,
                boot_nonce=status.boot_nonce,
                kind=kind,
                expires_at_uptime_s=status.uptime_s + ORDER_LIFETIME_S,
                operator=self._name,
                trial=trial,
            )
        return order_id

    def ordered(self, robot: int) -> bool:
        """Whether an order for this robot is not answered yet."""
        with self._changed:
            return any(order.robot_id == robot for order in self._open.values())

    def result(self, order_id: str, timeout_s: float = 0.0) -> OrderResult | None:
        """What became of an order, within `timeout_s`; None as long as it is open."""
        with self._changed:
            self._changed.wait_for(lambda: order_id in self._results, timeout_s)
            return self._results.get(order_id)

    def _change(self, **changes: object) -> None:
        with self._changed:
            before = self._state or GroundState(sequence=0, operator=self._name)
            after = replace(before, **changes)  # type: ignore[arg-type]
            if after != before or self._state is None:
                self._state = replace(after, sequence=before.sequence + 1)

    # Its thread

    def _run(self) -> None:
        publish_at_s = time.monotonic()
        while True:
            try:
                arrived = self._arrived.get(timeout=max(0.0, publish_at_s - time.monotonic()))
            except queue.Empty:
                pass
            else:
                if arrived is None:
                    return
                self._take(*arrived)
            if time.monotonic() >= publish_at_s:
                publish_at_s = time.monotonic() + PERIOD_S
                self._publish()

    def _take(self, at_s: float, data: bytes) -> None:
        try:
            status = decode(RobotStatus, data)
        except MessageError as error:
            self._say(f"a status is malformed: {error}")
            return
        robot = status.robot_id
        with self._changed:
            self._heard.setdefault(robot, []).append(Heard(at_s, status))
            mine = [order for order in self._open.values() if order.robot_id == robot]
            self._changed.notify_all()
        answers = {answer.order_id: answer for answer in status.orders}
        for order in mine:
            answer = answers.get(order.order_id)
            restarted = status.boot_nonce != order.boot_nonce
            if answer is None and (restarted or status.uptime_s > order.expires_at_uptime_s):
                refusal = Refusal(RefusalCode.NOT_ANSWERED, "it was not answered")
                answer = OrderResult(order.order_id, refusal)
            if answer is not None:
                self._settle(answer, order.kind, robot)

    def _settle(self, result: OrderResult, kind: OrderKind, robot: int) -> None:
        with self._changed:
            self._open.pop(result.order_id, None)
            self._results[result.order_id] = result
            refused = result.refusal
            refusal = "" if refused is None else f"robot {robot} refuses {kind}: {refused.text}"
            if refusal:
                self.refusals.append(refusal)
            self._changed.notify_all()
        if refusal:
            self._say(refusal)

    def _publish(self) -> None:
        assert self._link is not None
        with self._changed:
            state, world, orders = self._state, self._world, tuple(self._open.values())
        if self.silent:
            return
        if state is not None:
            self._link.publish(STATE, encode(replace(state, unix_time_s=time.time())))
            lacking = any(s.world_id != state.world_id for s in self.statuses().values())
            if world and lacking and time.monotonic() - self._world_at_s >= WORLD_PERIOD_S:
                self._world_at_s = time.monotonic()
                self._link.publish(WORLD, world)
        for order in orders:
            self._link.publish(ORDER, encode(order))


# The script

_TAKEOFF_STAGGER_S = 2.0
_START_AGAIN_S = 3.0
# Until each robot has heard that the last one has taken off.
_SETTLE_S = 1.0
_EXPLAIN_AFTER_S = 8.0


class OperatorScriptError(RuntimeError):
    """The flight did not go as the script has it; the text says what did not happen."""


@dataclass(frozen=True, slots=True)
class OperatorStep:
    """What is done again and again until `done`, or until `at_most_s`; that is `late` then."""

    name: str
    at_most_s: float
    act: Callable[[], None]
    done: Callable[[Statuses], bool]
    late: str


class OperatorScript:
    """One flight of a fleet, from the first status to the last disarming.

    All take off within `takeoffs_window_s`; who came to hold on its way up tries again until then.
    `began_s` tells when each step began (`time.monotonic()`), `restarts` how often each robot that
    had come to hold by itself was ordered to start again.
    """

    def __init__(
        self,
        operator: Operator,
        *,
        robots: Collection[int],
        origin: Origin,
        mission_s: float,
        trial: str,
        takeoffs_window_s: float = ErrorBudget().takeoffs_window_s,
        say: Say = lambda _: None,
    ) -> None:
        """`say` is told what robots do that the script does not have."""
        self.began_s: dict[str, float] = {}
        self.restarts: Counter[int] = Counter()
        self._operator = operator
        self._robots = frozenset(robots)
        self._origin = origin
        self._trial = trial
        self._takeoffs_window_s = takeoffs_window_s
        self._say = say
        self._said: set[tuple[int, CheckCode | ReasonCode]] = set()
        self._last_takeoff_s = -math.inf
        self._last_start_s: dict[int, float] = {}
        self._over_landing_point: set[int] = set()
        n = len(self._robots)
        self.steps = (
            OperatorStep("assemble", 30.0 + 3.0 * n, lambda: None, self._all_heard,
            "were not heard"),
            OperatorStep("preflight", 60.0, self._enable, self._all_ready, "are not ready"),
            OperatorStep("takeoff", 45.0 + 3.0 * n, self._order_takeoff, self._all_up,
                 "did not come to hold at their heights"),
            OperatorStep("start", 20.0, self._order_start, self._all_in(_S.MISSION),
            "did not start"),
            OperatorStep("mission", mission_s, self._order_start, self._all_down, ""),
            OperatorStep("return", 150.0, self._send_home, self._all_down, "did not land"),
        )  # fmt: skip

    def fly(self, watch: Callable[[str], None] = lambda _: None) -> None:
        """Go through the steps; `watch` is called with the step's name, a few times a second.

        Raises ScriptError if a step takes too long: what is in the air has landed then, as far as
        it obeys. So does any other exception out of here, KeyboardInterrupt among them.
        """
        try:
            for step in self.steps:
                self._go(step, watch)
            if not self._all_heard(self._operator.statuses()):
                raise OperatorScriptError(f"{self._who_is_not(lambda _: True)} fell silent")
        except BaseException:
            self.land(watch)
            raise

    def land(self, watch: Callable[[str], None] = lambda _: None) -> None:
        """Land all robots where they are, and wait for it; for a minute at most."""
        if not any(s.armed for s in self._operator.statuses().values()):
            return
        self._operator.safety_action("land")
        self.began_s["land"] = time.monotonic()
        end_s = time.monotonic() + 60.0
        while not self._operator.wait_for(self._all_landed, PERIOD_S) and time.monotonic() < end_s:
            watch("land")

    def _go(self, step: OperatorStep, watch: Callable[[str], None]) -> None:
        began_s = self.began_s[step.name] = time.monotonic()
        while True:
            watch(step.name)
            step.act()
            left_s = began_s + step.at_most_s - time.monotonic()
            if self._operator.wait_for(step.done, min(PERIOD_S, max(0.0, left_s))):
                return
            if left_s <= 0.0:
                break
        if step.late:
            raise OperatorScriptError(f"{self._who_is_not(step.done)} {step.late}")

    def _who_is_not(self, done: Callable[[Statuses], bool]) -> str:
        """The robots that keep a step from being done, each with its state and its reason."""
        statuses = self._operator.statuses()
        # With the others taken for a robot's own kind, only that robot decides.
        late = [
            f"{robot} (not heard)"
            if status is None
            else f"{robot} ({status.state}: {status.reason.text})"
            for robot in sorted(self._robots)
            if (status := statuses.get(robot)) is None
            or not done(dict.fromkeys(self._robots, status))
        ]
        return f"robots {', '.join(late)}"

    # When a step is done

    def _all_heard(self, statuses: Statuses) -> bool:
        return self._robots <= statuses.keys()

    def _all(self, statuses: Statuses, holds: Callable[[RobotStatus], bool]) -> bool:
        return self._all_heard(statuses) and all(holds(statuses[r]) for r in self._robots)

    def _all_ready(self, statuses: Statuses) -> bool:
        return self._all(statuses, lambda s: s.state is _S.PREFLIGHT and s.ready)

    def _all_in(self, state: FlightState) -> Callable[[Statuses], bool]:
        return lambda statuses: self._all(statuses, lambda s: s.state is state)

    def _all_up(self, statuses: Statuses) -> bool:
        return self._all(statuses, lambda s: s.state is _S.HOLD and not is_too_low(s))

    def _all_down(self, statuses: Statuses) -> bool:
        """A robot that is not heard any more cannot be waited for."""
        return all(s.state in ON_GROUND and not s.armed for s in statuses.values())

    def _all_landed(self, statuses: Statuses) -> bool:
        """Whose vehicle does not answer any more lands nothing: it is not waited for."""
        return self._all_down({r: s for r, s in statuses.items() if s.state is not _S.FAULT})

    # What is done in a step

    def _enable(self) -> None:
        self._operator.enable(self._origin)
        if time.monotonic() - self.began_s["preflight"] > _EXPLAIN_AFTER_S:
            for robot, status in sorted(self._operator.statuses().items()):
                for check in status.failed_checks:
                    text = f"robot {robot} is not ready: {check.text}"
                    self._say_once((robot, check.code), text)

    def _order_takeoff(self) -> None:
        """The highest first: it climbs past nobody.

        Who came to hold on its way up is too low for a mission: it lands and takes off again.
        Raises ScriptError once it is too late for that.
        """
        statuses = [s for r, s in self._operator.statuses().items() if r in self._robots]
        low = [s for s in statuses if s.state is _S.LAND or (s.state is _S.HOLD and is_too_low(s))]
        first_s = max((s.flown_s or 0.0 for s in statuses), default=0.0)
        late = [s.robot_id for s in statuses if s in low or s.state in ON_GROUND]
        if late and first_s > self._takeoffs_window_s:
            raise OperatorScriptError(
                f"robots {', '.join(map(str, sorted(late)))} did not come to their heights, and "
                f"the first took off {first_s:.0f} s ago: too late to try again"
            )
        self._operator.safety_action_each("none", {status.robot_id: "land" for status in low})
        for status in sorted(statuses, key=lambda s: s.slot_height_m, reverse=True):
            if time.monotonic() - self._last_takeoff_s < _TAKEOFF_STAGGER_S:
                return
            if status.state is _S.PREFLIGHT and not self._operator.ordered(status.robot_id):
                self._operator.order("takeoff", status.robot_id)
                self._last_takeoff_s = time.monotonic()

    def _order_start(self) -> None:
        """Who holds is to start, and who left the mission is to come back; those are counted.

        A robot is in PILOT without a pilot after its vehicle left offboard by itself.
        """
        now_s = time.monotonic()
        if now_s - self.began_s["start"] < _SETTLE_S:
            return
        for robot, status in self._operator.statuses().items():
            last_s = self._last_start_s.get(robot, -math.inf)
            left_alone = status.state is _S.PILOT and status.mode not in PILOTED
            if not (status.state is _S.HOLD or left_alone) or self._operator.ordered(robot):
                continue
            if now_s - last_s < _START_AGAIN_S:
                continue
            if status.trial == self._trial:
                self.restarts[robot] += 1
                text = f"robot {robot} left the mission: {status.reason.text}"
                self._say_once((robot, status.reason.code), text)
            self._last_start_s[robot] = now_s
            self._operator.order("rejoin" if left_alone else "start", robot, self._trial)

    def _send_home(self) -> None:
        """All fly home at their own heights; who is there waits until nobody flies below."""
        statuses = self._operator.statuses()
        self._over_landing_point |= {
            robot for robot, status in statuses.items() if is_over_landing_point(status)
        }
        waiting = waiting_to_land(statuses, self._over_landing_point)
        self._operator.safety_action_each("return", dict.fromkeys(waiting, "hold"))

    def _say_once(self, what: tuple[int, CheckCode | ReasonCode], text: str) -> None:
        """Of one robot each thing once, whatever the numbers in its words are."""
        if what not in self._said:
            self._said.add(what)
            self._say(text)
