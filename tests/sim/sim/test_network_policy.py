"""A torch module of a user's own flies wherever the paper's policy flies."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edge.drivers.log_reader import read
from edge.drivers.registry import load_policy
from edge.policy.bundle import Bundle, write_bundle
from lpac.analysis.policy_replay import replay
from lpac.sim.batch import fly_batch
from lpac.sim.description import FIELD_SCALE
from lpac.sim.drill.bounds import judge
from lpac.sim.drill.faults import FAULTS
from lpac.sim.drill.field import scenario_of
from lpac.sim.engines import fly
from lpac.sim.failure import Failure
from lpac.sim.points import fly_points
from lpac.sim.scenario import Scenario
from tests.flown import PRECISE
from tests.unit.export.test_module import Everything, Silent, exported


@pytest.fixture(scope="module")
def bundle() -> Bundle:
    """Attention, memory and denoising."""
    return exported(Everything)


def test_points_fly_alike_alone_and_in_a_batch(bundle: Bundle) -> None:
    """Places, velocities, ages and memories of neighbours are the same numbers in both."""
    scenario = Scenario(
        robots=5, seed=5, duration_s=6.0, loss=0.3, delay_s=0.15, scale=FIELD_SCALE,
        failures=(Failure(2, 1.0, until_s=3.0),), lag_s=0.5,
    )  # fmt: skip
    alone = fly_points(scenario, bundle)
    [batched] = fly_batch([scenario], bundle)
    np.testing.assert_array_equal(batched.positions_m, alone.positions_m)
    assert np.ptp(alone.positions_m, axis=0).max() > 0.5
    # Robot 2 has lost its memory: it does otherwise than without a restart.
    unbroken = fly_points(replace(scenario, failures=()), bundle)
    assert (unbroken.positions_m[:, 2] != alone.positions_m[:, 2]).any()


def test_messages_matter_and_a_network_may_send_none(bundle: Bundle) -> None:
    scenario = Scenario(robots=4, seed=3, duration_s=4.0)
    deaf = Scenario(robots=4, seed=3, duration_s=4.0, loss=1.0)
    heard, alone = fly_points(scenario, bundle), fly_points(deaf, bundle)
    assert (heard.positions_m != alone.positions_m).any()
    silent = exported(Silent)
    assert load_policy(silent).message_size == 0
    assert fly_points(scenario, silent).message_counts["accepted"] > 0


def test_whole_robots_fly_it_and_their_logs_compute_again(bundle: Bundle, tmp_path: Path) -> None:
    write_bundle(bundle, tmp_path / "bundle")
    scenario = Scenario(
        robots=3, seed=3, duration_s=8.0, errors=False, budget=PRECISE, communication_range=512.0
    )
    flown = fly(scenario, tmp_path / "bundle", engine="simulated", folder=tmp_path / "flight")
    assert flown.took_off and flown.flew_mission and flown.all_landed
    policy = load_policy(bundle)
    logs = sorted((tmp_path / "flight").rglob("robot-*.mcap"))
    assert len(logs) == 3
    for log in logs:
        steps = [message for _, _, message in read(log, "policy")]
        assert max(len(step["payloads"]) for step in steps) > 0
        assert any(step["inputs"]["memory"].any() for step in steps)
        for comparison in replay(policy, read(log, "perception", "policy")):
            assert comparison.ticks > 15 and comparison.differing == 0


@pytest.mark.parametrize("name", ["none", "program-dies"])
def test_a_drill_of_it_keeps_its_promises(bundle: Bundle, name: str, tmp_path: Path) -> None:
    write_bundle(bundle, tmp_path / "bundle")
    fault = FAULTS[name]
    record = fly(scenario_of(fault, 0, 3), tmp_path / "bundle", engine="simulated")
    assert record.took_off
    assert not [figure for figure in judge(fault.judged_by, record) if figure.broken]
