"""`lpac ground` as a process, as an operator runs it."""

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
    """One `lpac ground`; a context, in which it runs. `subscriber` receives its reports.

    Its output goes to ground.log next to the fleet's file.
    """

    def __init__(self, fleet_toml: Path, fleet: str, name: str = "sim") -> None:
        """`fleet` is the fleet's name in its file, `name` the station's."""
        super().__init__(
            fleet_toml.with_name("ground.log"),
            "ground", "--fleet", str(fleet_toml), "--name", name,
        )  # fmt: skip
        self.fleet = fleet
        self._subscriber: GroundSubscriber | None = None

    def __enter__(self) -> Self:
        """Start it, and wait for its first report. Raises GroundError if it does not start."""
        try:
            self.start()
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    @property
    def subscriber(self) -> GroundSubscriber:
        """Subscriber to the ground station, while it runs."""
        assert self._subscriber is not None
        return self._subscriber

    def command(
        self, request: Request, meanwhile: Callable[[], None] = lambda: None
    ) -> CommandReport:
        """Send a command and wait for its report; `meanwhile` is called once a second.

        Raises GroundError.
        """
        return command(self.fleet, request, meanwhile=meanwhile)

    def start(self) -> None:
        """Start or restart it, with the state left on disk. Raises GroundError if it fails."""
        super().start()
        self._listen()

    def suspend(self) -> None:
        """Stop the process, like a sleeping laptop."""
        self.send_signal(signal.SIGSTOP)

    def wake(self) -> None:
        """Continue the process. Raises GroundError if it does not answer."""
        self.send_signal(signal.SIGCONT)
        self._listen()

    def _listen(self) -> None:
        """Connect again, since subscribers give up a silent ground station."""
        subscriber = self._connected()
        if self._subscriber is not None:
            self._subscriber.__exit__(None, None, None)
        self._subscriber = subscriber

    def _connected(self) -> GroundSubscriber:
        until_s = time.monotonic() + _START_WITHIN_S
        while True:
            try:
                return GroundSubscriber(self.fleet).__enter__()
            except GroundError:
                # The socket does not exist yet, and nothing signals when it does.
                if not self.running or time.monotonic() > until_s:
                    text = f"`lpac ground` does not start: {self.last_output()}"
                    raise GroundError(text) from None
                time.sleep(_TRY_AGAIN_S)

    def _end(self) -> None:
        if self._subscriber is not None:
            self._subscriber.__exit__(None, None, None)
        if self.running:
            self.terminate()
            if self.wait(_END_WITHIN_S) is None:
                self.kill()
        # The fleet is not flown again, so the state for a restart is not needed.
        path = socket_path(self.fleet)
        for left in (path, path.with_suffix(".state"), path.with_suffix(".world")):
            left.unlink(missing_ok=True)
