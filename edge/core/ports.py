"""The outside world as the robot's steps see it; adapters and the simulator implement these."""

from typing import Protocol

from edge.core import F32, F64


class Sensor(Protocol):
    """Looks at the importance of the ground below the robot."""

    def view(self, position: F64) -> F32 | None:
        """The importance around the robot, or None when there is no fresh reading.

        Called from the perception thread alone.

        (sensor_size, sensor_size), indexed [x, y] along the mission axes, centred as
        `perception.window_corner` says. `position` (2,) is the robot's, in model units: where the
        view will be written into the map; a sensor that physically looks down does not need it.
        """


class PositionSource(Protocol):
    """Knows where the robot is."""

    def position_m(self) -> tuple[float, float, float] | None:
        """The newest position in the mission frame, m, or None when it is not known.

        Called from several threads at once.
        """
