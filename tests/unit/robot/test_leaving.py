"""How a robot's program ends, and what it tells of its threads meanwhile."""

import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from edge.robot.process import _Program
from tests.said import lines_said


def nothing(*_: Any) -> None:
    pass


def program_of(update_identity: Callable[..., None] | None = None, **steps: Any) -> _Program:
    """Make a program whose node does nothing in steps other than these."""
    names = ("control", "perception", "policy", "preflight", "status")
    node: Any = SimpleNamespace(
        **{f"{name}_step": nothing for name in names} | steps,
        leave=nothing,
        identity_problem="",
        on_ground=True,
    )
    config: Any = SimpleNamespace(
        rates=SimpleNamespace(control_hz=10.0, perception_hz=5.0, policy_hz=2.5), on_stop="land"
    )
    recorder: Any = SimpleNamespace(flush=nothing)
    rest: Any = SimpleNamespace()
    return _Program(config, node, rest, rest, recorder, rest, update_identity)


def test_an_unwritable_identity_is_an_alarm_and_logged_once() -> None:
    problems: list[OSError | None] = [OSError(28, "No space left on device", "start")]

    def update_identity(**_: bool) -> None:
        if problems[-1] is not None:
            raise problems[-1]

    program = program_of(update_identity)
    with lines_said() as lines:
        program._write_step()
        program._write_step()
    assert program._node.identity_problem.startswith("start: ")
    assert [line["event"] for line in lines] == ["identity not written"]
    problems.append(None)
    program._write_step()
    assert program._node.identity_problem == ""


def test_preflight_that_waits_for_its_vehicle_is_no_hanging_loop() -> None:
    waits, closed = threading.Event(), threading.Event()

    def read_parameters() -> None:
        waits.set()
        closed.wait()

    program = program_of(preflight_step=read_parameters)
    with lines_said() as lines:
        program.start()
        assert waits.wait(20.0)
        program.leave()
    closed.set()
    assert not [line for line in lines if line["event"] == "loop hangs"]
