"""`lpac drill` with processes, in real time."""

import json
from pathlib import Path

import pytest

from tests.command import error_line, lpac

# Of programs, the ground, a position, a battery, and a pilot. The longest first.
FAULTS = (
    "ground-restarts", "program-goes-on", "program-dies", "gps-lost", "battery-critical",
    "pilot-lands-it",
)  # fmt: skip


@pytest.mark.alone
def test_six_faults_are_flown_by_processes(tmp_path: Path) -> None:
    named = [option for fault in FAULTS for option in ("--fault", fault)]
    # Of a seed with which they begin early.
    result = lpac(
        "drill", "--vehicle", "mavlink", "-n", 2, "--seed", 2, *named, "--json", "--out", tmp_path
    )
    assert result.stdout, result.stderr
    flown = json.loads(result.stdout)
    assert flown["broken"] == []
    assert {each["fault"] for each in flown["faults"]} == {*FAULTS}
    assert result.returncode == 0
    for fault in FAULTS:
        assert (tmp_path / f"{fault}-2" / "drill.png").exists()
        assert list((tmp_path / f"{fault}-2" / "robots").rglob("*.mcap"))


def test_what_cannot_be_flown_is_one_line(tmp_path: Path) -> None:
    for arguments, text in (
        (("--vehicle", "mavlink", "--fault", "radio-dies"), "radio-dies: mavlink cannot do it"),
        (("--vehicle", "px4"), "--vehicle px4 needs --px4 with PX4's build folder"),
        (("--vehicle", "px4", "--px4", tmp_path), "has no program bin/px4"),
        (("--px4", tmp_path), "--px4 does nothing with --vehicle simulated"),
        (("--vehicle", "mavlink", "--ray", "auto"), "--ray does nothing with --vehicle mavlink"),
    ):
        assert text in error_line(lpac("drill", *arguments, "--out", tmp_path / "out"))
