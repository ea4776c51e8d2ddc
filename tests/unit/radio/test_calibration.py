"""Calibration of the radio model with records."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from edge.core.schema import ConfigError
from lpac.radio.airtime import MESSAGE_BYTES, Traffic, Transport, Wifi, airtime, link_quality
from lpac.radio.calibration import Calibration, Source, SourceKind, calibrated, read_wifi
from lpac.radio.records import RadioRecord, write_records

ASSUMED, FILE = Source(SourceKind.ASSUMED), Source(SourceKind.FILE)
FIELD = Wifi(data_rate_mbit_s=87.0, multicast_rate_mbit_s=12.0, frame_loss=0.15)

wifis = st.builds(
    Wifi,
    data_rate_mbit_s=st.floats(20.0, 800.0),
    multicast_rate_mbit_s=st.floats(2.0, 54.0),
    frame_loss=st.floats(0.0, 0.4),
    ground_wired=st.booleans(),
)


def measured(
    wifi: Wifi, transport: Transport, robots: int, *, rates: bool = False, busy: bool = True
) -> RadioRecord:
    """Records of a field as computed by the model."""
    size = MESSAGE_BYTES["float16"]
    traffic = Traffic(robots=robots, message_bytes=size)
    quality, sent = link_quality(transport, wifi, traffic), 10**7
    return RadioRecord(
        sender="r1", receiver="r2", transport=transport, robots=robots, message_bytes=size,
        message_hz=traffic.message_hz, sent=sent, received=round(sent * (1.0 - quality.loss)),
        loaded=False, ground_wired=wifi.ground_wired,
        age_p50_s=quality.delay_s,
        rate_mbit_s=wifi.data_rate_mbit_s if rates else None,
        busy_share=min(1.0, airtime(transport, wifi, traffic).busy) if busy else None,
    )  # fmt: skip


def assert_recovered(found: Wifi, wifi: Wifi) -> None:
    assert found.data_rate_mbit_s == pytest.approx(wifi.data_rate_mbit_s, rel=0.02)
    assert found.multicast_rate_mbit_s == pytest.approx(wifi.multicast_rate_mbit_s, rel=0.02)
    assert found.frame_loss == pytest.approx(wifi.frame_loss, abs=0.005)


@settings(max_examples=15, deadline=None)
@given(wifis, st.integers(2, 5), st.booleans())
def test_what_the_model_says_of_a_channel_tells_the_channel(
    wifi: Wifi, robots: int, rates: bool
) -> None:
    records = [
        measured(wifi, "mesh", robots, rates=rates), measured(wifi, "multicast", robots),
    ]  # fmt: skip
    assume(all(each.busy_share and each.busy_share <= 0.5 for each in records))
    assert_recovered(calibrated(records).wifi, wifi)


@settings(max_examples=10, deadline=None)
@given(wifis)
def test_what_nobody_said_stays(wifi: Wifi) -> None:
    assert calibrated([], wifi) == Calibration(wifi, dict.fromkeys(asdict(wifi), ASSUMED))


def kinds(records: Sequence[RadioRecord]) -> dict[str, SourceKind]:
    sources = calibrated(records).sources
    return {name: one.kind for name, one in sources.items() if one.kind is not SourceKind.ASSUMED}


def test_a_mesh_tells_the_data_rate_alone() -> None:
    records = [measured(FIELD, "mesh", robots) for robots in (3, 5)]
    assert kinds(records) == {"data_rate_mbit_s": SourceKind.BUSY}
    found = calibrated(records)
    assert found.sources["data_rate_mbit_s"].records == 2
    assert found.wifi == replace(Wifi(), data_rate_mbit_s=found.wifi.data_rate_mbit_s)


def test_multicast_tells_its_rate_only_where_the_data_rate_is_known() -> None:
    alone = [measured(FIELD, "multicast", 5)]
    assert kinds(alone) == {"frame_loss": SourceKind.DELIVERED}
    with_rates = [measured(FIELD, "multicast", 5, rates=True)]
    assert kinds(with_rates) == {
        "data_rate_mbit_s": SourceKind.RATES,
        "multicast_rate_mbit_s": SourceKind.BUSY,
        "frame_loss": SourceKind.DELIVERED,
    }
    assert_recovered(calibrated(with_rates).wifi, FIELD)


def test_the_rates_are_weighed_by_the_time_that_they_take() -> None:
    fast, slow = (measured(Wifi(data_rate_mbit_s=r), "mesh", 3, rates=True) for r in (300.0, 60.0))
    assert calibrated([fast, slow]).wifi.data_rate_mbit_s == pytest.approx(100.0)


def test_a_busy_channel_tells_nothing_but_the_radios_rates() -> None:
    busy = replace(measured(FIELD, "mesh", 5), busy_share=0.8)
    heard = replace(measured(FIELD, "multicast", 5), busy_share=0.8, received=1)
    assert kinds([busy, heard]) == {}
    assert kinds([replace(busy, rate_mbit_s=90.0)]) == {"data_rate_mbit_s": SourceKind.RATES}


def test_what_was_recorded_beside_a_bulk_stream_tells_nothing() -> None:
    """Otherwise losses from the stream would count as noise."""
    quiet = [measured(FIELD, "multicast", 5, rates=True)]
    beside = [replace(each, loaded=True, busy_share=None, received=1) for each in quiet]
    assert kinds(beside) == {}
    assert calibrated([*quiet, *beside]) == calibrated(quiet)


def test_a_channel_that_the_model_cannot_explain_tells_no_rate() -> None:
    """Three robots cannot leave a channel so idle at any rate."""
    assert kinds([replace(measured(FIELD, "mesh", 3), busy_share=1e-6)]) == {}


@pytest.mark.parametrize(("received", "loss"), [(10**7, 0.0), (0, 0.99)])
def test_where_all_or_nothing_arrives_the_loss_is_the_least_or_the_greatest(
    received: int, loss: float
) -> None:
    record = replace(measured(FIELD, "multicast", 3), received=received)
    assert calibrated([record]).wifi.frame_loss == pytest.approx(loss, abs=1e-6)


# Files


def test_without_a_file_all_is_assumed() -> None:
    assert read_wifi(None) == Calibration(Wifi(), dict.fromkeys(asdict(Wifi()), ASSUMED))


def test_a_toml_file_has_what_it_has(tmp_path: Path) -> None:
    path = tmp_path / "wifi.toml"
    path.write_text("data_rate_mbit_s = 100\nground_wired = false\n")
    found = read_wifi(path)
    assert found.wifi == Wifi(data_rate_mbit_s=100.0, ground_wired=False)
    assert {name for name, source in found.sources.items() if source == FILE} == {
        "data_rate_mbit_s", "ground_wired",
    }  # fmt: skip


def test_records_of_no_radio_are_refused(tmp_path: Path) -> None:
    """Robots of `lpac sim` receive as if from a perfect channel."""
    path = tmp_path / "loopback.jsonl"
    silent = measured(Wifi(frame_loss=0.0), "multicast", 3, busy=False)
    write_records(path, [silent, silent])
    with pytest.raises(ConfigError, match="no record has a radio's signal"):
        read_wifi(path)
    # One robot's radio may lack values that others have.
    write_records(path, [silent, replace(silent, signal_dbm=-60.0)])
    assert read_wifi(path).sources["frame_loss"] == Source(SourceKind.DELIVERED, 2)


def test_records_are_read(tmp_path: Path) -> None:
    path = tmp_path / "field.jsonl"
    records = [measured(FIELD, "mesh", 3), measured(FIELD, "multicast", 3)]
    write_records(path, records)
    assert read_wifi(path) == calibrated(records)


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("wifi.toml", "rate = 3", "unknown key 'rate'; known are data_rate_mbit_s, multicast_"),
        ("wifi.toml", "frame_loss = 1.5", "frame_loss = 1.5: must be at least 0 and below 1"),
        ("wifi.toml", "data_rate_mbit_s = 0", "data_rate_mbit_s = 0: must be above 0"),
        ("wifi.toml", "queue_s = inf", "queue_s = inf: must be at least 0 and finite"),
        ("wifi.toml", "queue_s = '1'", "queue_s = '1': must be a number"),
        ("wifi.toml", "ground_wired = 1", "ground_wired = 1: must be true or false"),
        ("wifi.toml", "frame_loss", "is not TOML"),
        ("wifi.toml", "#\udcff", "is not TOML"),
        ("wifi.jsonl", "", "no record has information about the model's values"),
        ("wifi.jsonl", "{}", "line 1: sender is missing"),
        ("wifi.yaml", "", "must be a .toml file of the model's values, or a .jsonl file"),
    ],
)
def test_a_mistake_is_named(tmp_path: Path, name: str, text: str, told: str) -> None:
    path = tmp_path / name
    path.write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(ConfigError) as caught:
        read_wifi(path)
    assert str(caught.value).startswith(str(path)) and told in str(caught.value)
