"""The outside world as the robot sees it; drivers and the simulator implement these."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import NamedTuple, Protocol, runtime_checkable

from edge.core import F32, F64, Bools
from edge.core.perception import PerceptionParameters
from edge.core.vehicle import Action, Setpoint, VehicleState


class Clock(Protocol):
    """Return the time. Called from any thread."""

    def monotonic_s(self) -> float:
        """Time that never jumps, s; by it all ages are told."""

    def unix_s(self) -> float:
        """The wall clock, s; it may be wrong, and may be set."""


class Sensor(Protocol):
    """Looks at the importance of the ground below the robot, and sees all that the policy asks for.

    A sensor that sees less, or another part from another height, is a `Camera`.
    """

    def view(self, position: F64) -> F32 | None:
        """The importance around the robot, or None when there is no fresh reading.

        Called from the perception thread alone.

        (sensor_size, sensor_size), indexed [x, y] along the mission axes, centred as
        `perception.window_corner` says. `position` (2,) is the robot's, in model units: where the
        view will be written into the map; a sensor that physically looks down does not need it.
        """


class Look(NamedTuple):
    """A camera's view: both (sensor_size, sensor_size), indexed and centred as `Sensor.view` is.

    `importance` is finite, also where `seen` is False; there it is not used.
    """

    importance: F32
    seen: Bools


@runtime_checkable
class Camera(Protocol):
    """Looks at the ground from the robot's height, and says which part of it it saw."""

    def look(self, position: F64, height: float) -> Look | None:
        """Return the newest view, or None when there is no fresh reading.

        Called from the perception thread alone.

        `position` (2,) is the robot's, and `height` above its own takeoff point, both in model
        units. A look that saw nothing, as from the ground, is one all the same; without any the
        robot would not be ready to take off.
        """


# Makes a sensor. It is called with the text of a world file and the name by which a ValueError
# should call that file if it cannot be used. A sensor that looks at the real world needs neither.
SensorOver = Callable[[str, str], Sensor | Camera]


class SensorSetting(NamedTuple):
    """Requirements of a sensor: views of `perception.sensor_size`, as the policy was trained.

    `idf_truncation` (standard deviations) and `idf_norm` (the importance of the most important
    cell) are those of a world that is computed. `options` are what robot.toml says of the sensor.
    """

    perception: PerceptionParameters
    idf_truncation: float
    idf_norm: float
    options: Mapping[str, object]


class SensorDriver(Protocol):
    """A type of sensor. What it opens is closed when the robot's program ends."""

    def __call__(self, setting: SensorSetting) -> AbstractContextManager[SensorOver]:
        """Entering it gives a `SensorOver`, a callable that makes the sensor.

        It is called with the text of a world file and the name by which a ValueError should call
        that file if it cannot be used. A sensor that looks at the real world needs neither. A
        sensor is told where the robot is, and nothing of its heading, its speed or which robot it
        is.

        Raises ValueError or OSError, one line, for a sensor that cannot be used.
        """


class Odometry(NamedTuple):
    """Where the robot is and how it moves: the mission frame, m and m/s."""

    position_m: tuple[float, float, float]
    velocity_m_s: tuple[float, float, float]


class OdometrySource(Protocol):
    """Knows where the robot is."""

    def odometry(self) -> Odometry | None:
        """The newest estimate, or None when it is not known.

        Called from several threads at once.
        """


class Vehicle(Protocol):
    """The vehicle. No method waits for it, and none raises."""

    def state(self) -> VehicleState:
        """The newest of everything. Called from any thread."""

    def send(self, setpoint: Setpoint) -> Setpoint | None:
        """Send it, a `Velocity` or a `Position`, once; what was really sent, None if nothing was.

        Nothing sends it again: when the calls stop, the autopilot's own failsafe sees the silence.
        Called from the control thread alone.
        """

    def command(self, action: Action) -> None:
        """Ask for `action`; the outcome comes as `VehicleState.result`. Called from any thread.

        Commands are carried out one after another; KILL goes before all others.
        """


class VehicleSetup(Protocol):
    """Vehicle setup for a flight. Each method waits for the vehicle, and may raise OSError.

    Called from one thread alone, preflight's, every two seconds: on the ground, where what is wrong
    is set, and in flight, where somebody else may change it.
    """

    def read_parameters(self, names: Sequence[str]) -> dict[str, int | float | None]:
        """PX4's parameters, of which `lpac robot check` says what they must be.

        None for one that PX4 does not have, which is refused: a vehicle that is no PX4 answers 0 at
        first, keeps what is set, and has to do what the parameters promise.
        """

    def set_parameter(self, name: str, value: int | float) -> None:
        """Set one."""

    def upload_fence(self, vertices_deg: Sequence[tuple[float, float]]) -> None:
        """Replace PX4's fence by one polygon to stay in: latitude and longitude."""

    def has_fence(self) -> bool:
        """Whether the vehicle still has the fence that was uploaded last; False if none was."""


class Watchdog(Protocol):
    """Holds the vehicle when the control loop hangs."""

    def feed(self, *, flying: bool) -> None:
        """The control loop lives, and flies the vehicle or not. The control thread's."""

    def alive(self) -> bool:
        """Whether it watches. Called from any thread."""


class Recorder(Protocol):
    """The flight log."""

    def record(self, topic: str, unix_time_s: float, message: Mapping[str, object]) -> None:
        """Keep one message: plain values, bytes and numpy arrays. Never waits; any thread."""

    @property
    def recording(self) -> bool:
        """Whether what is recorded is kept. Any thread."""


class VehicleSetting(NamedTuple):
    """The vehicle's settings in robot.toml."""

    url: str
    system_id: int
    options: Mapping[str, object]


class OpenVehicle(NamedTuple):
    """A vehicle that is there, or that is waited for.

    `watchdog` makes one that holds the vehicle so many s after the control loop fell silent, and
    lands it so many s later.
    """

    vehicle: Vehicle
    setup: VehicleSetup
    watchdog: Callable[[float, float], AbstractContextManager[Watchdog]]


class VehicleDriver(Protocol):
    """A type of vehicle. It is closed when the robot's program ends."""

    def __call__(self, setting: VehicleSetting) -> AbstractContextManager[OpenVehicle]:
        """Raises ValueError or OSError, one line, also if another program of this machine has it.

        A vehicle that is not there yet is no error.
        """
