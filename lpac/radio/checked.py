"""Measurements of a check of the radio, and the records that are kept."""

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from lpac.radio.airtime import Traffic, Transport, Wifi, lost_for_good
from lpac.radio.pairs import Pair, Window, pairs
from lpac.radio.records import RadioRecord


class WifiReading(NamedTuple):
    """Readings of a robot's radio; None where it told none.

    At which rate it sends, how strong it hears, and the share of the channel's time in which it
    heard anybody send.
    """

    rate_mbit_s: float | None = None
    signal_dbm: float | None = None
    busy_share: float | None = None


class Checked(NamedTuple):
    """`robots` are the names of those that are judged, `windows` of all that were heard.

    Of the fleet: what others of it say is on the air, too. `wifi` is of those whose radios were
    asked. Each message travels in an envelope of `overhead_bytes`. In flight it has `flight_bytes`,
    sealed, if that is more: robots on the ground have no map to tell of. `loaded`: something else
    was sent meanwhile, on purpose. `ground_wired`: the ground's computer is not in the Wi-Fi
    itself.
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
        """Mean traffic, sealed, of those that spoke; None if nobody did."""
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
        """Of a message, by a radio that is as docs/network.md assumes."""
        traffic = self.traffic
        if traffic is None:
            return 0.0
        return lost_for_good(self.transport, Wifi(), traffic.message_bytes)

    def pairs(self) -> tuple[Pair, ...]:
        """Of those that are judged."""
        return pairs({name: self.windows[name] for name in self.robots if name in self.windows})

    def records(self, found: Sequence[Pair]) -> list[RadioRecord]:
        """One of each pair that was found in the windows, for a model of this field's radio."""
        return [self._record(pair) for pair in found]

    def _record(self, pair: Pair) -> RadioRecord:
        said, heard = self.windows[pair.sender], self.windows[pair.receiver]
        place_m, other_m = said.last.position_m, heard.last.position_m
        heading_rad = said.last.heading_rad
        wifi = self.wifi.get(pair.receiver, WifiReading())
        traffic = self.traffic
        assert traffic is not None
        return RadioRecord(
            sender=pair.sender,
            receiver=pair.receiver,
            transport=self.transport,
            robots=traffic.robots,
            message_bytes=said.bytes_sent / said.sent + self.overhead_bytes,
            message_hz=said.rate_hz,
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
