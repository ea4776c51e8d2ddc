"""Ports that programs bind later."""

import socket
import subprocess
import sys
from contextlib import ExitStack

import pytest

from lpac.sim.ports import free_ports
from tests.conftest import ROOT

TAKER = (
    "import sys; from lpac.sim.ports import free_ports; print(*free_ports(30), flush=True); input()"
)


def line_of(process: subprocess.Popen[str]) -> list[str]:
    assert process.stdout is not None
    return process.stdout.readline().split()


def test_no_port_is_given_to_two_processes_that_run() -> None:
    with ExitStack() as stack:
        takers = [
            stack.enter_context(
                subprocess.Popen(
                    [sys.executable, "-c", TAKER],
                    cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
                )
            )
            for _ in range(3)
        ]  # fmt: skip
        given = [int(port) for taker in takers for port in line_of(taker)]
        for taker in takers:
            taker.communicate("\n", timeout=60.0)
    given += free_ports(30)
    assert len(given) == len(set(given)) == 120


@pytest.mark.parametrize("kind", [socket.SOCK_DGRAM, socket.SOCK_STREAM])
def test_a_port_that_somebody_has_is_left_out(kind: socket.SocketKind) -> None:
    (first,) = free_ports(1)
    with socket.socket(socket.AF_INET, kind) as taken:
        taken.bind(("127.0.0.1", first + 1))
        assert free_ports(1) != (first + 1,)


def test_more_than_there_are() -> None:
    with pytest.raises(OSError, match="fewer than 1000 ports"):
        free_ports(1000)
