"""Subscriber to the ground, for programs that go step by step."""

import threading
import time
from collections.abc import Callable, Collection
from functools import partial
from typing import Self, TypeVar

from lpac.analysis.snapshot import FleetSetup, FleetSnapshot
from lpac.ground.procedure import NothingComesError, Procedure, Until, carry_out
from lpac.ground.station.client import command, no_answer, subscribe

_PATIENCE_S = 5.0

T = TypeVar("T")


class GroundSubscriber:
    """Keeps the newest of what the ground tells, in a thread of its own; a context.

    What waits raises GroundError once the ground has ended. Any thread may call anything.
    """

    def __init__(self, fleet: str) -> None:
        self.fleet = fleet
        self._changed = threading.Condition()
        self._setup: FleetSetup | None = None
        self._snapshot: FleetSnapshot | None = None
        self._error: Exception | None = None
        self._leaving = False
        self._thread = threading.Thread(target=self._run, name="lookout", daemon=True)

    def __enter__(self) -> Self:
        """Comes back with the first picture. Raises GroundError if there is no ground."""
        self._thread.start()
        if not self.wait_for(lambda _: True, _PATIENCE_S):
            self._leaving = True
            raise no_answer(self.fleet)
        return self

    def __exit__(self, *_: object) -> None:
        self._leaving = True
        # It notices with the next picture; if there comes none, it is left behind.
        self._thread.join(1.0)

    @property
    def setup(self) -> FleetSetup:
        """The fleet's setup, which seldom changes."""
        assert self._setup is not None
        return self._setup

    @property
    def snapshot(self) -> FleetSnapshot:
        """The fleet as it was told last."""
        assert self._snapshot is not None
        return self._snapshot

    def wait_for(self, condition: Callable[[FleetSnapshot], bool], timeout_s: float) -> bool:
        """Wait until `condition` holds of a picture; False if that took too long."""
        deadline_s = time.monotonic() + timeout_s
        with self._changed:
            while True:
                if self._error is not None:
                    raise self._error
                if self._setup and self._snapshot and condition(self._snapshot):
                    return True
                if not self._changed.wait(max(0.0, deadline_s - time.monotonic())):
                    return False

    @property
    def now_s(self) -> float:
        """The monotonic clock."""
        return time.monotonic()

    @property
    def unix_now_s(self) -> float:
        """The wall clock."""
        return time.time()

    def carry_out(self, procedure: Procedure[T], meanwhile: Callable[[], None] = lambda: None) -> T:
        """Go through a procedure; what it comes to. Raises what it raises, and GroundError.

        `meanwhile` is called once a second or more often; what it raises ends the procedure.
        """

        def wait(wanted: Until) -> bool:
            def holds(snapshot: FleetSnapshot) -> bool:
                meanwhile()
                return wanted.condition(snapshot)

            return self.wait_for(holds, wanted.at_most_s)

        ask = partial(command, self.fleet, meanwhile=meanwhile)
        try:
            return carry_out(procedure, ask, wait)
        except NothingComesError:
            raise no_answer(self.fleet) from None

    def _run(self) -> None:
        try:
            with subscribe(self.fleet) as told:
                for message in told:
                    if self._leaving:
                        return
                    with self._changed:
                        if isinstance(message, FleetSetup):
                            self._setup = message
                        elif isinstance(message, FleetSnapshot):
                            self._snapshot = message
                            self._changed.notify_all()
        except (OSError, ValueError) as error:
            with self._changed:
                self._error = error
                self._changed.notify_all()


def addressed(setup: FleetSetup, robots: Collection[str]) -> tuple[str, ...]:
    """The robots that a command addresses: these, or all that sit in a slot; in the fleet's order.

    Raises ValueError for a name that is unknown, or if there is nobody.
    """
    for name in robots:
        if name not in setup.robots:
            raise ValueError(f"robot {name!r} is unknown; known are {', '.join(setup.robots)}")
    chosen = set(robots) or {site.robot for site in setup.slots if site.robot}
    if not chosen:
        raise ValueError(f"no robot of fleet {setup.fleet} sits in a slot")
    return tuple(name for name in setup.robots if name in chosen)
