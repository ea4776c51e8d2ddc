"""Benches run at their smallest size; speed is not tested."""

import json
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("torch_geometric", reason="the benches compare with it")

from bench import policy, scaling
from bench.result import Result
from edge.policy.bundle import Bundle


def kept(report: Result, folder: Path) -> dict[str, Any]:
    """Content of the report's file, after it was shown."""
    report.show()
    report.write(folder)
    result: dict[str, Any] = json.loads((folder / f"{report.name}.json").read_text())
    return result


def check_frame(result: dict[str, Any], name: str, targets: int) -> None:
    assert result["bench"] == name
    assert result["machine"]["packages"]["onnxruntime"]
    assert len(result["targets"]) == targets
    assert all(isinstance(target["met"], bool) for target in result["targets"])


@pytest.mark.slow
def test_policy(tmp_path: Path) -> None:
    result = kept(policy.measure(rounds=2, round_s=0.001), tmp_path)
    check_frame(result, "policy", targets=5)
    both = {policy.EDGE, policy.EAGER}
    for name, variants in (("tick", {*both, policy.TRACED, policy.FORM}), ("gnn", both)):
        figures = result["figures"][name]
        assert figures["largest_difference"] <= policy.TOLERANCE
        assert set(figures["slower_than_edge"]) == variants
        assert figures["slower_than_edge"][policy.EDGE]["median"] == 1.0
    assert result["figures"]["cnn"]["flop"] > 30e6


@pytest.mark.parametrize(("robots", "world_size"), [(1, 162), (2, 229), (10, 512)])
def test_robots_of_the_scaling_bench_have_as_much_room_each(
    shipped_bundle: Bundle, robots: int, world_size: int
) -> None:
    perception = scaling.world_for(shipped_bundle, robots).manifest.perception
    assert perception is not None and perception.world_size == world_size
