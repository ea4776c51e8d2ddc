"""Claims of the paper, and the verdicts of the experiments here. Pure: numbers from their JSON.

Each verdict follows from a rule that is written beside its claim.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np

from edge.core.counted import counted
from lpac.analysis.statistics import Interval95
from lpac.radio.airtime import TRANSPORTS, Traffic, Wifi, capacity
from lpac.study.rates import FIELD as FIELD_TIMING
from lpac.study.rates import Timing
from lpac.study.summary import WHOLE_ROBOTS
from lpac.study.worlds import FIELD, SET_UPS

Json = Mapping[str, Any]

# A cost has settled when it stays within this share of its final value.
_SETTLED = 0.1
# Final costs of trials are similar if their deviation is at most this share of their mean.
_SIMILAR = 0.2
# Largest cost, relative to the one before, with a robot away and after its return.
_AWAY, _BACK = 1.6, 1.1
# In other worlds, the largest cost over clairvoyant's that counts as a transfer.
_TRANSFERS = 1.25
# If more than this share of the others is in range, a swarm hardly differs from a centralised one.
_NEARLY_ALL = 0.9
# A step with a hundred neighbours takes at most this multiple of one with two.
_AS_LONG = 2.0
# Largest relative cost of unsynchronised robots.
_ASYNCHRONOUS = 1.05


class Agreement(StrEnum):
    """Result of a comparison with the paper."""

    AGREES = "agrees"
    DIFFERS = "differs"
    OPEN = "undecided"
    MISTAKE = "a mistake in the paper"


@dataclass(frozen=True, slots=True)
class Claim:
    """`paper` is the claim, `rule` the condition of agreement, `ours` the result here."""

    name: str
    paper: str
    rule: str
    ours: str
    verdict: Agreement


class Sizes(NamedTuple):
    """Sizes of a robot's largest message with two and a hundred neighbours; bytes in float16."""

    of_two: int
    of_hundred: int


class Effort(NamedTuple):
    """Times of a robot's perception and policy with two and a hundred neighbours; s."""

    of_two_s: float
    of_hundred_s: float


def claims_of(made: Mapping[str, Json], sizes: Sizes, effort: Effort) -> list[Claim]:
    """All claims with results in `made`, in the paper's order.

    `made` has the JSON of each experiment by the name of its command.
    """
    found = [_decentralised(made["e3"])] if "e3" in made else []
    found += [_size(sizes), _computation(effort)]
    for name, claims in (
        ("e1", _e1), ("e2", _e2), ("e3", _e3), ("transfer", _transfer), ("async", _asynchrony),
        ("network", _network),
    ):  # fmt: skip
        if name in made:
            found += claims(made[name])
    return [*found, _team(), _rotation(), _density()]


def _agrees(holds: bool) -> Agreement:
    return Agreement.AGREES if holds else Agreement.DIFFERS


def _size(sizes: Sizes) -> Claim:
    return Claim(
        "Message size",
        "A message's size does not depend on the number of robots.",
        "A robot with a hundred neighbours sends no more bytes than one with two.",
        f"{sizes.of_two} bytes at most in float16, with beacon, envelope and shared map, for two "
        f"neighbours; {sizes.of_hundred} for a hundred.",
        _agrees(sizes.of_hundred <= sizes.of_two),
    )


def _computation(effort: Effort) -> Claim:
    ratio = effort.of_hundred_s / effort.of_two_s
    return Claim(
        "Computation",
        "What a robot computes does not depend on the number of robots.",
        f"A step with a hundred neighbours, all in range, takes at most {_AS_LONG:g} times as long "
        "as one with two: fifty times as many may at most double it.",
        f"Perception and policy, alternating on one core of the machine that wrote this page: "
        f"{1e3 * effort.of_two_s:.2f} ms with two, {1e3 * effort.of_hundred_s:.2f} ms with a "
        f"hundred, {ratio:.2f} times as long. The networks compute the same in both; only drawing "
        "maps and adding messages grows with the number of neighbours. Authentication and decoding "
        "of messages are not included, and grow with the number of senders.",
        _agrees(ratio <= _AS_LONG),
    )


def _decentralised(e3: Json) -> Claim:
    mean, others = e3["neighbours"]["mean"], e3["neighbours"]["others"]
    return Claim(
        "Decentralised",
        "Each robot decides by its own sensor and its neighbours' messages.",
        "No other messages reach a robot's policy. It is undecided if on average more than "
        f"{100.0 * _NEARLY_ALL:.0f} % of the others are in range, which hardly differs from "
        "knowing all.",
        f"In E3's flight a robot had {mean:.1f} of {others} others in range, on average. The "
        "program gives its policy no other messages; its log holds all inputs of the policy, and "
        "`lpac replay` reproduces the decisions from these alone.",
        Agreement.OPEN if mean > _NEARLY_ALL * others else Agreement.AGREES,
    )


def _e1(e1: Json) -> list[Claim]:
    worlds = e1["flights"]
    flown = [flights.get(WHOLE_ROBOTS, flights["lpac"]) for flights in worlds.values()]
    settled_s = [_settled_s(flight) for flight in flown]
    ends_s = [flight["time_s"][-1] for flight in flown]
    is_whole = all(WHOLE_ROBOTS in flights for flights in worlds.values())
    beside = ("lpac", "clairvoyant-cvt") if is_whole else ("clairvoyant-cvt",)
    finals = ", ".join(
        f"{flight['final']:.3f} ({_finals(flights[name] for name in beside)})"
        for flight, flights in zip(flown, worlds.values(), strict=True)
    )
    others = "points' and clairvoyant Lloyd's" if is_whole else "clairvoyant Lloyd's"
    times = ", ".join(f"{time_s:.0f} s" for time_s in settled_s)
    early = sum(s <= 0.75 * end_s for s, end_s in zip(settled_s, ends_s, strict=True))
    return [
        Claim(
            "E1: transfers to unseen worlds",
            "In three worlds that it was not trained on, from the same starts, the robots have "
            "typically converged within 60 s. No costs are given.",
            f"In most worlds the cost stays within {100 * _SETTLED:.0f} % of that at 60 s from "
            "three quarters of the time on.",
            f"Cost at 60 s over that at the start, with {others} in brackets: {finals}. "
            f"It had settled after {times}.",
            _agrees(2 * early > len(worlds)),
        )
    ]


def _finals(flights: Iterable[Json]) -> str:
    return ", ".join(f"{flight['final']:.3f}" for flight in flights)


def _settled_s(flight: Json) -> float:
    cost = np.array(flight["normalized_cost"])
    off = np.flatnonzero(np.abs(cost / cost[-1] - 1.0) > _SETTLED)
    return float(flight["time_s"][off[-1] + 1]) if len(off) else 0.0


def _e2(e2: Json) -> list[Claim]:
    spread = e2["spread"]
    mean, final = spread["final_mean"], spread["final_deviation"]
    ends = np.array(list(e2["mission_final"].values()))
    began_s = max(e2["mission_from_s"].values())
    later = (
        ""
        if began_s <= 0.0
        else f" Our robots take off one after another, so that missions began up to {began_s:.0f} "
        f"s after the takeoff command; at their ends the cost over that at their starts is "
        f"{ends.mean():.3f} on average, standard deviation {ends.std(ddof=1):.3f}."
    )
    return [
        Claim(
            "E2: repeatable under GPS errors",
            "Three trials in one world, with robots placed within 10 cm: the curves differ, the "
            "costs at the end are similar, and GPS scatters the robots' starts and ends.",
            f"{e2['looked_at_s']:g} s after the takeoff command, as in the paper's figure, or of "
            "the mission where there is no takeoff, the costs' standard deviation is at most a "
            "fifth of their mean.",
            f"{len(e2['trials'])} trials: {mean:.3f} after {spread['end_s']:.0f} s, standard "
            f"deviation {final:.3f}, {100.0 * final / mean:.0f} % of it, and before that up to "
            f"{spread['largest_deviation_in_flight']:.3f}. On average a robot ends "
            f"{spread['mean_scatter_of_ends_m']:.1f} m from the mean of its end positions.{later}",
            _agrees(final <= _SIMILAR * mean),
        )
    ]


def _e3(e3: Json) -> list[Claim]:
    away = [phase for phase in e3["phases"] if phase["away"]]
    back = [phase for phase in e3["phases"] if not phase["away"]]
    before = [phase["cost_before"] for phase in away]
    worst = max(p["cost_worst"] / b for p, b in zip(away, before, strict=True))
    remains = max(p["cost_end"] / b for p, b in zip(back, before, strict=True))
    settled_s = max(phase["settled_s"] for phase in away)
    return [
        Claim(
            "E3: robust to a robot's removal",
            "A pilot takes a robot away in steady state and brings it back; the others make up for "
            "it. No figure is given.",
            f"While the robot is away the cost is at most {_AWAY:g} times that before, and once it "
            f"is back {_BACK:g} times.",
            f"{counted(len(away), 'robot')} taken: at worst {worst:.2f} times the cost before, "
            f"settled after {settled_s:.0f} s at most; {remains:.2f} times at most once it is "
            "back.",
            _agrees(worst <= _AWAY and remains <= _BACK),
        )
    ]


def _transfer(transfer: Json) -> list[Claim]:
    over = {
        condition["name"]: condition["results"][0]["over_clairvoyant"]["ratio_of_means"][0]
        for condition in transfer["conditions"]
    }
    ratios = "; ".join(f"{name}: {ratio:.2f}" for name, ratio in over.items())
    return [
        Claim(
            "Transfers to other numbers of robots",
            "Trained with 32 robots in 1024 x 1024 cells, the policy is flown with 10 in "
            "512 x 512; its other paper has it with more and fewer robots, features and ranges.",
            f"One policy comes to at most {_TRANSFERS:g} times clairvoyant Lloyd's cost in all.",
            f"Mean cost at the end over clairvoyant Lloyd's, {transfer['worlds']} worlds each. "
            f"{ratios}.",
            _agrees(max(over.values()) <= _TRANSFERS),
        )
    ]


def _asynchrony(data: Json) -> list[Claim]:
    by_timing = {
        Timing(*(of[name] for name in Timing._fields)): [Interval95(*r) for r in of["over_field"]]
        for of in data["timings"]
    }

    def ends(timings: Sequence[Timing]) -> str:
        return ", ".join(
            f"{t.policy_hz:g} Hz x {by_timing[t][-1][0]:.2f} "
            f"({by_timing[t][-1][1]:.2f} to {by_timing[t][-1][2]:.2f})"
            for t in timings
        )

    same = [t for t in by_timing if t.perception_hz == FIELD_TIMING.perception_hz]
    own = [t for t in same if not t.synchronous and t.delay_s == 0.0]
    slower = [t for t in own if t.policy_hz < FIELD_TIMING.policy_hz]
    faster = [t for t in own if t.policy_hz > FIELD_TIMING.perception_hz]
    together = FIELD_TIMING._replace(synchronous=True)
    end_s = data["times_s"][-1]
    count = f"{data['worlds']} worlds, cost at {end_s:g} s over that with the field's rates"
    in_step = by_timing[together][-1]
    verdict = Agreement.OPEN
    if in_step.low >= 1.0 / _ASYNCHRONOUS:
        verdict = Agreement.AGREES
    elif in_step.high < 1.0 / _ASYNCHRONOUS:
        verdict = Agreement.DIFFERS
    claims = [
        Claim(
            "Asynchronous modules",
            "Perception, exchange and control each run at their own rate, and no robot waits for "
            "another.",
            "Agrees if the whole 95 % interval of the extra cost of unsynchronised robots lies "
            f"below {100.0 * (_ASYNCHRONOUS - 1.0):.0f} %; differs if all of it lies above.",
            f"{count}. All synchronised: {ends([together])}.",
            verdict,
        )
    ]
    for name, paper, timings in (
        ("An exchange slower than perception",
         "A slower exchange has a longer window in which to hear everybody.", slower),
        ("An exchange faster than perception",
         "A faster exchange lets features travel several hops for each perception.", faster),
    ):  # fmt: skip
        if timings:
            ratios = [by_timing[timing][-1] for timing in timings]
            better = any(ratio.high < 1.0 for ratio in ratios)
            worse = all(ratio.low > 1.0 for ratio in ratios)
            verdict = Agreement.DIFFERS if worse else Agreement.OPEN
            claims.append(
                Claim(
                    name,
                    f"{paper} Neither is measured.",
                    "It agrees if one such rate is better (its 95 % interval below 1), and differs "
                    "if all are worse.",
                    f"{count}. Perception at {FIELD_TIMING.perception_hz:g} Hz, exchange at "
                    f"{ends(timings)}.",
                    Agreement.AGREES if better else verdict,
                )
            )
    return claims


def _network(network: Json) -> list[Claim]:
    where = network["measured_on"]["where"]
    air = (
        "Measured on one machine's loopback, which has no radio: not a result about the air."
        if where == "loopback"
        else "Measured between network namespaces."
    )
    restarts = {s["middleware"]: s for s in network["summaries"] if s["experiment"] == "restarts"}
    by_middleware = ", ".join(
        f"{name} {one['throughput_mbit_s']['mean']:.1f} Mbit/s"
        + (f", {100 * one['delivered']['mean']:.0f} % delivered" if "delivered" in one else "")
        for name, one in restarts.items()
    )
    others = [
        one["throughput_mbit_s"]["mean"]
        for name, one in restarts.items()
        if name not in ("zenoh", "nothing")
    ]
    # Runs of robots that had not met do not count.
    are_compared = bool(others) and "zenoh" in restarts
    doubled = are_compared and (restarts["zenoh"]["throughput_mbit_s"]["mean"] > 1.5 * max(others))
    curves = [s for s in network["summaries"] if s["experiment"] == "robots"]
    zenoh = sorted((s for s in curves if s["middleware"] == "zenoh"), key=lambda s: s["robots"])
    by_robots = ", ".join(f"{s['robots']}: {s['throughput_mbit_s']['mean']:.1f}" for s in zenoh)
    are_several = len(zenoh) > 1
    falls = are_several and (
        zenoh[-1]["throughput_mbit_s"]["mean"] < zenoh[0]["throughput_mbit_s"]["mean"]
    )
    on_loopback = where == "loopback"
    return [
        Claim(
            "Table I: throughput while programs restart",
            "83.3 ± 1.5 Mbit/s with zenoh, 43.2 ± 7.6 without it (ROS 2's default DDS; downlink "
            "82.9 and 42.7): three robots, 60 s, ten repetitions.",
            "With zenoh the stream gets more than 1.5 times what it gets with DDS.",
            f"{by_middleware}. {air}",
            Agreement.OPEN if on_loopback or not are_compared else _agrees(doubled),
        ),
        Claim(
            "Figure: throughput against the number of robots",
            "It falls as robots are switched on, one after another. No table.",
            "With the most robots it is lower than with one.",
            f"Mbit/s by robots that run zenoh: {by_robots}. {air}",
            Agreement.OPEN if on_loopback or not are_several else _agrees(falls),
        ),
    ]


def _team() -> Claim:
    wifi = Wifi()
    by_transport = ", ".join(
        f"{transport} {capacity(transport, wifi, Traffic(robots=1), most_robots=1000)} robots"
        for transport in TRANSPORTS
    )
    return Claim(
        "Size of a team",
        "One access point carried no more than ten robots.",
        "By our model of one Wi-Fi channel, ten take less than 60 % of it.",
        f"At 60 % of a channel of {wifi.data_rate_mbit_s:g} Mbit/s, by the model, which no radio "
        f"was compared with: {by_transport}. The paper's limit may have another cause; it does not "
        "give its robots' data rates.",
        Agreement.OPEN,
    )


def printed_rotation(heading_rad: float) -> np.ndarray:
    """Equation 4 as printed, R_z(3 pi / 2 - theta) R_x(pi): mission to north, east, down."""
    angle = 1.5 * math.pi - heading_rad
    sin, cos = math.sin(angle), math.cos(angle)
    about_z = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    rotation: np.ndarray = about_z @ np.diag([1.0, -1.0, -1.0])
    return rotation


def _rotation() -> Claim:
    parts = []
    for heading_deg in (0, 30, 90):
        north, east, _ = printed_rotation(math.radians(heading_deg)) @ np.array([0.0, 1.0, 0.0])
        azimuth_deg = round(math.degrees(math.atan2(east, north))) % 360
        parts.append(f"towards {azimuth_deg}° if θ is {heading_deg}°")
    return Claim(
        "Equation 4: from the mission's frame to the autopilot's",
        "R_z(3π/2 - θ) R_x(π), θ being the compass heading of the mission's y axis.",
        "The mission's y axis must point along its heading.",
        f"As printed, a robot with a command along y flies {', '.join(parts[:-1])}, and "
        f"{parts[-1]}. Ours is "
        "[[-sin θ, cos θ, 0], [cos θ, sin θ, 0], [0, 0, -1]], by the paper's own convention.",
        Agreement.MISTAKE,
    )


def _density() -> Claim:
    field, trained = FIELD, SET_UPS["paper"]
    densities = [s.robots / s.world_size**2 for s in (trained, field)]
    return Claim(
        "Densities of robots",
        "3.1e-5 robots per cell in training, 3.8e-4 in the field.",
        "Robots divided by cells.",
        f"{trained.robots} / {trained.world_size}² = {densities[0]:.1e}, and {field.robots} / "
        f"{field.world_size}² = {densities[1]:.1e}: the second is a tenth of the printed value.",
        Agreement.MISTAKE,
    )
