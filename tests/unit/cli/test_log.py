"""Commands' output on logs that are damaged or empty, or whose clock was set."""

import contextlib
import json
import re
import shutil
from pathlib import Path

import pytest

from edge.drivers.flight_log import FlightLog, FlightMetadata
from lpac.analysis.arrays import log_arrays
from lpac.analysis.logs import read_logs
from lpac.cli.log import repair, trials
from lpac.cli.replay import replay
from tests.conftest import ROOT

METADATA = FlightMetadata(3, 77, "ab" * 32, "policies/x", "{}", "0.1.0")
RECORDED = ROOT / "tests" / "unit" / "flight" / "recorded" / "armed_by_others.mcap"


def said(uptime_s: float, trial: str = "t1") -> dict[str, object]:
    return {"uptime_s": uptime_s, "boot_nonce": 77, "trial": trial}


def flown(folder: Path, clock_s: list[float]) -> Path:
    """A log with a status each second; `clock_s` is what the clock said then."""
    with contextlib.closing(FlightLog(folder, METADATA, sync_period_s=0)) as log:
        for uptime_s, time_s in enumerate(clock_s):
            log.record("status", time_s, said(float(uptime_s)))
            log.flush()
    return folder / "robot-3-0001.mcap"


def damage(path: Path, chunk: int) -> None:
    data = bytearray(path.read_bytes())
    data[[found.start() for found in re.finditer(b"zstd", data)][chunk] + 30] ^= 0xFF
    path.write_bytes(data)


def test_trials_are_listed_behind_damage_and_the_gap_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = flown(tmp_path, [1.7e9 + s for s in range(20)])
    damage(path, 10)
    (tmp_path / "robot-3-0002.mcap").touch()
    trials(tmp_path, as_json=True)
    out, err = capsys.readouterr()
    assert json.loads(out)[path.name]["t1"] == [1.7e9, 1.7e9 + 19]
    damaged, empty = err.splitlines()
    assert f"{path}: is damaged: holds nothing from 20" in damaged and " to 20" in damaged
    assert "robot-3-0002.mcap: breaks off: holds nothing" in empty
    repair(path, tmp_path / "mended.mcap")
    out, err = capsys.readouterr()
    assert "mended.mcap: 19 messages" in out and err == f"{damaged}\n"


def test_a_clock_that_was_set_in_flight_does_not_stretch_a_trial(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flown(tmp_path, [60.0, 61.0, 62.0, 1.7e9 + 3, 1.7e9 + 4])
    trials(tmp_path, as_json=True)
    (found,) = json.loads(capsys.readouterr().out).values()
    assert found == {"t1": [1.7e9, 1.7e9 + 4]}
    trials(tmp_path)
    assert "1970" not in capsys.readouterr().out


def test_arrays_and_reports_say_what_is_missing(tmp_path: Path) -> None:
    path = flown(tmp_path, [1.7e9 + s for s in range(20)])
    damage(path, 10)
    with pytest.warns(UserWarning, match="is damaged: holds nothing from 20"):
        assert len(log_arrays(path, "status")["robot-3"]["status"].time_s) == 19
    assert any("is damaged: holds nothing from" in note for note in read_logs([tmp_path]).notes)


def test_replay_goes_on_and_does_not_say_that_all_is_as_it_was(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "robot-0-0001.mcap").touch()
    good, bad = (tmp_path / f"robot-0-000{n}.mcap" for n in (2, 3))
    shutil.copy(RECORDED, good)
    replay([tmp_path])
    out, err = capsys.readouterr()
    assert "decides what it decided in flight" in out
    assert "robot-0-0001.mcap: was not written by a robot" in err and "left out" in err
    shutil.copy(RECORDED, bad)
    damage(bad, 0)
    with pytest.raises(ValueError, match=r"not all could be replayed: robot-0-0003\.mcap"):
        replay([tmp_path])
    assert f"{bad}: is damaged: holds nothing from" in capsys.readouterr().err
