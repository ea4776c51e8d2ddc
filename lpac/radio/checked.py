"""Measurements of a radio check, and records of them."""

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from lpac.radio.airtime import Traffic, Transport, Wifi, noise_loss
from lpac.radio.pairs import Pair, Window, pairs
from lpac.radio.records import RadioRecord


class WifiReading(NamedTuple):
    """A robot's radio: its send rate, its received signal, and the channel's busy share.

    None where the radio reports no value.
    """

    rate_mbit_s: float | None = None
    signal_dbm: float | None = None
    busy_share: float | None = None


class Checked(NamedTuple):
    """Measurements of the judged `robots`.

    `windows` are of all robots of the fleet that were heard, since they all take airtime. `wifi`
    has the radios that were read. Each message has an envelope of `overhead_bytes`. Sealed messages
    in flight have at least `flight_bytes`, since robots on the ground have no map to send.
    `loaded`: a bulk stream was sent meanwhile. `ground_wired`: the ground's computer is not on the
    Wi-Fi.
    """

    robots: tuple[str, ...]
    windows: Mapping[str, Window]
    wifi: Mapping[str, WifiReading]
    transport: Transport
    overhead_bytes: int = 0
    flight_bytes: float = 0.0
    loaded: bool = False
    ground_wired: bool = True

    @property
    def traffic(self) -> Traffic | None:
        """Mean traffic of the robots that sent, sealed; None if none did."""
        speaking = [window for window in self.windows.values() if window.sent > 0]
        if not speaking:
            return None
        sent = sum(window.sent for window in speaking)
        return Traffic(
            robots=len(speaking),
            message_bytes=sum(w.bytes_sent for w in speaking) / sent + self.overhead_bytes,
            message_hz=statistics.mean(window.rate_hz for window in speaking),
        )

    @property
    def expected_loss(self) -> float:
        """Share of messages that the radio of docs/network.md loses."""
        traffic = self.traffic
        if traffic is None:
            return 0.0
        return noise_loss(self.transport, Wifi(), traffic.message_bytes)

    def pairs(self) -> tuple[Pair, ...]:
        """Pairs of the judged robots."""
        return pairs({name: self.windows[name] for name in self.robots if name in self.windows})

    def records(self, found: Sequence[Pair]) -> list[RadioRecord]:
        """A record per pair, for a model of this field's radio."""
        return [self._record(pair) for pair in found]

    def _record(self, pair: Pair) -> RadioRecord:
        sender, receiver = self.windows[pair.sender], self.windows[pair.receiver]
        place_m, other_m = sender.last.position_m, receiver.last.position_m
        heading_rad = sender.last.heading_rad
        wifi = self.wifi.get(pair.receiver, WifiReading())
        traffic = self.traffic
        assert traffic is not None
        return RadioRecord(
            sender=pair.sender,
            receiver=pair.receiver,
            transport=self.transport,
            robots=traffic.robots,
            message_bytes=sender.bytes_sent / sender.sent + self.overhead_bytes,
            message_hz=sender.rate_hz,
            sent=pair.sent,
            received=pair.received,
            age_p50_s=pair.age_p50_s,
            age_p99_s=pair.age_p99_s,
            distance_m=None if place_m is None or other_m is None else math.dist(place_m, other_m),
            sender_heading_deg=None if heading_rad is None else math.degrees(heading_rad) % 360.0,
            receiver_height_m=None if other_m is None else other_m[2],
            rate_mbit_s=wifi.rate_mbit_s,
            signal_dbm=wifi.signal_dbm,
            busy_share=wifi.busy_share,
            loaded=self.loaded,
            ground_wired=self.ground_wired,
        )
