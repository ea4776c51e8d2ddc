"""The simulated robots' radio: the model of a team on one channel."""

from dataclasses import dataclass, field

from edge.core.schema import Bounded
from edge.core.wire import PayloadType
from edge.messages.topics import MESSAGE
from lpac.radio.airtime import (
    MESSAGE_BYTES,
    LinkQuality,
    Traffic,
    Transport,
    Wifi,
    link_quality,
)


@dataclass(frozen=True, slots=True)
class ModelledRadio(Bounded):
    """A team's radio: all robots share one channel, and reach its access point.

    Each robot takes airtime during the whole flight, wherever it is: 300 robots, at ten in
    32 x 32 m, cover a field 175 m wide.

    Raises ValueError for another transport.
    """

    transport: Transport
    wifi: Wifi = field(default_factory=Wifi)

    def link(
        self, robots: int, payload: PayloadType, message_hz: float = MESSAGE.rate_hz
    ) -> LinkQuality:
        """Quality of a link in a team of `robots` with the field policy's messages."""
        traffic = Traffic(
            robots=robots, message_bytes=MESSAGE_BYTES[payload], message_hz=message_hz
        )
        return link_quality(self.transport, self.wifi, traffic)
