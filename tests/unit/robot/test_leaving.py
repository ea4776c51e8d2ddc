"""How a robot's program ends."""

import threading
from types import SimpleNamespace
from typing import Any

from edge.robot.process import _Program
from tests.said import lines_said


def test_preflight_that_waits_for_its_vehicle_is_no_hanging_loop() -> None:
    waits, closed = threading.Event(), threading.Event()

    def read_parameters() -> None:
        waits.set()
        closed.wait()

    def nothing(*_: Any) -> None:
        pass

    node: Any = SimpleNamespace(
        control_step=nothing, perception_step=nothing, policy_step=nothing,
        preflight_step=read_parameters, status_step=nothing, leave=nothing,
    )  # fmt: skip
    config: Any = SimpleNamespace(
        rates=SimpleNamespace(control_hz=10.0, perception_hz=5.0, policy_hz=2.5), on_stop="land"
    )
    recorder: Any = SimpleNamespace(flush=nothing)
    rest: Any = SimpleNamespace()
    program = _Program(config, node, rest, rest, recorder, rest, None)
    with lines_said() as lines:
        program.start()
        assert waits.wait(20.0)
        program.leave()
    closed.set()
    assert not [line for line in lines if line["event"] == "loop hangs"]
