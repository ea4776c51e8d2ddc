"""Orders of a ground station; each is repeated until the robot answers or it expires."""

import math

from edge.messages.codes import Refusal, RefusalCode
from edge.messages.mission import ORDER_LIFETIME_S, Order, OrderKind, OrderResult, RobotStatus
from lpac.ground.station.statuses import RobotStatuses

# A robot refuses an order that expires later than the lifetime allows, or no later than the last
# order that it obeyed.
_EXPIRY_MARGIN_S = 0.5
_LATER_S = 1e-3
_RESULTS_KEPT = 1000


class Orders:
    """Pending orders, and in `results` the answers by order id.

    `prefix` distinguishes this station's orders from those before its restart.
    """

    def __init__(self, operator: str, robots: RobotStatuses) -> None:
        self.results: dict[str, OrderResult] = {}
        self.prefix = f"{operator}-{int(robots.unix_now_s * 1e3)}"
        self._operator = operator
        self._robots = robots
        self._made = 0
        self._pending: dict[str, tuple[Order, float]] = {}
        # Kills of second programs with a robot's id; their answers are not awaited.
        self._more_kills: list[tuple[Order, float]] = []
        self._expiries_s: dict[tuple[int, int], float] = {}

    @property
    def pending(self) -> tuple[Order, ...]:
        """Orders that are not answered yet."""
        return tuple(order for order, _ in (*self._pending.values(), *self._more_kills))

    def give(self, kind: OrderKind, robot_id: int, trial: str = "") -> str | None:
        """Add an order; return its id, for `results`. None if the robot was never heard."""
        last = self._robots.last(robot_id)
        if last is None:
            return None
        now_s = self._robots.now_s
        order = self._new(kind, *last, trial)
        self._pending[order.order_id] = order, now_s
        if kind == "kill":
            others = self._robots.others(robot_id)
            self._more_kills += [(self._new(kind, *other, trial), now_s) for other in others]
        return order.order_id

    def _new(self, kind: OrderKind, status: RobotStatus, age_s: float, trial: str) -> Order:
        """Order for the program that sent this status; its uptime has grown by `age_s` since."""
        self._made += 1
        program = status.robot_id, status.boot_nonce
        expiry_s = max(
            status.uptime_s + age_s + ORDER_LIFETIME_S - _EXPIRY_MARGIN_S,
            self._expiries_s.get(program, -math.inf) + _LATER_S,
        )
        self._expiries_s[program] = expiry_s
        return Order(f"{self.prefix}-{self._made}", *program, kind, expiry_s, self._operator, trial)

    def withdraw(self, order_id: str) -> None:
        """Stop repeating an order."""
        self._pending.pop(order_id, None)

    def interrupt(self, why: str) -> None:
        """Drop all orders but kills, since another station commands."""
        for order, _ in tuple(self._pending.values()):
            if order.kind != "kill":
                self._refuse(order.order_id, RefusalCode.INTERRUPTED, why)

    def receive(self, status: RobotStatus) -> None:
        """Settle orders that the status answers, or that can no longer be answered."""
        answers = {answer.order_id: answer for answer in status.orders}
        for order_id, (order, _) in list(self._pending.items()):
            if order.robot_id != status.robot_id:
                continue
            if status.boot_nonce != order.boot_nonce:
                self._refuse(order_id, RefusalCode.STARTED_AGAIN, "its program has restarted")
            elif order_id in answers:
                self._settle(answers[order_id])
            elif status.uptime_s > order.expires_at_uptime_s:
                self._refuse(order_id, RefusalCode.NOT_ANSWERED, "it did not answer")

    def expire(self) -> None:
        """Settle orders that have expired. Call periodically."""
        now_s = self._robots.now_s
        for order_id, (_, made_s) in list(self._pending.items()):
            if now_s - made_s > ORDER_LIFETIME_S + 1.0:
                self._refuse(order_id, RefusalCode.NOT_ANSWERED, "it did not answer")
        self._more_kills = [
            (order, made_s)
            for order, made_s in self._more_kills
            if now_s - made_s <= ORDER_LIFETIME_S
        ]

    def _refuse(self, order_id: str, code: RefusalCode, text: str) -> None:
        self._settle(OrderResult(order_id, Refusal(code, text)))

    def _settle(self, result: OrderResult) -> None:
        del self._pending[result.order_id]
        self.results[result.order_id] = result
        while len(self.results) > _RESULTS_KEPT:
            del self.results[next(iter(self.results))]
