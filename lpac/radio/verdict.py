"""Verdict of a radio check: one sentence, and the problems, worst first."""

import dataclasses
import math
import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

from edge.core.counted import counted
from edge.messages.mission import RobotStatus
from lpac.radio.airtime import Wifi, airtime, capacity
from lpac.radio.checked import Checked, WifiReading
from lpac.radio.pairs import LATE_S, Pair, blame

# A mesh repeats lost messages, so a larger loss is the radio's fault. In multicast it is the
# radio's fault if it exceeds the expected loss of frames by more than chance.
LEAST_DELIVERED = 0.95
_CHANCE_DEVIATIONS = 3.0
# Robots discard late messages; above this share, queues are filling.
MOST_LATE = 0.01
# A check has fifty messages: one lost or late is chance.
_BY_CHANCE = 1
# Share of a channel's time, with gaps, above which delays grow quickly (docs/network.md).
MOST_BUSY = 0.6
# Largest ratio of the radios' counts to the model's that is attributed to this fleet.
_MODEL_ERR = 1.5
# As in `lpac fleet doctor`.
_WEAK_DBM = -75.0
WHAT_RUNS = "`lpac fleet status` shows which programs run; for simulated robots, `lpac sim` does"


class Room(NamedTuple):
    """Number of robots in flight that the channel carries by the model, and the model's inputs.

    `ground_share` is the airtime of the `robots` that sent, with their messages of `ground_bytes`,
    `flight_share` that with `flight_bytes`. `rate_mbit_s` is assumed unless `rate_told`;
    `multicast_rate_mbit_s`, an access point's rate to all, always is. `busy_share` is the radios'
    count, without gaps, for which the model has `model_busy_share`; None if unknown. The shares and
    `carries` are scaled by this ratio, up to the model's error; the excess is `others_share`,
    airtime of other networks with gaps, which reduces `carries`.
    """

    robots: int
    carries: int
    ground_share: float
    flight_share: float
    rate_mbit_s: float
    rate_told: bool
    multicast_rate_mbit_s: float
    ground_bytes: float
    flight_bytes: float
    message_hz: float
    busy_share: float | None
    model_busy_share: float
    others_share: float


class RadioVerdict(NamedTuple):
    """`problems` are sorted, worst first, empty if all is well; `room` is None without senders."""

    sentence: str
    problems: tuple[str, ...]
    room: Room | None


def obstacles(statuses: Mapping[str, RobotStatus]) -> tuple[str, ...]:
    """Reasons why robots, by name, do not yet send as in a mission, with remedies."""

    def those(is_so: Callable[[RobotStatus], bool], text: str) -> Iterator[str]:
        names = [name for name, status in statuses.items() if is_so(status)]
        if names:
            yield f"{', '.join(names)}: {text}"

    def others_than_most(key: str, what: str, fix: str) -> Iterator[str]:
        values = [getattr(status, key) for status in statuses.values()]
        known = [value for value in values if value is not None]
        if known:
            common = statistics.mode(known)
            text = f"another {what} than most, so their messages are ignored: {fix}"
            yield from those(lambda status: getattr(status, key) not in (None, common), text)

    return (
        *those(
            lambda status: status.radio_counts is None,
            "an older program, which does not count messages: `lpac fleet deploy`",
        ),
        *those(
            lambda status: status.origin is None,
            "no mission origin, and so no position to send: first `lpac mission origin`",
        ),
        *those(
            lambda status: status.origin is not None and status.position_m is None,
            "no position: wait for its GPS",
        ),
        *others_than_most("bundle_id", "policy", "`lpac fleet deploy`"),
        *others_than_most("origin", "mission origin", "`lpac mission origin`"),
    )


def verdict(checked: Checked, pairs: Sequence[Pair]) -> RadioVerdict:
    """Judge the `pairs` found in the windows."""
    room = _room(checked)
    found = [
        *_silent(checked),
        *_channel(room),
        *_unheard(checked, pairs),
    ]
    problems = tuple(text for _, text in sorted(found, key=lambda each: -each[0]))
    return RadioVerdict(_sentence(checked, room, problems), problems, room)


def _sentence(checked: Checked, room: Room | None, problems: Sequence[str]) -> str:
    if problems:
        more = len(problems) - 1
        return problems[0] + (f"; and {more} more" if more else "")
    # Without senders, there are problems, and this is not reached.
    assert room is not None
    of_which, beside = "", " beside a bulk stream" if checked.loaded else ""
    if room.robots > len(checked.robots):
        of_which = f", of which {', '.join(checked.robots)} were judged"
    more = room.carries - room.robots
    return (
        f"carries {counted(room.robots, 'robot')}{of_which}{beside}; by the model there is room "
        f"for {f'{more} more' if more else 'no more'}"
    )


def is_good(pair: Pair, expected_loss: float) -> bool:
    """Whether the receiver gets enough of the sender's messages, in time.

    `expected_loss` is the share of messages lost by a good radio.
    """
    missing, expected = pair.sent - pair.received, pair.sent * expected_loss
    chance = _CHANCE_DEVIATIONS * math.sqrt(expected * (1.0 - expected_loss))
    enough = pair.delivered >= LEAST_DELIVERED or missing <= max(_BY_CHANCE, expected + chance)
    return enough and (pair.late <= _BY_CHANCE or pair.late_share <= MOST_LATE)


# Badness, from 0 to 1, and the problem.
_Found = tuple[float, str]


def _silent(checked: Checked) -> Iterator[_Found]:
    for name in checked.robots:
        window = checked.windows.get(name)
        if window is None:
            yield 1.0, f"{name} is not heard here: {WHAT_RUNS}"
        elif window.sent < 1:
            yield 1.0, f"{name} sends nothing to the others: `lpac watch` shows why"


def _channel(room: Room | None) -> Iterator[_Found]:
    if room is None or room.carries >= room.robots:
        return
    left = max(0.0, MOST_BUSY - room.others_share)
    text = (
        f"by the model these {room.robots} robots need {_percent(room.flight_share)} of the "
        f"channel in flight, of which they can use {_percent(left)}: it carries "
        f"{room.carries or 'none'}"
    )
    if room.others_share > 0.0:
        text += f"; other networks take {_percent(room.others_share)}: look for another channel"
    yield 1.0 - room.carries / room.robots, text


def _unheard(checked: Checked, pairs: Sequence[Pair]) -> Iterator[_Found]:
    found = blame(
        {(pair.sender, pair.receiver): is_good(pair, checked.expected_loss) for pair in pairs}
    )

    def weak(name: str) -> str:
        signal_dbm = checked.wifi.get(name, WifiReading()).signal_dbm
        if signal_dbm is None or signal_dbm >= _WEAK_DBM:
            return ""
        return f" (its signal is weak: {signal_dbm:.0f} dBm)"

    def problem(bad: Sequence[Pair], lost: str, late: str, name: str) -> _Found:
        total = _sum(bad)
        if total.sent - total.received >= total.late:
            text = lost.replace("SHARE", _percent(total.delivered))
        else:
            age = "" if total.age_p99_s is None else f", p99 {total.age_p99_s:.1f} s"
            text = f"{late}: {_percent(total.late_share)} at {LATE_S:g} s or older{age}"
        return 1.0 - total.in_time, text + weak(name)

    for name in found.receivers:
        bad = [pair for pair in pairs if pair.receiver == name]
        yield problem(
            bad, f"{name} hears SHARE of the others", f"messages come late to {name}", name
        )
    for name in found.senders:
        bad = [pair for pair in pairs if pair.sender == name]
        yield problem(bad, f"the others hear SHARE of {name}", f"{name}'s messages come late", name)
    for sender, receiver in found.links:
        bad = [pair for pair in pairs if (pair.sender, pair.receiver) == (sender, receiver)]
        late = f"{sender}'s messages come late to {receiver}"
        yield problem(bad, f"{receiver} hears SHARE of {sender}", late, receiver)


def _sum(pairs: Sequence[Pair]) -> Pair:
    ages_s = [pair.age_p99_s for pair in pairs if pair.age_p99_s is not None]
    return pairs[0]._replace(
        sent=sum(pair.sent for pair in pairs),
        received=sum(pair.received for pair in pairs),
        late=sum(pair.late for pair in pairs),
        age_p99_s=max(ages_s, default=None),
    )


def _room(checked: Checked) -> Room | None:
    traffic = checked.traffic
    if traffic is None:
        return None
    rates = [w.rate_mbit_s for w in checked.wifi.values() if w.rate_mbit_s]
    # Slow links take the most time.
    rate_mbit_s = statistics.harmonic_mean(rates) if rates else Wifi().data_rate_mbit_s
    wifi = Wifi(data_rate_mbit_s=rate_mbit_s, ground_wired=checked.ground_wired)
    ground = airtime(checked.transport, wifi, traffic)
    flight_bytes = max(traffic.message_bytes, checked.flight_bytes)
    flight = dataclasses.replace(traffic, message_bytes=flight_bytes)
    # A radio without received frames does not count.
    shares = [w.busy_share for w in checked.wifi.values() if w.busy_share]
    busy = statistics.median(shares) if shares and not checked.loaded else None
    # Radios do not count gaps.
    counted = 1.0 if busy is None else busy / ground.busy
    scale = min(counted, _MODEL_ERR)
    others = min(1.0, (counted - scale) * ground.total)
    most = MOST_BUSY - others
    return Room(
        robots=traffic.robots,
        carries=(capacity(checked.transport, wifi, flight, most=most / scale) if most > 0.0 else 0),
        ground_share=scale * ground.total,
        flight_share=scale * airtime(checked.transport, wifi, flight).total,
        rate_mbit_s=rate_mbit_s,
        rate_told=bool(rates),
        multicast_rate_mbit_s=wifi.multicast_rate_mbit_s,
        ground_bytes=traffic.message_bytes,
        flight_bytes=flight_bytes,
        message_hz=traffic.message_hz,
        busy_share=busy,
        model_busy_share=ground.busy,
        others_share=others,
    )


def _percent(share: float) -> str:
    """Percentage that is 100 % only for 1, and 0 % only for 0."""
    percent = min(99, max(1, math.floor(100.0 * share + 0.5))) if 0.0 < share < 1.0 else 100 * share
    return f"{percent:.0f} %"
