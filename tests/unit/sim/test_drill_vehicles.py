"""Which vehicles fly which faults, and what is made of a flight of a machine that was late."""

import math
import re

import numpy as np
import pytest

from handbook.faults import page
from lpac.analysis.flight import FaultRecord, FlightRecord
from lpac.analysis.truth import TrueTrack
from lpac.sim.description import ERRORS, fence_around
from lpac.sim.drill.faults import FAULTS
from lpac.sim.drill.field import supports
from lpac.sim.drill.outcome import LATE_S, outcome_of
from lpac.sim.drill.processes import MAVLINK, PX4
from lpac.sim.drill.simulated import SUPPORTED
from lpac.sim.px4.modes import Px4Mode
from tests.conftest import ROOT


def test_the_table_tells_who_flies_what() -> None:
    rows = re.findall(
        r"^\| ([a-z0-9-]+)(?: (M?)(P?))? \| .*<br>.* \| .* \|$",
        page(),
        re.MULTILINE,
    )
    assert rows == [
        (
            fault.name,
            "M" if supports(MAVLINK, fault) else "",
            "P" if supports(PX4, fault) else "",
        )
        for fault in FAULTS.values()
    ]
    assert all(supports(SUPPORTED, fault) for fault in FAULTS.values())


def test_hazards_are_shown_by_faults_that_exist() -> None:
    """Of the hazards of docs/risks.md, by their numbers."""
    text = (ROOT / "docs" / "risks.md").read_text()
    rows = re.findall(r"^\| (\d+)\. .* \| (.*) \| .* \|$", text, re.MULTILINE)
    assert [int(number) for number, _ in rows] == list(range(1, len(rows) + 1))
    named = [name for _, shown in rows for name in re.findall(r"`([a-z0-9-]+)`", shown)]
    assert len(named) > 20 and set(named) <= set(FAULTS)


def never_down(late_s: float) -> FlightRecord:
    """A flight that ends in the air."""
    count = 3
    vehicle = TrueTrack(
        time_s=np.array([0.0, 0.04, 0.08]),
        position_m=np.full((count, 3), 8.0),
        airborne=np.ones(count, np.bool_),
        velocity_m_s=np.zeros((count, 3)),
        mode=np.full(count, Px4Mode.OFFBOARD),
        armed=np.ones(count, np.bool_),
        setpoint_at_s=np.full(count, -math.inf),
        is_velocity=np.zeros(count, np.bool_),
        velocity_error_m_s=np.zeros(count),
        commands=np.zeros(count, np.int64),
    )
    return FlightRecord(
        name="drill", duration_s=0.0, from_s=0.0, to_s=0.08, robots=(), coverage=None,
        sensor_size=64, cost_time_s=np.zeros(0), truth={"r0": vehicle},
        fence=fence_around(32.0, 1, ERRORS),
        fault=FaultRecord(begin_s=0.0, pads_m=np.zeros((1, 2)), drone_m=0.5, late_s=late_s),
    )  # fmt: skip


def test_what_breaks_while_the_machine_is_late_is_not_judged() -> None:
    fault = FAULTS["held"]
    judged = outcome_of(fault, lambda: never_down(LATE_S))
    assert not judged.error and "not down in the end" in {each.name for each in judged.broken}
    late = outcome_of(fault, lambda: never_down(LATE_S + 0.1))
    assert late.error.startswith("not judged (not down in the end")
    assert late.error.endswith("this machine was 0.3 s behind real time")
    assert late.late_s == pytest.approx(LATE_S + 0.1)
