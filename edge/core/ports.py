"""Interfaces to the outside world, implemented by drivers and simulators."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import NamedTuple, Protocol, runtime_checkable

from edge.core import F32, F64, Bools
from edge.core.perception import PerceptionParameters
from edge.core.vehicle import Action, Setpoint, VehicleState


class Clock(Protocol):
    """Source of time, thread-safe."""

    def monotonic_s(self) -> float:
        """Time that never jumps, s, for all ages."""

    def unix_s(self) -> float:
        """Wall clock, s, which may be wrong or be set."""


class Sensor(Protocol):
    """Sees the importance of the ground in the policy's whole sensor area.

    A sensor that sees less, or depends on the height, is a `Camera`.
    """

    def view(self, position: F64) -> F32 | None:
        """The importance around the robot, or None without a fresh reading.

        Called from the perception thread only. The result is (sensor_size, sensor_size), indexed
        [x, y] along the mission axes, centred as in `perception.window_corner`. `position` (2,) is
        the robot's, in model units, where the view goes into the map; a sensor that physically
        looks down does not need it.
        """


class Look(NamedTuple):
    """A camera's view: both (sensor_size, sensor_size), indexed and centred like `Sensor.view`.

    `importance` must be finite also where `seen` is False, where it is ignored.
    """

    importance: F32
    seen: Bools


@runtime_checkable
class Camera(Protocol):
    """Sees the ground from the robot's height, and reports which part it saw."""

    def look(self, position: F64, height: float) -> Look | None:
        """The newest view, or None without a fresh reading.

        Called from the perception thread only. `position` (2,) is the robot's, `height` is above
        its own takeoff point, both in model units. Return a look even if nothing was seen, for
        example on the ground: without any, the robot is not ready to take off.
        """


# See `SensorDriver`.
SensorOver = Callable[[str, str], Sensor | Camera]


class SensorSetting(NamedTuple):
    """Settings of a sensor: its views are of `perception.sensor_size`, as in training.

    `idf_truncation` (standard deviations) and `idf_norm` (the largest importance) are those of a
    computed world. `options` are the sensor's in robot.toml.
    """

    perception: PerceptionParameters
    idf_truncation: float
    idf_norm: float
    options: Mapping[str, object]


class SensorDriver(Protocol):
    """Type of sensor. Its context is closed when the robot's program ends."""

    def __call__(self, setting: SensorSetting) -> AbstractContextManager[SensorOver]:
        """Open a `SensorOver`, which makes the sensor.

        It is called with the text of a world file, and the file's name for a ValueError. A sensor
        of the real world needs neither. Sensors know the robot's position, not its heading, speed
        or id.

        Raises ValueError or OSError, one line, for a sensor that cannot be used.
        """


class Odometry(NamedTuple):
    """The robot's position and velocity in the mission frame, m and m/s."""

    position_m: tuple[float, float, float]
    velocity_m_s: tuple[float, float, float]


class OdometrySource(Protocol):
    """Source of the robot's position."""

    def odometry(self) -> Odometry | None:
        """The newest estimate, or None if unknown. Thread-safe."""


class Vehicle(Protocol):
    """The vehicle. No method waits or raises."""

    def state(self) -> VehicleState:
        """The newest state. Thread-safe."""

    def send(self, setpoint: Setpoint) -> Setpoint | None:
        """Send a `Velocity` or a `Position` once; returns the setpoint as sent, None if none was.

        Setpoints are not repeated: when the calls stop, the autopilot's own failsafe acts. Called
        from the control thread only.
        """

    def command(self, action: Action) -> None:
        """Request `action`; its outcome is `VehicleState.result`. Thread-safe.

        Commands are executed in order, except KILL, which goes first.
        """


class VehicleSetup(Protocol):
    """Vehicle setup for a flight. Methods wait for the vehicle, and may raise OSError.

    Called from the preflight thread only, every two seconds: on the ground to correct settings, and
    in flight, since others may change them.
    """

    def read_parameters(self, names: Sequence[str]) -> dict[str, int | float | None]:
        """Read PX4's parameters, those that `lpac robot check` lists.

        None for a parameter unknown to PX4, which is refused. A vehicle without PX4 answers 0 for
        a parameter until it is set, then the set value, and must behave as the parameters promise.
        """

    def set_parameter(self, name: str, value: int | float) -> None:
        """Set one parameter."""

    def upload_fence(self, vertices_deg: Sequence[tuple[float, float]]) -> None:
        """Replace PX4's fence by one inclusion polygon: latitude and longitude."""

    def has_fence(self) -> bool:
        """Whether the vehicle still has the last uploaded fence; False if there was none."""


class Watchdog(Protocol):
    """Makes the vehicle hold if the control loop hangs."""

    def feed(self, *, flying: bool) -> None:
        """Report that the control loop runs, and whether it flies. Control thread only."""

    def alive(self) -> bool:
        """Whether the watchdog works. Thread-safe."""


class Recorder(Protocol):
    """The flight log, thread-safe."""

    def record(self, topic: str, unix_time_s: float, message: Mapping[str, object]) -> None:
        """Store one message of plain values, bytes and numpy arrays. Never waits."""

    @property
    def recording(self) -> bool:
        """Whether messages are stored."""


class VehicleSetting(NamedTuple):
    """The vehicle's settings in robot.toml."""

    url: str
    system_id: int
    options: Mapping[str, object]


class OpenVehicle(NamedTuple):
    """A vehicle, connected or not.

    `watchdog(hold_after_s, land_after_s)` opens a watchdog: the vehicle holds once the control loop
    has been silent for `hold_after_s`, and lands after a silence of `land_after_s`, if it holds.
    """

    vehicle: Vehicle
    setup: VehicleSetup
    watchdog: Callable[[float, float], AbstractContextManager[Watchdog]]


class VehicleDriver(Protocol):
    """Type of vehicle. Its context is closed when the robot's program ends."""

    def __call__(self, setting: VehicleSetting) -> AbstractContextManager[OpenVehicle]:
        """Open the vehicle, which need not be connected yet.

        Raises ValueError or OSError, one line, also if another program on this machine uses it.
        """
