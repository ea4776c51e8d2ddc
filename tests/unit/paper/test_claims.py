"""Verdicts on the paper's claims, and the page with them."""

import html
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lpac.cli.paper
from edge.core.frames import MissionFrame
from edge.policy.bundle import Bundle
from lpac.cli.study import StudyTask
from lpac.paper.claims import (
    Agreement,
    Claim,
    Effort,
    Json,
    Sizes,
    claims_of,
    printed_rotation,
)
from lpac.paper.repeated import CHAPTERS, effort_of, sizes_of, write_page
from lpac.study.report import Report
from lpac.study.summary import WHOLE_ROBOTS

TIME_S = [float(t) for t in range(61)]
FALLS = [0.2 + 0.8 * math.exp(-t / 8.0) for t in TIME_S]
SIZES = Sizes(3600, 3600)
EFFORT = Effort(4e-3, 5e-3)


def flight(cost: list[float]) -> dict[str, Any]:
    return {"time_s": TIME_S, "normalized_cost": cost, "final": cost[-1]}


def of_worlds(*costs: list[float]) -> dict[str, Any]:
    worlds = {
        f"world {n}": {"lpac": flight(cost), "clairvoyant-cvt": flight(FALLS)}
        for n, cost in enumerate(costs)
    }
    return {"flights": worlds}


def of_whole_robots(cost: list[float]) -> dict[str, Any]:
    """Costs of whole robots, with points that settle in time."""
    return {
        "flights": {
            name: {WHOLE_ROBOTS: flight(cost), **points}
            for name, points in of_worlds(FALLS)["flights"].items()
        }
    }


def repeated(deviation: float) -> dict[str, Any]:
    spread = {
        "end_s": 40.0, "final_mean": 0.3, "final_deviation": deviation,
        "largest_deviation_in_flight": 0.1, "mean_scatter_of_ends_m": 1.5,
    }  # fmt: skip
    return {
        "trials": {"1": {}, "2": {}}, "looked_at_s": 40.0, "spread": spread,
        "mission_from_s": {"1": 28.0, "2": 27.0}, "mission_final": {"1": 0.2, "2": 0.3},
    }  # fmt: skip


def taken(worst: float, end: float, neighbours: float = 2.0) -> dict[str, Any]:
    phase = {"cost_before": 0.2, "settled_s": 3.0}
    return {
        "phases": [
            {**phase, "away": True, "cost_worst": worst, "cost_end": 0.21},
            {**phase, "away": False, "cost_worst": 0.21, "cost_end": end},
        ],
        "neighbours": {"mean": neighbours, "others": 9},
    }


def rates(together: float, slow: float, fast: float) -> dict[str, Any]:
    def timing(policy_hz: float, ratio: float, synchronous: bool = False) -> dict[str, Any]:
        return {
            "perception_hz": 5.0, "policy_hz": policy_hz, "synchronous": synchronous,
            "delay_s": 0.0, "over_field": [[ratio, ratio - 0.02, ratio + 0.02]] * 3,
        }  # fmt: skip

    timings = [timing(2.5, 1.0), timing(2.5, together, True), timing(0.5, slow), timing(10.0, fast)]
    return {"worlds": 4, "times_s": [15.0, 30.0, 60.0], "timings": timings}


def measured(where: str, zenoh: float, dds: float) -> dict[str, Any]:
    def summary(experiment: str, middleware: str, robots: int, mbit_s: float) -> dict[str, Any]:
        spread = {"mean": mbit_s, "deviation": None, "runs": 1}
        return {
            "experiment": experiment, "middleware": middleware, "robots": robots,
            "throughput_mbit_s": spread,
        }  # fmt: skip

    return {
        "measured_on": {"where": where},
        "summaries": [
            summary("restarts", "zenoh", 3, zenoh), summary("restarts", "cyclonedds", 3, dds),
            summary("robots", "zenoh", 1, 50.0), summary("robots", "zenoh", 3, 40.0),
        ],
    }  # fmt: skip


def transferred(over: float) -> dict[str, Any]:
    result = {"name": "field", "over_clairvoyant": {"ratio_of_means": [over, 1.0, 2.0]}}
    methods = [{"name": "field", "bundles": [{}]}, {"name": "clairvoyant-cvt", "bundles": []}]
    return {"worlds": 2, "methods": methods, "conditions": [{"name": "n3", "results": [result]}]}


def claim(made: Mapping[str, Json], name: str) -> Claim:
    [found] = [claim for claim in claims_of(made, SIZES, EFFORT) if claim.name.startswith(name)]
    return found


@pytest.mark.parametrize(
    ("name", "agrees", "differs"),
    [
        ("E1", {"e1": of_worlds(FALLS, FALLS, FALLS[::-1])},
         {"e1": of_worlds(FALLS, FALLS[::-1])}),
        ("E1", {"e1": of_whole_robots(FALLS)},
         {"e1": of_whole_robots(FALLS[::-1])}),
        ("E2", {"e2": repeated(0.05)}, {"e2": repeated(0.07)}),
        ("E3", {"e3": taken(0.3, 0.21)}, {"e3": taken(0.3, 0.25)}),
        ("E3", {"e3": taken(0.3, 0.21)}, {"e3": taken(0.4, 0.21)}),
        ("Transfers", {"transfer": transferred(1.2)},
         {"transfer": transferred(1.3)}),
        ("Asynchronous", {"async": rates(1.0, 1.0, 1.0)},
         {"async": rates(0.9, 1.0, 1.0)}),
        ("An exchange slower", {"async": rates(1.0, 0.9, 1.0)},
         {"async": rates(1.0, 1.1, 1.0)}),
        ("An exchange faster", {"async": rates(1.0, 1.0, 0.9)},
         {"async": rates(1.0, 1.0, 1.1)}),
        ("Table I", {"network": measured("namespaces", 80.0, 40.0)},
         {"network": measured("namespaces", 50.0, 40.0)}),
    ],
)  # fmt: skip
def test_a_verdict_follows_from_the_numbers(
    name: str, agrees: Mapping[str, Json], differs: Mapping[str, Json]
) -> None:
    assert claim(agrees, name).verdict is Agreement.AGREES
    assert claim(differs, name).verdict is Agreement.DIFFERS


def test_robots_that_hear_nearly_all_say_nothing_of_a_decentralised_policy() -> None:
    for neighbours, verdict in ((5.0, Agreement.AGREES), (8.5, Agreement.OPEN)):
        made = {"e3": taken(0.3, 0.21, neighbours=neighbours)}
        assert claim(made, "Decentralised").verdict is verdict


def test_where_robots_take_off_one_after_another_the_missions_ends_are_told_too() -> None:
    assert "28 s after the takeoff command" in claim({"e2": repeated(0.05)}, "E2").ours
    points = {**repeated(0.05), "mission_from_s": {"1": 0.0, "2": 0.0}}
    assert "takeoff command" not in claim({"e2": points}, "E2").ours


def test_what_the_data_do_not_tell_is_not_told() -> None:
    on_loopback = {"network": measured("loopback", 80.0, 40.0)}
    for name in ("Table I", "Figure"):
        assert claim(on_loopback, name).verdict is Agreement.OPEN
    undecided = {"async": rates(1.0, 1.0, 1.0)}
    assert claim(undecided, "An exchange slower").verdict is Agreement.OPEN
    # Synchronised robots have 0.95 times the cost, with an interval on both sides of 5 %.
    in_step = {"async": rates(0.95, 1.0, 1.0)}
    assert claim(in_step, "Asynchronous").verdict is Agreement.OPEN
    names = [claim.name for claim in claims_of({}, SIZES, EFFORT)]
    assert not any(name.startswith("E1") for name in names) and len(names) == 5


def test_the_printed_rotation_is_right_at_a_heading_of_90_degrees_alone() -> None:
    for heading_deg, right in ((0, False), (30, False), (90, True)):
        frame = MissionFrame(40.0, -75.0, math.radians(heading_deg))
        ours = frame.relative_to(40.0, -75.0)
        printed = printed_rotation(math.radians(heading_deg))
        for axis in np.eye(3):
            same = np.allclose(printed @ axis, ours.velocity_to_local(axis))
            assert same or not right
        assert right == np.allclose(printed @ [0, 1, 0], ours.velocity_to_local(np.eye(3)[1]))
    rotation = claim({}, "Equation 4")
    assert rotation.verdict is Agreement.MISTAKE
    assert "towards 180° if θ is 0°" in rotation.ours and "90° if θ is 90°" in rotation.ours


def test_one_page_holds_everything(tmp_path: Path, shipped_bundle: Bundle) -> None:
    made = {"e2": repeated(0.02), "e3": taken(0.3, 0.21)}
    png = bytes.fromhex("89504e470d0a1a0a")
    for chapter in CHAPTERS:
        if chapter.name in made:
            folder = tmp_path / chapter.name
            folder.mkdir()
            document = {**made[chapter.name], "flown": f"Points, in {chapter.name}."}
            (folder / f"{chapter.name}.json").write_text(json.dumps(document))
            for figure in chapter.figures:
                (folder / f"{figure}.png").write_bytes(png)
    made_by = {name: {"command": f"lpac paper {name} <quick>"} for name in made}
    page = write_page(tmp_path, shipped_bundle, made_by).read_text()
    assert page.count("data:image/png;base64,") == 2 and "http" not in page
    assert "lpac paper e2 &lt;quick&gt;" in page and 'id="e1"' not in page
    assert all(f"Points, in {name}." in page for name in made)
    told = json.loads((tmp_path / "claims.json").read_text())
    assert told["made_by"] == made_by
    assert {c["name"].split(":")[0] for c in told["claims"]} > {"E2", "E3", "Equation 4"}
    assert all(claim["rule"] in html.unescape(page) for claim in told["claims"])
    for number in range(len(told["claims"])):
        assert f'href="#claim-{number}"' in page and f'id="claim-{number}"' in page


def test_a_message_does_not_grow_with_who_is_heard(shipped_bundle: Bundle) -> None:
    sizes = sizes_of(shipped_bundle)
    assert sizes.of_two == sizes.of_hundred > 2 * 870
    for told, verdict in (
        (sizes, Agreement.AGREES),
        (Sizes(sizes.of_two, sizes.of_two + 1), Agreement.DIFFERS),
    ):
        [size] = [one for one in claims_of({}, told, EFFORT) if one.name == "Message size"]
        assert size.verdict is verdict


def test_a_step_among_a_hundred_is_held_against_one_among_two(shipped_bundle: Bundle) -> None:
    measured = effort_of(shipped_bundle)
    assert measured.of_two_s > 0.0 and measured.of_hundred_s > 0.0
    for effort, verdict in (
        (Effort(4e-3, 7.9e-3), Agreement.AGREES),
        (Effort(4e-3, 8.1e-3), Agreement.DIFFERS),
    ):
        found = claims_of({}, SIZES, effort)
        [computation] = [one for one in found if one.name == "Computation"]
        assert computation.verdict is verdict


def test_what_was_made_is_not_made_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    documents = {
        "e1": of_worlds(FALLS), "e2": repeated(0.02), "e3": taken(0.3, 0.21),
        "transfer": transferred(1.2), "async": rates(1.0, 1.0, 1.0),
        "network": measured("loopback", 80.0, 40.0),
    }  # fmt: skip
    asked: list[str] = []

    def make(name: str, out: Path) -> None:
        asked.append(name)
        out.mkdir(parents=True, exist_ok=True)
        (out / f"{name}.json").write_text(json.dumps({**documents[name], "flown": "Not."}))

    def fly(tasks: Sequence[StudyTask], *_: object) -> list[Report]:
        for task in tasks:
            make(task.name, task.folder)
        empty = Report(
            name="", title="", text="", data={}, rows=(), tables=(), figures=(), flown="",
            made_by={},
        )  # fmt: skip
        return [empty] * len(tasks)

    monkeypatch.setattr(lpac.cli.paper, "fly_together", fly)
    monkeypatch.setattr(lpac.cli.paper, "network", lambda *, out, **_: make("network", out))
    lpac.cli.paper.everything(quick=True, out=tmp_path)
    assert sorted(asked) == sorted(documents)
    lpac.cli.paper.everything(quick=True, out=tmp_path)
    assert len(asked) == len(documents)
    # Results other than quick ones are made again.
    lpac.cli.paper.everything(out=tmp_path)
    assert sorted(asked[len(documents) :]) == sorted(documents)
    assert capsys.readouterr().out.endswith(f"see {tmp_path / 'index.html'}\n")
