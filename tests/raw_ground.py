"""A ground's radio on which a test says what no ground of ours would say."""

import secrets
import time
from collections.abc import Callable, Sequence
from typing import Self

from edge.drivers.zenoh_link import ZenohLink
from edge.identity.guard import Unguarded
from edge.messages.codec import encode
from edge.messages.mission import (
    ORDER_LIFETIME_S,
    GroundState,
    Order,
    OrderKind,
    OrderResult,
    RobotStatus,
)
from edge.messages.topics import ORDER, STATE, WORLD, Link
from lpac.sim.fleet.listener import FleetListener, Statuses

PATIENCE_S = 60.0


class RawGround:
    """Says again and again what a test wants, until it shows; a context."""

    def __init__(self, fleet: str, connect: Sequence[str], heard: FleetListener) -> None:
        self._heard = heard
        self._radio = ZenohLink(fleet=fleet, listen=("tcp/127.0.0.1:0",), connect=connect)
        self._link: Link = Unguarded(int(1e3 * time.time())).wrap(self._radio)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._radio.close()

    def order(self, kind: OrderKind, to: RobotStatus, operator: str = "") -> OrderResult:
        """The answer of the program that said `to`; by default as if its commander ordered it."""
        order = Order(
            order_id=secrets.token_hex(6),
            robot_id=to.robot_id,
            boot_nonce=to.boot_nonce,
            kind=kind,
            expires_at_uptime_s=to.uptime_s + ORDER_LIFETIME_S / 2.0,
            operator=operator or to.operator,
        )
        answers: list[OrderResult] = []

        def answered(statuses: Statuses) -> bool:
            self._link.publish(ORDER, encode(order))
            said = [h.status for h in self._heard.history(to.robot_id)[-10:]]
            answers[:] = [a for s in said for a in s.orders if a.order_id == order.order_id]
            return bool(answers)

        assert self._heard.wait_for(answered, PATIENCE_S), (kind, self._heard.statuses())
        return answers[-1]

    def state_until(
        self, state: GroundState, condition: Callable[[Statuses], bool], world: str = ""
    ) -> None:
        """Publish a state, and a world's text, until that holds of the robots."""

        def holds(statuses: Statuses) -> bool:
            self._link.publish(STATE, encode(state))
            if world:
                self._link.publish(WORLD, world.encode())
            return condition(statuses)

        assert self._heard.wait_for(holds, PATIENCE_S), self._heard.statuses()
