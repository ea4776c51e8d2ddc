"""Blocking subscriber to the ground process."""

import threading
import time
from collections.abc import Callable, Collection
from functools import partial
from typing import Self, TypeVar

from lpac.analysis.snapshot import FleetSetup, FleetSnapshot
from lpac.ground.procedure import NoSnapshotError, Procedure, Until, carry_out
from lpac.ground.station.client import command, no_answer, subscribe

_PATIENCE_S = 5.0

T = TypeVar("T")


class GroundSubscriber:
    """Context that keeps the newest setup and snapshot, in a thread of its own.

    Methods that wait raise GroundError once the ground process has ended. Thread-safe.
    """

    def __init__(self, fleet: str) -> None:
        self.fleet = fleet
        self._changed = threading.Condition()
        self._setup: FleetSetup | None = None
        self._snapshot: FleetSnapshot | None = None
        self._error: Exception | None = None
        self._leaving = False
        self._thread = threading.Thread(target=self._run, name="subscriber", daemon=True)

    def __enter__(self) -> Self:
        """Wait for the first snapshot. Raises GroundError if there is no ground process."""
        self._thread.start()
        if not self.wait_for(lambda _: True, _PATIENCE_S):
            self._leaving = True
            raise no_answer(self.fleet)
        return self

    def __exit__(self, *_: object) -> None:
        self._leaving = True
        # The thread ends with the next snapshot; without one, it is abandoned.
        self._thread.join(1.0)

    @property
    def setup(self) -> FleetSetup:
        """The newest setup."""
        assert self._setup is not None
        return self._setup

    @property
    def snapshot(self) -> FleetSnapshot:
        """The newest snapshot."""
        assert self._snapshot is not None
        return self._snapshot

    def wait_for(self, condition: Callable[[FleetSnapshot], bool], timeout_s: float) -> bool:
        """Wait until a snapshot meets `condition`; False after `timeout_s`."""
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
        """Run a procedure and return its result. Raises what it raises, and GroundError.

        `meanwhile` is called at least once a second; an exception from it ends the procedure.
        """

        def wait(wanted: Until) -> bool:
            def holds(snapshot: FleetSnapshot) -> bool:
                meanwhile()
                return wanted.condition(snapshot)

            return self.wait_for(holds, wanted.at_most_s)

        ask = partial(command, self.fleet, meanwhile=meanwhile)
        try:
            return carry_out(procedure, ask, wait)
        except NoSnapshotError:
            raise no_answer(self.fleet) from None

    def _run(self) -> None:
        try:
            with subscribe(self.fleet) as messages:
                for message in messages:
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
    """Robots that a command addresses: `robots`, or all with a slot if empty; in the fleet's order.

    Raises ValueError for an unknown name or if no robot has a slot.
    """
    for name in robots:
        if name not in setup.robots:
            raise ValueError(f"robot {name!r} is unknown; known are {', '.join(setup.robots)}")
    chosen = set(robots) or {site.robot for site in setup.slots if site.robot}
    if not chosen:
        raise ValueError(f"no robot of fleet {setup.fleet} has a slot")
    return tuple(name for name in setup.robots if name in chosen)
