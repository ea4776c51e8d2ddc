"""Numbers of the records of known flights."""

import zipfile
from pathlib import Path

import numpy as np
import pytest

from lpac.analysis.flight import least_separation
from lpac.analysis.logs import read_files
from lpac.analysis.truth import TRUTH, TrueTrack, load_truth, write_truth


def track(x_m: float, time_s: tuple[float, ...] = (405.29, 409.97)) -> TrueTrack:
    """A track in the air, along y."""
    position_m = np.array([[x_m, float(k), 5.0] for k in range(len(time_s))])
    return TrueTrack(np.array(time_s), position_m, np.ones(len(time_s), np.bool_))


def test_the_least_separation_is_told_of_tracks_of_any_times() -> None:
    # The last of these times, in steps from the first, is 2e-12 s beyond it.
    separation = least_separation({"a": track(0.0), "b": track(3.0)})
    assert separation is not None
    assert abs(separation.distance_m - 3.0) < 1e-9 and separation.robots == ("a", "b")
    assert least_separation({"a": track(0.0), "b": track(3.0, (1.0, 2.0))}) is None
    assert least_separation({"a": track(0.0), "b": track(3.0), "c": track(1.0, ())}) is None


def test_who_is_on_the_ground_is_near_nobody() -> None:
    landed = TrueTrack(track(0.1).time_s, track(0.1).position_m, np.array([False, False]))
    separation = least_separation({"a": track(0.0), "b": landed, "c": track(3.0)})
    assert separation is not None and separation.robots == ("a", "c")


def test_the_truth_is_read_as_it_was_written(tmp_path: Path) -> None:
    write_truth({0: track(0.0), 7: track(3.0)}, tmp_path / TRUTH)
    tracks = load_truth(tmp_path / TRUTH)
    assert tracks.keys() == {0, 7}
    np.testing.assert_array_equal(tracks[7].position_m, track(3.0).position_m)
    np.testing.assert_array_equal(tracks[7].airborne, [True, True])


def test_what_is_no_truth_is_left_out_and_told(tmp_path: Path) -> None:
    path = tmp_path / TRUTH
    columns = {"time_s": np.zeros(2), "position_m": np.zeros((2, 3)), "airborne": np.ones(2, bool)}
    written = [
        {f"0.{name}": values for name, values in (columns | odd).items()}
        for odd in (
            {"position_m": np.zeros((2, 2))},
            {"time_s": np.array([1.0, 0.0])},
            {"time_s": np.array([np.nan, 0.0])},
            {"airborne": np.array(["yes", "no"])},
            {"time_s": np.array([None, None])},
        )
    ]
    for arrays in (*written, {"x": np.zeros(2)}, {"0.time_s": np.zeros(2)}):
        np.savez(path, **arrays)  # type: ignore[arg-type]
        (note,) = read_files([path]).notes
        assert note.endswith("skipped") and "is not a file of true tracks" in note
    for data in (b"", b"PK nothing of the kind"):
        path.write_bytes(data)
        with pytest.raises(ValueError, match="is not a file of true tracks"):
            load_truth(path)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("0.time_s.npy", bytes(2**20))
    with pytest.raises(ValueError, match="is compressed"):
        load_truth(path)
