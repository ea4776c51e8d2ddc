"""What ground and robots say to each other survives the way, and what is wrong is named."""

import dataclasses
import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import inspect

from edge.core.fence import Fence
from edge.messages.codec import MessageError, decode, encode
from edge.messages.codes import CheckCode, ReasonCode
from edge.messages.mission import (
    FlightState,
    GroundState,
    LoopStatus,
    Order,
    OrderResult,
    Origin,
    Place,
    RobotStatus,
    SafetyRequest,
    explored_from_bytes,
    explored_to_bytes,
)
from tests.said import checks, reason, refusal

FENCE = Fence(((0.0, 0.0), (32.0, 0.0), (32.0, 32.0)), 2.0, 1.0, 30.0)
STATUS = RobotStatus(
    robot_id=3, boot_nonce=2**47, sequence=9, uptime_s=12.5, unix_time_s=1.8e9,
    state=FlightState.HOLD, reason=reason("at its height"), ready=False,
    failed_checks=checks("a", "b"),
    alarms=(), obeyed_sequence=4, operator="anna",
    orders=(OrderResult("1", refusal("expired")),),
    bundle_id="ab", world_id="cd", trial="t1", origin=Origin(40.0, -75.0, 359.0), system_id=1,
    slot_height_m=8.0, landing_point_m=(1.0, 2.0), position_m=(1.0, 2.0, 3.0),
    velocity_m_s=None, heading_rad=0.1, mode="offboard", armed=True, battery=0.5, satellites=12,
    message_counts={"accepted": 4}, neighbour_ages_s={"2": 0.1},
    loops={"control": LoopStatus(1, 0, 0, 0.1, 0.2, 0.3)}, fence=FENCE,
    not_taken=checks("in flight"),
    in_air=True, global_deg=(40.0, -75.0), hdop=0.8, policy_velocity_m_s=(0.1, -0.2),
    feature_age_s=0.1, neighbour_messages={"2": 40}, ground_age_s=0.1, flown_s=63.5,
)  # fmt: skip
STATE = GroundState(
    7, "anna", Origin(1.0, 2.0, 3.0), enabled=True, robot_enabled={"4": False},
    safety_action="hold", safety_action_by="ben", robot_safety_actions={"3": "land"}, fence=FENCE,
    places={"3": Place(2, (1.0, 2.0))}, world_id="cd", trial="t1", unix_time_s=1.8e9,
)  # fmt: skip
ORDER = Order("x", 3, 2**47, "start", 22.5, "anna", trial="t1")


def test_messages_survive_the_way() -> None:
    for message in (STATE, ORDER, STATUS):
        assert decode(type(message), encode(message)) == message


def test_what_an_older_program_does_not_say_is_not_known_and_a_newer_ones_news_are_ignored() -> (
    None
):
    told = json.loads(encode(STATUS))
    del told["flown_s"]
    told["wind_m_s"] = [1.0, {"gusts": []}]
    assert decode(RobotStatus, json.dumps(told).encode()) == dataclasses.replace(
        STATUS, flown_s=None
    )


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf, 1e12])
def test_a_number_that_is_not_finite_becomes_unknown(number: float) -> None:
    odd: dict[str, Any] = {
        "position_m": (1.0, number, 3.0), "velocity_m_s": (number, 0.0, 0.0),
        "global_deg": (number, number), "policy_velocity_m_s": (0.0, number),
        "heading_rad": number, "battery": number, "hdop": number, "feature_age_s": number,
        "ground_age_s": number, "flown_s": number,
    }  # fmt: skip
    status = dataclasses.replace(STATUS, **odd)
    unknown: dict[str, Any] = dict.fromkeys(odd)
    assert status == dataclasses.replace(STATUS, **unknown)
    assert decode(RobotStatus, encode(status)) == status
    ages_s = {"2": math.nan, "4": 0.2}
    assert dataclasses.replace(STATUS, neighbour_ages_s=ages_s).neighbour_ages_s == {"4": 0.2}


@pytest.mark.parametrize(
    "odd",
    [{"uptime_s": math.nan}, {"unix_time_s": math.inf}, {"slot_height_m": math.nan},
     {"landing_point_m": (0.0, math.nan)}],
    ids=str,
)  # fmt: skip
def test_a_status_has_a_time_and_a_place_to_go_to(odd: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=rf"^{next(iter(odd))}(\[1\])? = .*: must be "):
        dataclasses.replace(STATUS, **odd)


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("sequence", int("9" * 4300), "sequence = 999"), ("sequence", -2, "-2: must be from -1 to"),
        ("sequence", 1.5, "sequence = 1.5: must be a whole number"),
        ("operator", "x" * 129, "must be at most 128 long"),
        ("robot_enabled", {"all": True}, "robot_enabled: key = 'all': must be like ^[0-9]{1,5}$"),
        ("robot_enabled", {str(n): True for n in range(1001)}, "must be at most 1000 long"),
        ("waiting", [70_000], "waiting[0] = 70000: must be from 0 to 65535"),
        ("unix_time_s", -1.0, "unix_time_s = -1.0: must be from 0 to 1e+11"),
        ("safety_action", "fly", "= 'fly': allowed are 'none', 'hold'"),
        ("trial", "x" * 129, "must be at most 128 long"),
        ("places", {"3": {"slot": -1, "landing_point_m": [1, 2]}},
         "places: 3: slot = -1: must be from 0 to 1000"),
        ("places", {"3": {"slot": 1, "landing_point_m": [1]}}, "_point_m = [1]: must be [x, y]"),
        ("fence", {"vertices_m": [], "buffer_m": 1, "floor_m": 1, "ceiling_m": 2}, "vertices_m"),
        ("fence", {"vertices_m": [[1, 2]] * 101, "buffer_m": 1, "floor_m": 1, "ceiling_m": 2},
         "must be 3 to 100 long"),
        ("origin", {"latitude_deg": 1.0, "longitude_deg": 2.0, "heading_deg": 360.0},
         "origin: heading_deg = 360.0: must be at least 0 and below 360"),
        ("origin", {"latitude_deg": 1e300, "longitude_deg": 2.0, "heading_deg": 0.0},
         "latitude_deg = 1e+300: must be from -90 to 90"),
    ],
    ids=lambda value: str(value)[:30],
)  # fmt: skip
def test_a_grounds_values_are_bounded(key: str, value: object, said: str) -> None:
    told = json.loads(encode(STATE))
    assert decode(GroundState, json.dumps(told).encode()) == STATE
    # Numbers of thousands of digits are for the encoder to write.
    data = json.dumps(told | {key: "@"}).replace('"@"', _json(value)).encode()
    with pytest.raises(MessageError, match="^GroundState: .*" + re.escape(said)):
        decode(GroundState, data)


def _json(value: object) -> str:
    return "9" * 4300 if isinstance(value, int) and value > 2**64 else json.dumps(value)


# Their own constructors check these, which the test above and those of `Fence` show.
CHECKED_BY_ITS_TYPE = {
    "RobotStatus.landing_point_m",
}  # fmt: skip


@pytest.mark.parametrize(
    "kind",
    [GroundState, Order, RobotStatus, SafetyRequest],
    ids=lambda kind: kind.__name__,
)
def test_every_number_text_and_list_has_a_bound(kind: type) -> None:
    assert set(unbounded(inspect.type_info(kind), kind.__name__)) <= CHECKED_BY_ITS_TYPE


def unbounded(kind: inspect.Type, name: str) -> Iterator[str]:
    """The names of what may be as large, or as long, as it likes."""
    if isinstance(kind, inspect.DataclassType):
        for field in kind.fields:
            yield from unbounded(field.type, f"{kind.cls.__name__}.{field.name}")
        return
    bounds: tuple[object, ...] = ()
    parts: tuple[inspect.Type, ...] = ()
    match kind:
        case inspect.IntType() | inspect.FloatType():
            bounds = (
                kind.gt if kind.ge is None else kind.ge,
                kind.lt if kind.le is None else kind.le,
            )
        case inspect.StrType() | inspect.BytesType():
            bounds = (kind.max_length or getattr(kind, "pattern", None),)
        case inspect.VarTupleType():
            bounds, parts = (kind.max_length,), (kind.item_type,)
        case inspect.DictType():
            bounds, parts = (kind.max_length,), (kind.key_type, kind.value_type)
        case inspect.TupleType():
            parts = kind.item_types
        case inspect.UnionType():
            parts = kind.types
        case inspect.Metadata():
            parts = (kind.type,)
        case _:
            closed = inspect.BoolType, inspect.EnumType, inspect.LiteralType, inspect.NoneType
            assert isinstance(kind, closed), name
    if None in bounds:
        yield name
    for part in parts:
        yield from unbounded(part, name)


def test_a_state_is_whole_or_refused() -> None:
    told = json.loads(encode(STATE))
    for key in told:
        data = json.dumps({k: v for k, v in told.items() if k != key}).encode()
        with pytest.raises(MessageError, match=f": {key} is missing"):
            decode(GroundState, data)


def test_what_is_asked_of_one_robot_overrides_what_is_asked_of_all() -> None:
    state = GroundState(
        7, "anna", safety_action="hold", robot_safety_actions={"3": "land", "4": "none"}
    )
    assert [state.safety_action_for(robot) for robot in (2, 3, 4)] == ["hold", "land", "none"]
    state = GroundState(7, "anna", enabled=True, robot_enabled={"3": False, "4": True})
    assert [state.enabled_for(robot) for robot in (2, 3, 4)] == [True, False, True]


JSON_VALUES: st.SearchStrategy[Any] = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner),
    max_leaves=4,
)


@given(message=st.sampled_from([STATE, ORDER, STATUS]), data=st.data())
def test_whatever_a_field_holds_is_taken_or_refused_in_one_line(
    message: GroundState | Order | RobotStatus, data: st.DataObject
) -> None:
    told: Any = json.loads(encode(message))
    within = told
    while True:
        key = data.draw(st.sampled_from(sorted(within)))
        if not (isinstance(within[key], dict) and within[key] and data.draw(st.booleans())):
            break
        within = within[key]
    within[key] = data.draw(JSON_VALUES)
    try:
        decode(type(message), json.dumps(told).encode())
    except MessageError as error:
        assert str(error).startswith(f"{type(message).__name__}: ")
        assert "\n" not in str(error)


def test_what_was_explored_survives_the_way() -> None:
    explored = np.random.default_rng(0).random((64, 64)) < 0.3
    data = explored_to_bytes(explored)
    assert len(data) == 512
    np.testing.assert_array_equal(explored_from_bytes(data), explored)
    with pytest.raises(ValueError, match="explored has 511 bytes: must be 512"):
        explored_from_bytes(data[:-1])
    with pytest.raises(ValueError, match=r"shape \(63, 64\)"):
        explored_to_bytes(explored[1:])


@pytest.mark.parametrize(
    "data",
    [b"", b"\xff", b"[]", b"null", b'{"order_id": "a"', b"[" * 100_000, b'{"a":' * 100_000,
     b'{"order_id": NaN}', encode(STATUS)],
    ids=lambda data: str(data[:16]),
)  # fmt: skip
def test_what_is_no_message_is_refused(data: bytes) -> None:
    for kind in (Order, GroundState):
        with pytest.raises(MessageError, match=f"^{kind.__name__}: "):
            decode(kind, data)


def test_hold_and_land_are_decoded_whatever_else_a_state_has() -> None:
    told = json.loads(encode(STATE)) | {"world_id": 7, "fence": "none", "origin": []}
    data = json.dumps(told).encode()
    with pytest.raises(MessageError):
        decode(GroundState, data)
    request = decode(SafetyRequest, data)
    assert [request.safety_action_for(robot) for robot in (3, 4)] == ["land", "hold"]
    assert (request.sequence, request.operator) == (7, "anna")
    told["robot_safety_actions"] |= {"2": "dodge"}
    request = decode(SafetyRequest, json.dumps(told).encode())
    assert [request.safety_action_for(robot) for robot in (2, 3)] == ["none", "land"]


RECORDED = Path(__file__).parent / "recorded"


def recorded(name: str) -> bytes:
    """Message of an earlier release, or of one that may come."""
    return (RECORDED / f"{name}.json").read_bytes()


def test_of_another_release_hold_land_and_kill_are_understood() -> None:
    """As far as their bounds have stayed; everything else is then refused."""
    for name in ("state-3", "state-4", "state-4-must"):
        request = decode(SafetyRequest, recorded(name))
        assert request.safety_action_for(3) == "land"
    for name in ("kill-0", "kill-4-must"):
        kill = decode(Order, recorded(name))
        assert (kill.kind, kill.robot_id) == ("kill", ORDER.robot_id)


def test_of_another_release_a_status_is_understood_as_far_as_it_can_be() -> None:
    status = decode(RobotStatus, recorded("status-4"))
    assert (status.state, status.position_m) == (STATUS.state, STATUS.position_m)
    assert (status.reason.code, status.reason.text) == (ReasonCode.OTHER, "the gust has passed")
    (check,) = status.failed_checks
    assert (check.code, check.settles_by_itself) == (CheckCode.OTHER, True)
    assert status.hdop is None and status.neighbour_messages == {}
    with pytest.raises(MessageError, match=r"^RobotStatus: .*reason: expected a table, got"):
        decode(RobotStatus, recorded("status-0"))
