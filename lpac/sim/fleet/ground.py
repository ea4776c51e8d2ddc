"""`lpac ground` as a program beside the simulator, just as an operator runs it."""

import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Self

from lpac.ground.station.client import GroundError, command, socket_path
from lpac.ground.station.protocol import CommandReport, Request
from lpac.ground.station.subscriber import GroundSubscriber
from lpac.sim.programs import LpacProgram

_START_WITHIN_S = 60.0
_END_WITHIN_S = 10.0
_TRY_AGAIN_S = 0.05


class GroundProgram(LpacProgram):
    """One `lpac ground`; a context, in which it runs. `told` is what it tells its clients.

    What it prints is in ground.log beside the fleet's file.
    """

    def __init__(self, fleet_toml: Path, fleet: str, name: str = "sim") -> None:
        """`fleet` is the fleet's name in its file, `name` the station's."""
        super().__init__(
            fleet_toml.with_name("ground.log"),
            "ground", "--fleet", str(fleet_toml), "--name", name,
        )  # fmt: skip
        self.fleet = fleet
        self._told: GroundSubscriber | None = None

    def __enter__(self) -> Self:
        """Comes back once it tells of the fleet. Raises GroundError if it does not start."""
        try:
            self.start()
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    @property
    def told(self) -> GroundSubscriber:
        """Subscriber to the ground, as long as it runs."""
        assert self._told is not None
        return self._told

    def command(
        self, request: Request, meanwhile: Callable[[], None] = lambda: None
    ) -> CommandReport:
        """Have a command done, and wait for what came of it; `meanwhile` is called once a second.

        Raises GroundError.
        """
        return command(self.fleet, request, meanwhile=meanwhile)

    def start(self) -> None:
        """Start it, also again, on what it left on its disk. Raises GroundError if it does not."""
        super().start()
        self._listen()

    def suspend(self) -> None:
        """It stands still, like a laptop that sleeps."""
        self.send_signal(signal.SIGSTOP)

    def wake(self) -> None:
        """It goes on. Raises GroundError if it tells nothing then."""
        self.send_signal(signal.SIGCONT)
        self._listen()

    def _listen(self) -> None:
        """Start anew, since listeners give a silent ground up."""
        told = self._connected()
        if self._told is not None:
            self._told.__exit__(None, None, None)
        self._told = told

    def _connected(self) -> GroundSubscriber:
        until_s = time.monotonic() + _START_WITHIN_S
        while True:
            try:
                return GroundSubscriber(self.fleet).__enter__()
            except GroundError:
                # It is not open yet, and nothing tells when it is.
                if not self.running or time.monotonic() > until_s:
                    text = f"`lpac ground` does not start: {self.last_words()}"
                    raise GroundError(text) from None
                time.sleep(_TRY_AGAIN_S)

    def _end(self) -> None:
        if self._told is not None:
            self._told.__exit__(None, None, None)
        if self.running:
            self.terminate()
            if self.wait(_END_WITHIN_S) is None:
                self.kill()
        # Nobody flies this fleet again: what a ground leaves for the next one is not needed.
        path = socket_path(self.fleet)
        for left in (path, path.with_suffix(".state"), path.with_suffix(".world")):
            left.unlink(missing_ok=True)
