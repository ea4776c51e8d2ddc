"""Report of the network experiment, with the figures of `lpac bench network`."""

from collections.abc import Mapping
from typing import Any

from edge.core.counted import counted
from lpac.study.report import Picture, Report, Table


def network_report(data: Mapping[str, Any], made_by: Mapping[str, str]) -> Report:
    """Make the report from the JSON of `lpac bench network`."""
    measured_on = data["measured_on"]
    where = "on this machine's loopback, which has no radio"
    if measured_on["where"] != "loopback":
        where = f"between network namespaces ({', '.join(measured_on['namespaces'])})"
    flown = f"No vehicles: programs that send what robots send, beside a stream, measured {where}."
    rows = [
        [of["experiment"], of["middleware"], str(of["robots"]),
         _spread(of.get("throughput_mbit_s")), _spread(of.get("delivered"), 100.0),
         _spread(of.get("age_p50_ms"))]
        for of in data["summaries"]
    ]  # fmt: skip
    headings = ["", "", "robots", "Mbit/s", "delivered, %", "age p50, ms"]
    versions = ", ".join(f"{name} {version}" for name, version in measured_on["versions"].items())
    unmet = sum(not run["met"] for run in data["runs"])
    not_met = f"{counted(unmet, 'run')} left out: not all robots had met. " if unmet else ""
    note = (
        f"Mean and standard deviation over the runs. {not_met}{versions}; Linux "
        f"{measured_on['kernel']}, {measured_on['cores']} cores."
    )
    runs = data["runs"]
    return Report(
        name="network",
        title="Network",
        text="The paper measures what a stream gets while the programs of three robots restart "
        "(Table I), and how that falls as robots are switched on one after another. " + flown,
        data=data,
        rows=[list(runs[0]), *(list(run.values()) for run in runs)],
        tables=[Table(headings, rows, note=note)],
        figures=[
            Picture(f"{name}.png", name) for name in dict.fromkeys(of["experiment"] for of in runs)
        ],
        flown=flown,
        made_by=made_by,
    )


def _spread(of: Mapping[str, Any] | None, factor: float = 1.0) -> str:
    if of is None:
        return ""
    mean = f"{factor * of['mean']:.1f}"
    return mean if of["deviation"] is None else f"{mean} ± {factor * of['deviation']:.1f}"
