"""Run simulated vehicles in real time over UDP, all in one thread."""

import os
import selectors
import socket
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

from lpac.sim.px4.link import Px4Link

STEP_S = 0.02
# A process that was held up catches up to this much; time beyond that is skipped.
MAX_LATENESS_S = 0.5


@dataclass(frozen=True, slots=True)
class Instance:
    """A vehicle's link and its ports; PX4's are 14580 + i to listen and 14540 + i to send to."""

    link: Px4Link
    listen_port: int
    client_port: int


class Px4Server:
    """A context in which the vehicles run.

    Hold `stepped` to command a vehicle, or to set more than one of its fields. `started_s` is the
    `time.monotonic()` of the vehicles' time 0, plus the time skipped.
    """

    def __init__(self, instances: Sequence[Instance]) -> None:
        self.stepped = threading.Condition()
        self.started_s = 0.0
        self._instances = tuple(instances)
        self._sockets: list[socket.socket] = []
        self._selector = selectors.DefaultSelector()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="px4-server")

    def __enter__(self) -> "Px4Server":
        """Start the vehicles. Raises OSError if a port is taken."""
        for instance in self._instances:
            udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._sockets.append(udp)
            udp.setblocking(False)
            try:
                udp.bind(("127.0.0.1", instance.listen_port))
            except OSError:
                self._close()
                raise
            self._selector.register(udp, selectors.EVENT_READ, instance.link)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self._close()

    def wait_for(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Wait until `condition` holds after a step; False on timeout."""
        with self.stepped:
            return self.stepped.wait_for(condition, timeout_s)

    def _close(self) -> None:
        self._selector.close()
        for udp in self._sockets:
            udp.close()

    def _run(self) -> None:
        _run_before_all_others()
        self.started_s = time.monotonic()
        next_step_s = self.started_s + STEP_S
        while not self._stop.is_set():
            now_s = time.monotonic()
            if now_s < next_step_s:
                self._receive(next_step_s - now_s)
                continue
            # Receive even when always late: without setpoints the vehicles would land.
            self._receive(0.0)
            left_out_s = max(0.0, now_s - next_step_s - MAX_LATENESS_S)
            self.started_s += left_out_s
            next_step_s += left_out_s + STEP_S
            with self.stepped:
                self._step()
                self.stepped.notify_all()

    def _receive(self, timeout_s: float) -> None:
        for key, _ in self._selector.select(timeout_s):
            assert isinstance(key.fileobj, socket.socket)
            with self.stepped:
                self._drain(key.fileobj, key.data)

    @staticmethod
    def _drain(udp: socket.socket, link: Px4Link) -> None:
        while True:
            try:
                datagram = udp.recv(2048)
            except BlockingIOError:
                return
            except ConnectionRefusedError:
                # The client did not listen when an earlier datagram was sent.
                continue
            link.receive(datagram)

    def _step(self) -> None:
        for instance, udp in zip(self._instances, self._sockets, strict=True):
            instance.link.vehicle.step(STEP_S)
            for datagram in instance.link.due():
                self._send(udp, datagram, instance.client_port)

    def _send(self, udp: socket.socket, datagram: bytes, port: int) -> None:
        try:
            udp.sendto(datagram, ("127.0.0.1", port))
        except (BlockingIOError, ConnectionRefusedError):
            # UDP: datagrams without a receiver are lost.
            return


def _run_before_all_others() -> None:
    """Give this thread real-time priority, if allowed: a real autopilot has its own processor.

    Otherwise vehicles would fall silent on a busy machine, which real ones never do.
    """
    if sys.platform == "linux":
        with suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
