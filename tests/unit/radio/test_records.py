"""Records of a field's radio: what was written is read, and a mistake is one line."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.schema import ConfigError
from lpac.radio.airtime import TRANSPORTS
from lpac.radio.records import RadioRecord, read_records, write_records

RECORD = RadioRecord(
    sender="r1", receiver="r2", transport="mesh", robots=3, message_bytes=1880.0, message_hz=2.5,
    sent=100, received=97, loaded=False, ground_wired=True, age_p50_s=0.004, age_p99_s=0.03,
    distance_m=12.5, sender_heading_deg=271.0, receiver_height_m=5.0, rate_mbit_s=180.0,
    signal_dbm=-61.0, busy_share=0.2,
)  # fmt: skip
UNKNOWN = RadioRecord(
    sender="r1", receiver="ground", transport="multicast", robots=3, message_bytes=1880.0,
    message_hz=2.5, sent=100, received=0, loaded=True, ground_wired=False,
)  # fmt: skip

maybe_positive = st.none() | st.floats(0.0, 1e9)
records = st.integers(1, 10**9).flatmap(
    lambda sent: st.builds(
        RadioRecord,
        sender=st.text(min_size=1).map(lambda name: f"s{name}"),
        receiver=st.text(min_size=1).map(lambda name: f"r{name}"),
        transport=st.sampled_from(TRANSPORTS),
        robots=st.integers(1, 1000),
        message_bytes=st.floats(1.0, 1e6),
        message_hz=st.floats(0.01, 1e3),
        sent=st.just(sent),
        received=st.integers(0, sent),
        loaded=st.booleans(),
        ground_wired=st.booleans(),
        age_p50_s=maybe_positive,
        age_p99_s=maybe_positive,
        distance_m=maybe_positive,
        sender_heading_deg=st.none() | st.floats(-360.0, 360.0),
        receiver_height_m=st.none() | st.floats(-100.0, 1e4),
        rate_mbit_s=st.none() | st.floats(1.0, 1e4),
        signal_dbm=st.none() | st.floats(-120.0, 0.0),
        busy_share=st.none() | st.floats(0.0, 1.0),
    )
)


@given(st.lists(records, max_size=5))
def test_what_was_written_is_read(tmp_path_factory: Any, written: list[RadioRecord]) -> None:
    path = tmp_path_factory.mktemp("records") / "records.jsonl"
    write_records(path, written)
    assert read_records(path) == written


def test_a_line_has_all_keys_and_may_lack_what_is_not_known(tmp_path: Path) -> None:
    path = tmp_path / "records.jsonl"
    write_records(path, [UNKNOWN])
    written = json.loads(path.read_text())
    assert written == asdict(UNKNOWN)
    known = {name: value for name, value in written.items() if value is not None}
    path.write_text(f"\n{json.dumps(known)}\n\n{json.dumps(written)}\n")
    assert read_records(path) == [UNKNOWN, UNKNOWN]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"sender": ""}, "sender = '': must be a name"),
        ({"receiver": "r1"}, "receiver = 'r1': must not be the sender"),
        ({"robots": 0}, "robots = 0: must be at least 1"),
        ({"sent": 0, "received": 0}, "sent = 0: must be at least 1"),
        ({"sent": 100.5}, "sent = 100.5: must be a whole number"),
        ({"sent": True}, "sent = True: must be a whole number"),
        ({"received": 101}, "received = 101: must be from 0 to 100"),
        ({"received": -1}, "received = -1: must be from 0 to 100"),
        ({"message_bytes": 0}, "message_bytes = 0: must be above 0 and finite"),
        ({"message_hz": -1}, "message_hz = -1: must be above 0 and finite"),
        ({"rate_mbit_s": 0.0}, "rate_mbit_s = 0.0: must be above 0 and finite"),
        ({"age_p50_s": -0.1}, "age_p50_s = -0.1: must be at least 0 and finite"),
        ({"age_p99_s": float("nan")}, "age_p99_s = nan: must be at least 0 and finite"),
        ({"distance_m": float("inf")}, "distance_m = inf: must be at least 0 and finite"),
        ({"signal_dbm": float("-inf")}, "signal_dbm = -inf: must be finite"),
        ({"busy_share": 1.01}, "busy_share = 1.01: must be from 0 to 1"),
        ({"message_hz": None}, "message_hz = None: must be a number"),
        ({"message_hz": 10**400}, "message_hz: is too large a number"),
        ({"transport": "router"}, "transport = 'router': allowed are 'mesh', 'multicast'"),
        ({"loaded": None}, "loaded = None: must be true or false"),
        ({"colour": "red"}, "unknown key 'colour'"),
    ],
)
def test_a_mistake_is_named_with_its_line(tmp_path: Path, change: Any, told: str) -> None:
    path = tmp_path / "records.jsonl"
    write_records(path, [RECORD])
    path.write_text(path.read_text() + json.dumps({**asdict(RECORD), **change}) + "\n")
    with pytest.raises(ConfigError) as caught:
        read_records(path)
    assert f"{path}: line 2: {told}" in str(caught.value)


def test_a_missing_key_is_named(tmp_path: Path) -> None:
    path = tmp_path / "records.jsonl"
    path.write_text('{"sender": "r1"}\n')
    with pytest.raises(ConfigError, match="line 1: receiver is missing"):
        read_records(path)


@pytest.mark.parametrize("key", ["loaded", "ground_wired"])
def test_a_file_of_before_says_not_under_what_it_was_measured(tmp_path: Path, key: str) -> None:
    path = tmp_path / "records.jsonl"
    path.write_text(json.dumps({k: v for k, v in asdict(RECORD).items() if k != key}))
    with pytest.raises(ConfigError, match=f"line 1: {key} is missing"):
        read_records(path)


@pytest.mark.parametrize(
    "line",
    [b'{"sender": "r1"', b"r1, r2, 100", b'{"sender": "\xff"}', b"[" * 100_000, b"9" * 5000],
    ids=["cut", "csv", "not-utf-8", "deep", "a-long-number"],
)
def test_what_is_not_json_is_one_line(tmp_path: Path, line: bytes) -> None:
    path = tmp_path / "records.jsonl"
    path.write_bytes(line)
    with pytest.raises(ConfigError, match="line 1: is not JSON"):
        read_records(path)


def test_what_is_no_record_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "records.jsonl"
    path.write_text("[1, 2]\n")
    with pytest.raises(ConfigError, match="line 1: expected a table"):
        read_records(path)
