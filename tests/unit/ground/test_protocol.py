"""What is said between ground process and clients survives the way; mistakes do not."""

import base64
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.memory import EXPLORED_CELLS
from edge.core.world import MOST_FEATURES
from edge.messages.codec import MessageError
from edge.messages.codes import RefusalCode
from edge.messages.mission import (
    GroundState,
    Place,
    explored_from_bytes,
    explored_to_bytes,
)
from lpac.analysis.snapshot import (
    Explored,
    FleetSetup,
    FleetSlot,
    FleetSnapshot,
    GroundEvent,
    RobotSnapshot,
)
from lpac.analysis.worlds import format_world, random_features
from lpac.ground.station.protocol import (
    CommandProgress,
    CommandReport,
    Enable,
    NextTrial,
    Problem,
    ProblemCode,
    Request,
    ResultCode,
    Resume,
    RobotCommand,
    RobotResult,
    SafetyCommand,
    ServerMessage,
    SetFence,
    SetOrigin,
    SetPlaces,
    SetWorld,
    Start,
    TakeCommand,
    Takeoff,
    request_from_line,
    server_message_from_line,
    to_line,
)
from tests.unit.ground.snapshots import FENCE, ORIGIN, robot, status

REQUESTS: tuple[Request, ...] = (
    SetOrigin(ORIGIN), SetFence(FENCE, ("r1",)), SetFence(None),
    SetWorld("CircularBND 1 2 3 4\n", "a world.env"),
    SetPlaces({"r1": Place(3, (1.0, 2.0))}), Enable(), Enable(on=False, robots=("r1", "r2")),
    Takeoff(interval_s=0.5, abort_on_failure=True), Start(), SafetyCommand("return", wait=True),
    Resume(),
    RobotCommand("kill", ("r1",)), NextTrial("windy-2"), NextTrial(), TakeCommand(),
)  # fmt: skip


TOLD: tuple[ServerMessage, ...] = (
    FleetSetup("demo", "me@here", {"r1": 1}, (FleetSlot(Place(0, (1.0, 2.0)), (1.0, 1.0), "r1"),),
    FENCE,
          "Uniform 0 0\n", "abc", "bundle", 512, 64, 128.0, 16.0, 2.0, 1.0),
    FleetSnapshot(1e9, "me", GroundState(4, "me", ORIGIN, robot_safety_actions={"1": "hold"}),
            (robot(status(1)), RobotSnapshot("r2", 2)), ("takeoff",), 0.4),
    GroundEvent(1e9, "state", "r1", "hold: ground commands hold", "me", "t1"),
    Explored("r1", base64.b64encode(bytes(512)).decode()),
    CommandProgress("r1", "takes off"),
    CommandReport(
        (RobotResult("r1", ResultCode.DONE, "ready"),
         RobotResult("r2", ResultCode.REFUSED, "expired", RefusalCode.EXPIRED))
    ),
    CommandReport(problem=Problem(ProblemCode.NO_ORIGIN, "no mission origin")),
)  # fmt: skip


@pytest.mark.parametrize("request_", REQUESTS, ids=repr)
def test_requests_survive(request_: Request) -> None:
    line = to_line(request_)
    assert line.count(b"\n") == 1
    assert request_from_line(line) == request_


@pytest.mark.parametrize("told", TOLD, ids=lambda told: type(told).__name__)
def test_answers_survive(told: ServerMessage) -> None:
    line = to_line(told)
    assert line.count(b"\n") == 1
    assert server_message_from_line(line) == told


@given(st.binary(max_size=200))
def test_bytes_are_no_request(data: bytes) -> None:
    with pytest.raises(MessageError):
        request_from_line(data)


@given(
    st.sampled_from(
        [
            "origin",
            "takeoff",
            "safety_command",
            "robot_command",
            "world",
            "again",
            "assign",
            "enable",
        ]
    ),
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
        lambda inner: (
            st.lists(inner, max_size=3)
            | st.dictionaries(
                st.sampled_from(
                    ["robots", "action", "kind", "interval_s", "trial", "places", "on"]
                ),
                inner,
                max_size=3,
            )
        ),
        max_leaves=6,
    ),
)
def test_json_is_a_request_or_a_clear_refusal(name: str, fields: object) -> None:
    line = json.dumps({name: fields}).encode()
    try:
        request = request_from_line(line)
    except MessageError as error:
        assert "\n" not in str(error)
    else:
        assert request_from_line(to_line(request)) == request


@pytest.mark.parametrize(
    ("line", "why"),
    [
        (b'{"takeoff": {"interval_s": -1}}', "Takeoff: interval_s = -1: must be from 0 to 600"),
        (b'{"takeoff": {"interval_s": NaN}}', "JSON is malformed"),
        (b'{"origin": {"origin": {"latitude_deg": 1, "longitude_deg": 2, "heading_deg": 360}}}',
         "heading_deg = 360: must be at least 0 and below 360"),
        (b'{"safety_command": {"action": "fly"}}', "= 'fly': allowed are 'hold', 'return'"),
        (b'{"world": {"text": "Circle 1 2", "name": "w.env"}}', "w.env: record 1 (Circle)"),
        (b'{"world": {"text": "", "name": "a\\nb"}}', "must be printable"),
        (b'{"again": {"trial": "a b"}}', "trial = 'a b': must be at most 32 letters"),
        (b'{"again": {"trial": "%s"}}' % (33 * b"a"), "must be at most 32 letters"),
        (b'{"reboot": {}}', "one of origin, fence"),
        (b'{"start": {}, "resume": {}}', "one of origin, fence"),
    ],
)  # fmt: skip
def test_mistakes(line: bytes, why: str) -> None:
    with pytest.raises(MessageError) as caught:
        request_from_line(line)
    assert why in str(caught.value)


def test_a_world_that_is_too_long_for_the_radio() -> None:
    text = format_world(random_features(np.random.default_rng(0), 8000, 512))
    with pytest.raises(ValueError, match="must be at most 400000"):
        SetWorld(text, "w.env")


def test_a_world_of_more_features_than_robots_take() -> None:
    text = "CircularBND 1 1 1 1\n" * (MOST_FEATURES + 1)
    with pytest.raises(ValueError, match=r"w\.env has 2001 features: must be at most 2000"):
        SetWorld(text, "w.env")


def test_a_report_is_done_when_every_robot_is() -> None:
    ready = RobotResult("r1", ResultCode.DONE, "ready")
    refused = RobotResult("r2", ResultCode.NOT_HEARD, "not heard")
    assert CommandReport((ready,)).done
    assert not CommandReport((ready, refused)).done
    assert not CommandReport(problem=Problem(ProblemCode.NOT_ENABLED, "not enabled")).done


def test_explored_maps_survive() -> None:
    explored = np.random.default_rng(0).random((EXPLORED_CELLS, EXPLORED_CELLS)) < 0.3
    cells = Explored("r1", base64.b64encode(explored_to_bytes(explored)).decode())
    told = server_message_from_line(to_line(cells))
    assert isinstance(told, Explored)
    assert np.array_equal(explored_from_bytes(base64.b64decode(told.cells)), explored)
