"""Coverage cost over team size, by transport, in docs/network.md."""

from typing import Any

from handbook.scaling_cost import IDEAL, table, teams_of


def told(robots: int, worlds: int, costs: dict[str | None, float]) -> dict[str, Any]:
    """The evaluation.json of a team."""
    return {
        "worlds": worlds,
        "conditions": [
            {
                "scenario": {
                    "robots": robots,
                    "radio": transport and {"transport": transport},
                    "link": {"loss": 0.25, "delay_s": 0.3031},
                },
                "results": [{"over_clairvoyant": {"ratio_of_means": [cost, cost, cost + 0.1]}}],
            }
            for transport, cost in costs.items()
        ],
    }


TEAMS = [
    *teams_of(told(100, 2, {None: 1.1, "mesh": 1.456})),
    *teams_of(told(10, 10, {None: 1.05, "mesh": 1.06, "multicast": 1.07})),
]


def test_the_table_has_a_row_for_each_radio_and_a_column_for_each_size() -> None:
    assert table(TEAMS).splitlines() == [
        "| times the clairvoyant | 10 robots | 100 robots |",
        "| --- | --- | --- |",
        "| worlds | 10 | 2 |",
        f"| {IDEAL} | 1.05 | 1.10 |",
        "| mesh | 1.06 (25 %, 303 ms) | 1.46 (25 %, 303 ms) |",
        "| multicast | 1.07 (25 %, 303 ms) |  |",
    ]
