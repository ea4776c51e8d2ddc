"""Orders of a ground station, each repeated until its robot has answered it or it has expired."""

import math

from edge.messages.codes import Refusal, RefusalCode
from edge.messages.mission import ORDER_LIFETIME_S, Order, OrderKind, OrderResult, RobotStatus
from lpac.ground.station.heard import HeardRobots

# A robot refuses an order that expires later than the lifetime, or not after one that it obeyed.
_EXPIRY_MARGIN_S = 0.5
_LATER_S = 1e-3
_RESULTS_KEPT = 1000


class Orders:
    """Pending orders, and in `results` the answers, by the orders' ids.

    `prefix` tells this station's orders from those of its former life.
    """

    def __init__(self, operator: str, robots: HeardRobots) -> None:
        self.results: dict[str, OrderResult] = {}
        self.prefix = f"{operator}-{int(robots.unix_now_s * 1e3)}"
        self._operator = operator
        self._robots = robots
        self._made = 0
        self._pending: dict[str, tuple[Order, float]] = {}
        # Kills of second programs of one robot: nobody waits for their answers.
        self._more_kills: list[tuple[Order, float]] = []
        self._expiries_s: dict[tuple[int, int], float] = {}

    @property
    def pending(self) -> tuple[Order, ...]:
        """Those that are not answered."""
        return tuple(order for order, _ in (*self._pending.values(), *self._more_kills))

    def give(self, kind: OrderKind, robot_id: int, trial: str = "") -> str | None:
        """Order something once; the order's id, for `results`. None if the robot was never heard.

        One that was silent since counts its uptime on.
        """
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
        """For the program that said the status so long ago."""
        self._made += 1
        program = status.robot_id, status.boot_nonce
        expiry_s = max(
            status.uptime_s + age_s + ORDER_LIFETIME_S - _EXPIRY_MARGIN_S,
            self._expiries_s.get(program, -math.inf) + _LATER_S,
        )
        self._expiries_s[program] = expiry_s
        return Order(f"{self.prefix}-{self._made}", *program, kind, expiry_s, self._operator, trial)

    def withdraw(self, order_id: str) -> None:
        """Say an order no more, if it is pending."""
        self._pending.pop(order_id, None)

    def interrupt(self, why: str) -> None:
        """Another station commands: no order counts any more but a kill."""
        for order, _ in tuple(self._pending.values()):
            if order.kind != "kill":
                self._refuse(order.order_id, RefusalCode.INTERRUPTED, why)

    def hear(self, status: RobotStatus) -> None:
        """Take a robot's answers; its program may have started again, or leave an order be."""
        answers = {answer.order_id: answer for answer in status.orders}
        for order_id, (order, _) in list(self._pending.items()):
            if order.robot_id != status.robot_id:
                continue
            if status.boot_nonce != order.boot_nonce:
                self._refuse(order_id, RefusalCode.STARTED_AGAIN, "its program has started again")
            elif order_id in answers:
                self._settle(answers[order_id])
            elif status.uptime_s > order.expires_at_uptime_s:
                self._refuse(order_id, RefusalCode.NOT_ANSWERED, "it did not answer")

    def expire(self) -> None:
        """Time has passed."""
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
