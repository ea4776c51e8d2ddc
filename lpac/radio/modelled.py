"""The radio that simulated robots fly with: what the model says of a team on one channel."""

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
    """How a team's messages travel: all of it shares one channel and reaches its access point.

    So whoever flies takes airtime, from the first to the last second, wherever it is: a field of
    300 robots, ten in 32 x 32 m, is 175 m wide. Who has use for a message is another matter.

    Raises ValueError for another transport.
    """

    transport: Transport
    wifi: Wifi = field(default_factory=Wifi)

    def link(
        self, robots: int, payload: PayloadType, message_hz: float = MESSAGE.rate_hz
    ) -> LinkQuality:
        """From one robot to another, in a team of so many that say what the field policy does."""
        traffic = Traffic(
            robots=robots, message_bytes=MESSAGE_BYTES[payload], message_hz=message_hz
        )
        return link_quality(self.transport, self.wifi, traffic)
