"""Logs as arrays."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from edge.drivers.flight_log import FlightLog, topic
from edge.drivers.log_reader import FlightLogError
from lpac.analysis.arrays import Columns, log_arrays


@dataclass(frozen=True)
class _Writer:
    name: str

    @property
    def log_name(self) -> str:
        return self.name


@dataclass(frozen=True)
class _Message:
    """Message of any topic; recorded messages need not have its fields."""


TOPICS = {"state": topic("State", _Message), "other": topic("Other", _Message)}


def write(folder: Path, name: str, *messages: dict[str, object]) -> None:
    """Write a new file of that log, with the first message at 100 s."""
    log = FlightLog(folder, _Writer(name), TOPICS)
    for number, message in enumerate(messages):
        log.record("state", 100.0 + number, message)
    log.record("other", 200.0, {"only": "here"})
    log.close()


def columns_of(folder: Path, *messages: dict[str, object]) -> Columns:
    write(folder, "robot-3", *messages)
    return log_arrays(folder)["robot-3"]["state"]


def test_numbers_and_texts_become_columns(tmp_path: Path) -> None:
    columns = columns_of(
        tmp_path,
        {
            "count": 1,
            "on": True,
            "state": "hold",
            "at_m": [1.0, 2.0],
            "grid": np.eye(2, dtype="f4"),
        },
        {
            "count": 2,
            "on": False,
            "state": "land",
            "at_m": [3.0, 4.5],
            "grid": np.ones((2, 2), "f4"),
        },
    )
    assert columns.time_s.tolist() == [100.0, 101.0]
    assert columns["count"].dtype.kind == "i" and columns["on"].dtype == np.bool_
    assert (columns["state"] == "land").tolist() == [False, True]
    assert columns["at_m"].tolist() == [[1.0, 2.0], [3.0, 4.5]]
    assert columns["grid"].dtype == np.float32 and columns["grid"].shape == (2, 2, 2)


def test_what_a_message_does_not_have(tmp_path: Path) -> None:
    columns = columns_of(
        tmp_path,
        {"count": None, "at_m": None, "word": None, "deep": None, "never": None},
        {"count": 7, "at_m": [math.nan, math.inf], "word": "yes", "deep": {"a": {"b": 2}}},
    )
    np.testing.assert_array_equal(columns["count"], [np.nan, 7.0])
    np.testing.assert_array_equal(columns["at_m"], [[np.nan, np.nan], [np.nan, np.inf]])
    assert columns["word"].tolist() == [None, "yes"]
    np.testing.assert_array_equal(columns["deep.a.b"], [np.nan, 2.0])
    assert np.isnan(columns["never"]).all()
    assert set(columns.values) == {"count", "at_m", "word", "deep.a.b", "never"}
    with pytest.raises(KeyError, match=r"'depth': the columns are count, at_m"):
        columns["depth"]


def test_lists_of_any_length_stay_as_they_are(tmp_path: Path) -> None:
    columns = columns_of(
        tmp_path,
        {"said": [], "names": ["a"], "raw": b"12", "same": ["a", "b"]},
        {"said": [1.0], "names": ["b", "c"], "raw": b"", "same": ["c", "d"]},
    )
    assert columns["said"].tolist() == [[], [1.0]]
    assert columns["names"].tolist() == [["a"], ["b", "c"]]
    assert columns["raw"].tolist() == [b"12", b""]
    assert columns["same"].shape == (2,)


def test_a_logs_files_follow_one_another(tmp_path: Path) -> None:
    write(tmp_path / "a", "robot-3", {"count": 1})
    write(tmp_path / "a", "robot-3", {"count": 2})
    write(tmp_path / "b", "ground", {"count": 3})
    logs = log_arrays(tmp_path, "state", "order")
    assert {name: set(topics) for name, topics in logs.items()} == {
        "robot-3": {"state", "order"}, "ground": {"state", "order"},
    }  # fmt: skip
    assert logs["robot-3"]["state"]["count"].tolist() == [1, 2]
    assert logs["robot-3"]["order"].time_s.shape == (0,)
    alone = log_arrays(str(tmp_path / "a" / "robot-3-0002.mcap"), "state")
    assert alone["robot-3"]["state"]["count"].tolist() == [2]


def test_what_is_no_log_is_left_out_or_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="holds no logs"):
        log_arrays(tmp_path)
    write(tmp_path, "robot-3", {"count": 1})
    odd = tmp_path / "robot-4-0001.mcap"
    odd.write_text("this is no flight log")
    with pytest.warns(UserWarning, match=r"robot-4-0001\.mcap.*: skipped"):
        assert log_arrays(tmp_path)["robot-3"]["state"]["count"].tolist() == [1]
    with pytest.raises(FlightLogError, match=r"robot-4-0001\.mcap"):
        log_arrays(odd)
    with pytest.raises(OSError, match="gone"):
        log_arrays(tmp_path / "gone.mcap")
