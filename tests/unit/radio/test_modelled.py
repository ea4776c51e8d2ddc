"""The radio that simulated robots fly with."""

from typing import Any

import pytest

from lpac.radio.airtime import TRANSPORTS, Wifi
from lpac.radio.modelled import ModelledRadio


def test_a_mesh_of_a_hundred_loses_and_delays_what_multicast_does_not() -> None:
    wifi = Wifi(multicast_rate_mbit_s=24.0)
    mesh = ModelledRadio("mesh", wifi).link(100, "int8")
    multicast = ModelledRadio("multicast", wifi).link(100, "int8")
    assert mesh.loss > 0.8 and mesh.delay_s > 0.3
    assert multicast.loss < 0.2 and multicast.delay_s < 0.01
    assert ModelledRadio("mesh", wifi).link(10, "int8").loss == 0.0


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_more_robots_bytes_or_messages_are_later(transport: Any) -> None:
    radio = ModelledRadio(transport)
    ten = radio.link(10, "float16").delay_s
    assert radio.link(10, "int8").delay_s < ten < radio.link(20, "float16").delay_s
    assert ten < radio.link(10, "float16", 5.0).delay_s


def test_another_transport_is_named() -> None:
    unknown: Any = "pigeon"
    with pytest.raises(ValueError, match="transport = 'pigeon': allowed are 'mesh', 'mult"):
        ModelledRadio(unknown)
