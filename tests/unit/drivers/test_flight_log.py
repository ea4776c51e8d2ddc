"""The flight log as a user meets it: real files, a killed process, a disk that takes no more."""

import contextlib
import dataclasses
import json
import math
from collections.abc import Iterator
from enum import StrEnum
from pathlib import Path
from threading import Thread
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from mcap.reader import make_reader
from msgspec import structs

from edge.core.fence import Fence
from edge.core.vehicle import Action, ActionResult, GlobalOrigin, VehicleState, Velocity
from edge.drivers.flight_log import FlightLog, FlightMetadata, topic
from edge.drivers.log_reader import FlightLogError, LogGap, read, read_metadata, repair
from edge.messages.mission import FlightState, GroundState, Order, OrderResult, Origin, Place

METADATA = FlightMetadata(3, 77, "ab" * 32, "policies/x", '{"robot": {"id": 3}}', "0.1.0")
NOW = 1.7e9
STATE = GroundState(
    sequence=1, operator="ann", origin=Origin(47.0, 8.0, 0.0), robot_enabled={"3": True},
    robot_safety_actions={"3": "hold"}, fence=Fence(((0.0, 0.0), (9.0, 0.0), (9.0, 9.0)), 0.5,
    1.0, 9.0),
    places={"3": Place(1, (1.0, 2.0))}, world_id="abc",
)  # fmt: skip
NOISE = np.random.default_rng(0).integers(0, 256, 50_000, np.uint8)  # does not compress


@contextlib.contextmanager
def flight_log(directory: Path, **settings: Any) -> Iterator[FlightLog]:
    with contextlib.closing(FlightLog(directory, METADATA, **settings)) as log:
        yield log


def logged(directory: Path) -> list[tuple[str, float, dict[str, Any]]]:
    return [entry for path in sorted(directory.glob("*.mcap")) for entry in read(path)]


def same(back: npt.NDArray[Any], array: npt.NDArray[Any]) -> bool:
    return (back.dtype, back.shape, back.tobytes()) == (array.dtype, array.shape, array.tobytes())


class Colour(StrEnum):
    RED = "red"


class Pair(NamedTuple):
    left: object
    right: object


@dataclasses.dataclass(frozen=True, slots=True)
class Box:
    inside: object


def test_every_kind_of_value_comes_back(tmp_path: Path) -> None:
    with flight_log(tmp_path) as log:
        log.record(
            "control", NOW,
            {
                "enum": Colour.RED, "pair": Pair(1, (2.5, None)), "box": Box([True, "\ud800ü"]),
                "bytes": b"\x00\xff", "numbers": [math.nan, math.inf, -math.inf, -0.0, 2**70],
                "scalars": [np.float32(0.1), np.int64(-3), np.bool_(True), np.float64("nan")],
                "by_robot": {3: 0.5}, "array": np.array([[np.nan, 1]], ">f8"),
            },
        )  # fmt: skip
        log.record("vehicle", NOW + 0.25, structs.asdict(VehicleState()))
    (topic, time_s, message), (_, later_s, vehicle) = logged(tmp_path)
    assert (topic, time_s, later_s) == ("control", NOW, NOW + 0.25)
    assert same(message.pop("array"), np.array([[np.nan, 1]], ">f8"))
    assert message == {
        "enum": "red", "pair": {"left": 1, "right": [2.5, None]},
        "box": {"inside": [True, "\ud800ü"]}, "bytes": b"\x00\xff",
        "numbers": ["NaN", "Infinity", "-Infinity", 0.0, 2**70],
        "scalars": [float(np.float32(0.1)), -3, True, "NaN"], "by_robot": {"3": 0.5},
    }  # fmt: skip
    assert vehicle["position_at_s"] == "-Infinity" and vehicle["mode"] is None


arrays = hnp.arrays(
    st.one_of(
        hnp.floating_dtypes(), hnp.integer_dtypes(), hnp.unsigned_integer_dtypes(),
        hnp.boolean_dtypes(),
    ),
    hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4),
)  # fmt: skip
texts = st.text().filter(lambda text: text not in ("base64", "dtype"))
values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text() | st.binary()
    | st.floats(allow_nan=False, allow_infinity=False),
    lambda inner: st.lists(inner) | st.dictionaries(texts, inner),
    max_leaves=8,
)  # fmt: skip


@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(arrays, values), max_size=4), st.integers(1, 2**32))
def test_arrays_come_back_bit_by_bit(
    tmp_path_factory: pytest.TempPathFactory,
    recorded: list[tuple[npt.NDArray[Any], object]],
    time_s: int,
) -> None:
    directory = tmp_path_factory.mktemp("log")
    with flight_log(directory) as log:
        for array, value in recorded:
            log.record("policy", time_s + 0.5, {"array": array, "value": value})
            log.record("policy", time_s + 0.5, {"array": array.T})
    assert log.dropped == 0
    found = logged(directory)
    assert len(found) == 2 * len(recorded)
    for (array, value), (_, at_s, message), (_, _, transposed) in zip(
        recorded, found[::2], found[1::2], strict=True
    ):
        assert same(message["array"], array) and same(transposed["array"], array.T)
        assert message["value"] == value and at_s == time_s + 0.5


def test_logs_are_not_for_everybody_with_a_login(tmp_path: Path) -> None:
    with flight_log(tmp_path) as flown:
        flown.record("policy", 1.0, {})
    assert [path.stat().st_mode & 0o777 for path in tmp_path.glob("*.mcap")] == [0o640]


def test_metadata_says_who_flew_what(tmp_path: Path) -> None:
    with flight_log(tmp_path):
        pass
    assert read_metadata(tmp_path / "robot-3-0001.mcap") == METADATA


def test_mcaps_own_reader_finds_messages_schemas_and_index(tmp_path: Path) -> None:
    """What Foxglove needs: an index, a schema for each channel, the well-known names."""
    order = Order("a", 3, 77, "takeoff", 12.0, "me")
    state = VehicleState(
        result=ActionResult(Action.ARM, True, "", 1.0), origin=GlobalOrigin(47.0, 8.0, 400.0)
    )
    messages: dict[str, dict[str, Any]] = {
        "perception": {"features": np.zeros(34, np.float32)},
        "policy": {"message": b"abc", "payloads": (np.zeros(3, np.float16),), "senders": (1,)},
        "received": {"sender": 1, "sequence": 2, "age_s": 0.1, "rejection": None},
        "control": {"state": FlightState.MISSION, "sent_local": Velocity((1.0, 0.0, 0.0))[0]},
        "flight": {"number": 0, "whole": True, "given": {}, "made": {}},
        "status": {"origin": Origin(47.0, 8.0, 0.0)},
        "order": {**dataclasses.asdict(order), "answer": OrderResult("a")},
        "ground": dataclasses.asdict(STATE),
        "vehicle": structs.asdict(state),
        "/pose": {"position_m": (1.0, 2.0, 3.0), "yaw_rad": math.pi / 2},
        "/log": {"level": "warning", "message": "hello", "name": "robot"},
    }
    with flight_log(tmp_path) as log:
        for topic, message in messages.items():
            log.record(topic, NOW, message)
    with (tmp_path / "robot-3-0001.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        assert summary.statistics.message_count == len(messages)
        assert {channel.topic for channel in summary.channels.values()} == set(messages)
        assert [record.name for record in reader.iter_metadata()] == ["lpac", "lpac"]
        found = {}
        for schema, channel, record in reader.iter_messages():
            assert schema is not None and schema.encoding == "jsonschema"
            assert channel.message_encoding == "json"
            found[channel.topic] = (schema.name, json.loads(record.data))
            assert_foxglove_reads(json.loads(schema.data))
            assert_fits(found[channel.topic][1], json.loads(schema.data))
    assert found["/pose"] == (
        "foxglove.PoseInFrame",
        {
            "timestamp": {"sec": 1_700_000_000, "nsec": 0}, "frame_id": "mission",
            "pose": {
                "position": {"x": 1.0, "y": 2.0, "z": 3.0},
                "orientation": {
                    "x": 0.0, "y": 0.0, "z": pytest.approx(0.5**0.5), "w": pytest.approx(0.5**0.5),
                },
            },
        },
    )  # fmt: skip
    name, line = found["/log"]
    assert name == "foxglove.Log"
    assert (line["level"], line["message"], line["name"]) == (3, "hello", "robot")


def assert_fits(value: object, schema: dict[str, Any]) -> None:
    """Every value that is known has the type that its schema says, and is in the schema."""
    types: dict[str, tuple[type, ...]] = {
        "object": (dict,), "array": (list,), "string": (str,), "integer": (int,),
        "number": (int, float), "boolean": (bool,),
    }  # fmt: skip
    if value is None or value == "-Infinity":
        return
    assert isinstance(value, types[schema["type"]]), (value, schema)
    if isinstance(value, dict):
        for key, entry in value.items():
            if key not in schema["properties"] and is_list_of_lists(entry):
                continue
            assert_fits(entry, schema["properties"].get(key) or schema["additionalProperties"])
    elif isinstance(value, list):
        for entry in value:
            assert_fits(entry, schema["items"])


def is_list_of_lists(value: object) -> bool:
    return isinstance(value, list) and all(isinstance(entry, list) for entry in value)


def assert_foxglove_reads(schema: dict[str, Any]) -> None:
    """Its parser needs properties, and no lists of lists."""
    if schema["type"] == "object":
        for entry in schema["properties"].values():
            assert_foxglove_reads(entry)
    elif schema["type"] == "array":
        assert schema["items"]["type"] != "array" and "contentEncoding" not in schema["items"]
        assert_foxglove_reads(schema["items"])


@dataclasses.dataclass(frozen=True, slots=True)
class Station:
    """Whoever else writes such logs."""

    operator: str
    log_name: str = "ground+"


def test_the_ground_writes_what_it_likes(tmp_path: Path) -> None:
    """Its own names and topics; dataclasses in dataclasses and in dictionaries."""
    topics = {"state": topic("State", GroundState), "cost": topic("Cost", Place, by_robot=float)}
    (tmp_path / "ground-0007.mcap").touch()
    for _start in range(2):
        with contextlib.closing(FlightLog(tmp_path, Station("ann"), topics)) as log:
            log.record("state", NOW, dataclasses.asdict(STATE))
            log.record("cost", NOW, {"slot": 1, "landing_point_m": (1.0, 2.0), "by_robot": 3.5})
            log.record("status", NOW, {"robot_id": 1})
        assert log.dropped == 1
    path = tmp_path / "ground+-0002.mcap"
    (_, _, state), (name, _, cost) = read(path)
    assert name == "cost" and cost == {"slot": 1, "landing_point_m": [1.0, 2.0], "by_robot": 3.5}
    assert state["places"] == {"3": {"slot": 1, "landing_point_m": [1.0, 2.0]}}
    assert state["fence"]["vertices_m"] == [[0.0, 0.0], [9.0, 0.0], [9.0, 9.0]]
    with path.open("rb") as file:
        for schema, _, record in make_reader(file).iter_messages():
            assert schema is not None
            assert_foxglove_reads(json.loads(schema.data))
            assert_fits(json.loads(record.data), json.loads(schema.data))
    with pytest.raises(FlightLogError, match=r"ground\+-0002\.mcap: was not written by a robot"):
        read_metadata(path)


@pytest.mark.slow
def test_a_file_cut_at_any_byte_is_read_up_to_there(tmp_path: Path) -> None:
    whole, cut = tmp_path / "robot-3-0001.mcap", tmp_path / "cut.mcap"
    # Only one topic: the schemas of a robot's others are more of the same.
    topics = {"policy": topic("Policy", Place)}
    log = FlightLog(tmp_path, METADATA, topics, sync_period_s=0)
    begun = whole.stat().st_size
    ends = []
    for number in range(3):
        log.record("policy", NOW, {"number": number, "array": NOISE[:100]})
        log.flush()
        ends.append(whole.stat().st_size)
    log.close()
    data = whole.read_bytes()
    for size in range(len(data) + 1):
        cut.write_bytes(data[:size])
        lost: list[LogGap] = []
        found = [message["number"] for _, _, message in read(cut, on_gap=lost.append)]
        # A chunk is whole before the index of its messages, which follows it.
        assert found == list(range(len(found)))
        since_s = NOW if found else None
        assert lost == ([LogGap(cut, since_s, None, damaged=False)] if size < len(data) else [])
        assert len(found) >= sum(end <= size for end in ends)
        if size == begun:
            assert read_metadata(cut) == METADATA
        elif size < begun:
            with pytest.raises(FlightLogError, match=r"cut\.mcap: was not written by a robot"):
                read_metadata(cut)
    assert len(found) == 3


def test_a_file_that_ends_in_rubbish_is_read_up_to_there(tmp_path: Path) -> None:
    """A file system can leave zeros after a power loss where data should be."""
    log = FlightLog(tmp_path, METADATA, sync_period_s=0)
    path = tmp_path / "robot-3-0001.mcap"
    for number in range(2):
        log.record("policy", NOW, {"number": number, "array": NOISE[:1000]})
        log.flush()
    data = path.read_bytes()
    log.close()
    for rubbish in (bytes(5000), NOISE[:5000].tobytes()):
        for kept, numbers in ((len(data), [0, 1]), (len(data) - 600, [0])):
            path.write_bytes(data[:kept] + rubbish)
            lost: list[LogGap] = []
            found = [message["number"] for _, _, message in read(path, on_gap=lost.append)]
            assert found == numbers and lost == [LogGap(path, NOW, None, damaged=False)]


@pytest.fixture(scope="module")
def a_flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of four chunks, a second apart, with one message each."""
    folder = tmp_path_factory.mktemp("flight")
    topics = {"policy": topic("Policy", Place), "status": topic("Status", Place)}
    log = FlightLog(folder, METADATA, topics, sync_period_s=0)
    for number in range(4):
        log.record("status", NOW + number, {"number": number, "array": NOISE[:50]})
        log.flush()
    log.close()
    return folder / "robot-3-0001.mcap"


@pytest.mark.slow
@pytest.mark.parametrize("flip", [0xFF, 0x01, 0x04])
def test_a_flipped_byte_anywhere_costs_at_most_what_is_said_to_be_missing(
    a_flight: Path, tmp_path: Path, flip: int
) -> None:
    data, damaged = a_flight.read_bytes(), tmp_path / "robot-3-0001.mcap"
    for at in range(len(data)):
        damaged.write_bytes(data[:at] + bytes([data[at] ^ flip]) + data[at + 1 :])
        lost: list[LogGap] = []
        found = [message["number"] for _, _, message in read(damaged, on_gap=lost.append)]
        assert len(found) >= 3 and read_metadata(damaged) == METADATA
        for number in set(range(4)) - set(found):
            (gap,) = lost
            assert gap.damaged
            assert gap.since_unix_s == (None if number == 0 else NOW + number - 1)
            assert gap.until_unix_s == (None if number == 3 else NOW + number + 1)


def test_what_is_whole_of_a_damaged_log_is_repaired(a_flight: Path, tmp_path: Path) -> None:
    data, damaged, out = a_flight.read_bytes(), tmp_path / "damaged.mcap", tmp_path / "out.mcap"
    for at in (len(data) // 2, data.index(b"zstd")):  # the second has the channels
        damaged.write_bytes(data[:at] + bytes([data[at] ^ 0xFF]) + data[at + 1 :])
        lost: list[LogGap] = []
        assert repair(damaged, out, lost.append) == 3 and len(lost) == 1
        unsaid: list[LogGap] = []
        whole = [(name, time_s) for name, time_s, _ in read(damaged, on_gap=unsaid.append)]
        assert [(name, s) for name, s, _ in read(out, on_gap=unsaid.append)] == whole
        assert unsaid == lost and read_metadata(out) == METADATA
        with out.open("rb") as file:
            assert len(list(make_reader(file, validate_crcs=True).iter_messages())) == 3
        with pytest.raises(FileExistsError):
            repair(damaged, out)
        assert out.stat().st_mode & 0o007 == 0
        out.unlink()
    with pytest.raises(OSError):
        repair(tmp_path / "absent.mcap", out)
    assert not out.exists()


@pytest.mark.slow
@pytest.mark.parametrize("sync_period_s", [0, 1000])
def test_the_size_bounds_hold(tmp_path: Path, sync_period_s: int) -> None:
    foreign = [tmp_path / name for name in ("robot-33-0001.mcap", "robot-3-0001.txt")]
    for path in foreign:
        path.write_bytes(bytes(10**6))
    biggest_total = 0
    for _start in range(2):
        with flight_log(
            tmp_path, max_segment_bytes=2**18, max_total_bytes=2**20, sync_period_s=sync_period_s
        ) as log:
            for number in range(60):
                log.record("policy", NOW, {"number": number, "array": NOISE})
                log.flush()
                sizes = [path.stat().st_size for path in tmp_path.glob("robot-3-*.mcap")]
                assert max(sizes) <= 2**18
                biggest_total = max(biggest_total, sum(sizes))
        assert log.dropped == 0
    assert 0.6 * 2**20 < biggest_total <= 2**20
    assert all(path.exists() for path in foreign)
    foreign[0].unlink()
    numbers = [message["number"] for _, _, message in logged(tmp_path)]
    assert numbers == list(range(60))[-len(numbers) :]
    assert read_metadata(max(tmp_path.glob("robot-3-*.mcap"))) == METADATA


@pytest.mark.slow
def test_small_messages_do_not_break_the_bound_either(tmp_path: Path) -> None:
    """Then the index is most of the file."""
    with flight_log(tmp_path, max_segment_bytes=2**18, sync_period_s=0) as log:
        for number in range(5000):
            log.record("received", NOW + number, {"sender": number})
            if number % 5 == 0:
                log.flush()
    sizes = [path.stat().st_size for path in tmp_path.iterdir()]
    assert len(sizes) > 1 and max(sizes) <= 2**18
    assert [message["sender"] for _, _, message in logged(tmp_path)] == list(range(5000))


def test_what_comes_too_fast_is_dropped_and_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = FlightLog(tmp_path, METADATA, max_queued_messages=100)

    def record() -> None:
        for number in range(1000):
            log.record("ground", NOW, {"sequence": number})

    threads = [Thread(target=record) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    log.close()
    found = logged(tmp_path)
    assert len(found) == 100 and log.dropped == 3900
    assert capsys.readouterr().err.count("dropped=3900") == 1


def test_a_message_that_cannot_be_held_costs_only_itself(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with flight_log(tmp_path, max_segment_bytes=2**18) as log:
        for topic, time_s, message in (
            ("policy", NOW, {"number": 1}),
            ("policy", NOW, {"object": object()}),
            ("policy", NOW, {"objects": np.array([None])}),
            ("policy", math.nan, {}),
            ("policy", -1.0, {}),
            ("policy", NOW, {"array": np.zeros(10**6)}),
            ("unheard of", NOW, {}),
            ("/pose", NOW, {"position_m": None, "yaw_rad": None}),
            ("policy", NOW, {"number": 2}),
        ):
            log.record(topic, time_s, message)
    assert [message["number"] for _, _, message in logged(tmp_path)] == [1, 2]
    assert log.dropped == 7
    lines = capsys.readouterr().err.splitlines()
    assert len([line for line in lines if "cannot hold a message" in line]) == 3  # one per topic


def test_a_directory_that_cannot_be_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    log = FlightLog(tmp_path / "file" / "logs", METADATA)
    assert not log.recording
    log.record("policy", NOW, {})
    log.flush()
    log.close()
    (line,) = capsys.readouterr().err.splitlines()
    assert "flight log stopped" in line and "Not a directory" in line


def test_a_closed_log_takes_nothing_more(tmp_path: Path) -> None:
    with flight_log(tmp_path) as log:
        pass
    log.record("policy", NOW, {})
    log.flush()
    log.close()
    assert logged(tmp_path) == [] and log.dropped == 0


@pytest.mark.parametrize(
    ("limits", "text"),
    [
        ({"max_segment_bytes": 1000}, "max_segment_bytes = 1000: must be at least 262144"),
        ({"max_total_bytes": 10**6}, "max_total_bytes = 1000000: must be at least"),
        ({"max_queued_messages": 0}, "max_queued_messages = 0: must be at least 1"),
    ],
)
def test_impossible_limits_are_named(tmp_path: Path, limits: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        FlightLog(tmp_path, METADATA, **limits)


@pytest.mark.parametrize("content", [b"\x89PNG and more", b"\x00" * 100])
def test_what_is_no_mcap_is_named(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "picture.mcap"
    path.write_bytes(content)
    for reading in (lambda: list(read(path)), lambda: read_metadata(path)):
        with pytest.raises(FlightLogError, match=r"picture\.mcap: is not an MCAP file"):
            reading()
