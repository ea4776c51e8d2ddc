"""What is told of a simulated flight."""

import numpy as np

from lpac.sim.fleet.flight import least_separation
from lpac.sim.fleet.vehicles import TrueTrack


def test_the_least_separation_is_told_of_tracks_of_any_times() -> None:
    # The last of these times, by steps from the first, would be 2e-12 s behind it.
    time_s = np.array([405.29, 409.97])

    def track(east_m: float) -> TrueTrack:
        position_m = np.array([[0.0, east_m, -5.0], [1.0, east_m, -5.0]])
        return TrueTrack(time_s, position_m, np.array([True, True]))

    separation = least_separation([track(0.0), track(3.0)])
    assert separation is not None
    assert abs(separation.distance_m - 3.0) < 1e-9
