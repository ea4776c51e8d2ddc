"""Convert the ground's log to Foxglove's own messages.

Pure. The input is what `lpac.ground.record` writes, live or from a file, so that a flight looks the
same in both. The output:

| topic | schema | when |
| --- | --- | --- |
| `/tf` | `foxglove.FrameTransforms`: `mission` -> the robot's name | with each status |
| `/robots` | `foxglove.SceneUpdate`: a robot's place, nose, name and state | with each status |
| `/robot/<name>` | `lpac.Status`, as in the robot's own log | with each status |
| `/cells` | `foxglove.SceneUpdate`: Voronoi cells of the robots of the cost | with each cost |
| `/cost` | `lpac.Cost` | with each cost |
| `/log` | `foxglove.Log`: commands and their results | as they happen |
| `/fleet` | `lpac.Fleet`: a row for each robot, in the fleet's order | at 2 Hz |
| `/fence` | `foxglove.SceneUpdate` | at 1 Hz |
| `/density` | `foxglove.Grid`, field `importance`: 0 to 255, the world's highest | at 1 Hz |
| `/seen` | `foxglove.Grid`, field `robots`: how many have seen the cell | at 1 Hz |

All in the frame `mission`: x right, y forward, z up, m.
"""

import base64
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeVar

import msgspec
import numpy as np
import numpy.typing as npt
from foxglove.messages import (
    ArrowPrimitive,
    Color,
    Duration,
    FrameTransform,
    FrameTransforms,
    Grid,
    LinePrimitive,
    LinePrimitiveLineType,
    Log,
    LogLevel,
    PackedElementField,
    PackedElementFieldNumericType,
    Point3,
    Pose,
    Quaternion,
    SceneEntity,
    SceneUpdate,
    SpherePrimitive,
    TextPrimitive,
    Timestamp,
    Vector2,
    Vector3,
)

from edge.core.memory import EXPLORED_CELLS
from edge.messages.mission import FlightState, GroundState, RobotStatus, explored_from_bytes
from lpac.analysis.coverage import Coverage
from lpac.analysis.snapshot import (
    FRESH_S,
    NO_STATE,
    Explored,
    FleetSetup,
    FleetSnapshot,
    GroundEvent,
    RobotSnapshot,
)
from lpac.ground.alarms import alarms
from lpac.ground.cost import Cost
from lpac.ground.rendering import Row, cell, nose_rad, problem, rows, speed_m_s, state_word

FRAME = "mission"
FLEET_PERIOD_S = 0.5
# A new client gets no earlier messages, so static ones are repeated.
STILL_PERIOD_S = 1.0
_DENSITY_CELLS = 128
# Each slightly above the one before.
_DENSITY_Z_M, _SEEN_Z_M, _LINES_Z_M = -0.06, -0.03, 0.0
_ROBOT_M = 0.5
_GREY, _BLUE, _YELLOW, _VIOLET, _ORANGE, _RED, _WHITE = (
    Color(r=r, g=g, b=b, a=1.0)
    for r, g, b in (
        (0.6, 0.6, 0.6), (0.2, 0.6, 1.0), (0.95, 0.8, 0.2), (0.7, 0.5, 0.95), (1.0, 0.55, 0.1),
        (0.9, 0.15, 0.15), (0.95, 0.95, 0.95),
    )
)  # fmt: skip
_COLORS = {
    FlightState.MISSION: _BLUE,
    FlightState.HOLD: _YELLOW,
    FlightState.TAKEOFF: _VIOLET,
    FlightState.RETURN: _VIOLET,
    FlightState.LAND: _VIOLET,
    FlightState.PILOT: _ORANGE,
    FlightState.FAULT: _RED,
}

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class ShownRobot:
    """A robot's row; of a robot that was never heard, only the name is known.

    `state`, `problem` and `severity` are as in all views, `heard_s_ago` is the age of its newest
    status, s, `neighbours` their number; the others are as in `RobotStatus`.
    """

    name: str
    state: str
    problem: str
    severity: str
    heard_s_ago: float | None = None
    armed: bool | None = None
    mode: str | None = None
    battery: float | None = None
    satellites: int | None = None
    height_m: float | None = None
    speed_m_s: float | None = None
    neighbours: int | None = None


@dataclass(frozen=True, slots=True)
class ShownFleet:
    """The fleet; `seen_share` is the share of the world that any robot has seen, 0 to 1."""

    trial: str
    safety_action: str
    seen_share: float
    robots: tuple[ShownRobot, ...]


class Shown(NamedTuple):
    """A message of a topic: one of Foxglove's, or a dataclass to be sent as JSON."""

    topic: str
    unix_time_s: float
    message: Any


class FoxgloveView:
    """Converts a ground's log, message by message, for Foxglove."""

    def __init__(self) -> None:
        self._setup: FleetSetup | None = None
        self._coverage: Coverage | None = None
        self._state = NO_STATE
        # By name: when it was received, Unix time, and the status.
        self._statuses: dict[str, tuple[float, RobotStatus]] = {}
        self._explored: dict[str, npt.NDArray[np.bool_]] = {}
        self._fleet_at_s = self._still_at_s = -math.inf

    def take(self, topic: str, unix_time_s: float, logged: Mapping[str, object]) -> Iterator[Shown]:
        """Convert a message of the log. Raises ValueError if it is not valid."""
        match topic:
            case "setup":
                self._take_setup(_logged(FleetSetup, logged))
            case "state":
                self._state = _logged(GroundState, logged)
            case "explored":
                explored = _logged(Explored, logged)
                cells = explored_from_bytes(base64.b64decode(explored.cells))
                self._explored[explored.robot] = cells
            case "status":
                status = _logged(RobotStatus, logged)
                yield from self._take_status(str(logged["name"]), status, unix_time_s)
            case "cost":
                cost = _logged(Cost, logged)
                yield Shown("/cost", unix_time_s, cost)
                if self._coverage is not None:
                    yield Shown("/cells", unix_time_s, self._cells(cost.robots, unix_time_s))
            case "event":
                event = _logged(GroundEvent, logged)
                yield Shown("/log", unix_time_s, _event(event))

    def tick(self, unix_now_s: float) -> Iterator[Shown]:
        """Messages that are due periodically."""
        if self._setup is None:
            return
        # abs: the clock may be set back.
        if abs(unix_now_s - self._fleet_at_s) >= FLEET_PERIOD_S:
            self._fleet_at_s = unix_now_s
            yield Shown("/fleet", unix_now_s, self._fleet(self._setup, unix_now_s))
        if abs(unix_now_s - self._still_at_s) >= STILL_PERIOD_S:
            self._still_at_s = unix_now_s
            yield Shown("/fence", unix_now_s, self._fence(self._setup, unix_now_s))
            if self._coverage is not None:
                density = self._coverage.density(_DENSITY_CELLS)
                yield self._grid("/density", "importance", density, _DENSITY_Z_M, unix_now_s)
            yield self._grid("/seen", "robots", self._seen(), _SEEN_Z_M, unix_now_s)

    def _take_setup(self, setup: FleetSetup) -> None:
        if self._setup is None or self._setup.world != setup.world:
            self._coverage = Coverage.known(setup)
        self._setup = setup

    def _take_status(self, name: str, status: RobotStatus, unix_time_s: float) -> Iterator[Shown]:
        self._statuses[name] = unix_time_s, status
        yield Shown(f"/robot/{name}", unix_time_s, status)
        if status.position_m is None:
            return
        pose, at = _pose(status), Timestamp.from_epoch_secs(unix_time_s)
        transform = FrameTransform(
            timestamp=at, parent_frame_id=FRAME, child_frame_id=name,
            translation=Vector3(**_xyz(status.position_m)), rotation=_turned(_yaw_rad(status)),
        )  # fmt: skip
        yield Shown("/tf", unix_time_s, FrameTransforms(transforms=[transform]))
        color = _COLORS.get(status.state, _GREY)
        x_m, y_m, z_m = status.position_m
        label = Pose(
            position=Vector3(x=x_m, y=y_m, z=z_m + 2.0 * _ROBOT_M), orientation=_turned(0.0)
        )
        entity = SceneEntity(
            timestamp=at, frame_id=FRAME, id=name, lifetime=_LIFETIME,
            spheres=[SpherePrimitive(pose=pose, size=_SIZE, color=color)],
            arrows=[
                ArrowPrimitive(
                    pose=pose, shaft_length=2.0 * _ROBOT_M, shaft_diameter=0.2 * _ROBOT_M,
                    head_length=0.6 * _ROBOT_M, head_diameter=0.5 * _ROBOT_M, color=color,
                )
            ],
            texts=[
                TextPrimitive(
                    pose=label, billboard=True, font_size=_ROBOT_M, color=_WHITE,
                    text=f"{name} {state_word(status)}",
                )
            ],
        )  # fmt: skip
        yield Shown("/robots", unix_time_s, SceneUpdate(entities=[entity]))

    def _cells(self, robots: Sequence[str], unix_time_s: float) -> SceneUpdate:
        assert self._coverage is not None
        places_m = {
            name: status.position_m[:2]
            for name, (_, status) in self._statuses.items()
            if name in robots and status.position_m is not None
        }
        cells_m = self._coverage.cells_m(np.array(list(places_m.values())).reshape(-1, 2))
        return SceneUpdate(
            entities=[
                _outline(name, corners_m, _WHITE, unix_time_s)
                for name, corners_m in zip(places_m, cells_m, strict=True)
                if corners_m
            ]
        )

    def _fence(self, setup: FleetSetup, unix_time_s: float) -> SceneUpdate:
        fence = self._state.fence or setup.fence
        return SceneUpdate(entities=[_outline("fence", fence.vertices_m, _RED, unix_time_s)])

    def _fleet(self, setup: FleetSetup, unix_now_s: float) -> ShownFleet:
        return ShownFleet(
            trial=self._state.trial,
            safety_action=self._state.safety_action,
            seen_share=float(np.mean(self._seen() > 0)),
            robots=tuple(map(_shown_row, self._rows(setup, unix_now_s))),
        )

    def _rows(self, setup: FleetSetup, unix_now_s: float) -> list[Row]:
        robots = (
            RobotSnapshot(name, robot_id, status, max(0.0, unix_now_s - received_s))
            if received_s is not None
            else RobotSnapshot(name, robot_id)
            for name, robot_id in setup.robots.items()
            for received_s, status in (self._statuses.get(name, (None, None)),)
        )
        snapshot = FleetSnapshot(unix_now_s, self._state.operator, self._state, tuple(robots))
        return rows(setup, snapshot, alarms(setup, snapshot))

    def _seen(self) -> npt.NDArray[np.uint8]:
        """How many robots have seen each cell: (EXPLORED_CELLS, EXPLORED_CELLS), by [x, y]."""
        seen = np.zeros((EXPLORED_CELLS, EXPLORED_CELLS), np.int64)
        for cells in self._explored.values():
            seen += cells
        return np.minimum(seen, 255).astype(np.uint8)

    def _grid(
        self, topic: str, name: str, values: npt.NDArray[np.uint8], z_m: float, unix_time_s: float
    ) -> Shown:
        """Grid over the whole world; `values` are indexed [x, y]."""
        assert self._setup is not None
        side = len(values)
        cell_m = self._setup.world_size / self._setup.env_scale / side
        grid = Grid(
            timestamp=Timestamp.from_epoch_secs(unix_time_s), frame_id=FRAME,
            pose=Pose(position=Vector3(z=z_m), orientation=_turned(0.0)),
            column_count=side, cell_size=Vector2(x=cell_m, y=cell_m), row_stride=side,
            cell_stride=1,
            fields=[PackedElementField(name=name, type=PackedElementFieldNumericType.Uint8)],
            data=np.ascontiguousarray(values.T).tobytes(),
        )  # fmt: skip
        return Shown(topic, unix_time_s, grid)


# A robot that is no longer heard disappears, with its cell.
_LIFETIME = Duration(sec=int(FRESH_S), nsec=int(FRESH_S % 1.0 * 1e9))
_SIZE = Vector3(x=_ROBOT_M, y=_ROBOT_M, z=_ROBOT_M / 2.0)


def _logged(kind: type[T], logged: Mapping[str, object]) -> T:
    """Decode a logged message; unknown keys, as of another version, are ignored."""
    try:
        return msgspec.convert(logged, kind)
    except msgspec.MsgspecError as error:
        raise ValueError(f"{kind.__name__}: {error}") from None


def _event(event: GroundEvent) -> Log:
    return Log(
        timestamp=Timestamp.from_epoch_secs(event.unix_time_s),
        level=LogLevel.Warning if event.kind == "refusal" else LogLevel.Info,
        message=event.text, name=event.robot or event.operator or "fleet",
    )  # fmt: skip


def _outline(
    name: str, corners_m: Sequence[Sequence[float]], color: Color, unix_time_s: float
) -> SceneEntity:
    """Polygon on the ground; corners are (x, y), m."""
    line = LinePrimitive(
        type=LinePrimitiveLineType.LineLoop, pose=_NOWHERE, thickness=2.0, scale_invariant=True,
        points=[Point3(x=x_m, y=y_m, z=_LINES_Z_M) for x_m, y_m in corners_m], color=color,
    )  # fmt: skip
    return SceneEntity(
        timestamp=Timestamp.from_epoch_secs(unix_time_s), frame_id=FRAME, id=name,
        lifetime=_LIFETIME, lines=[line],
    )  # fmt: skip


def _shown_row(row: Row) -> ShownRobot:
    status = row.robot.status
    severity = "" if row.alarm is None else row.alarm.severity
    shown = ShownRobot(row.robot.name, cell(row, "state").text, problem(row).text, severity)
    if status is None:
        return shown
    return replace(
        shown,
        heard_s_ago=row.robot.age_s,
        armed=status.armed,
        mode=status.mode,
        battery=status.battery,
        satellites=status.satellites,
        height_m=None if status.position_m is None else status.position_m[2],
        speed_m_s=speed_m_s(status),
        neighbours=len(status.neighbour_ages_s),
    )


def _yaw_rad(status: RobotStatus) -> float:
    """Angle of the nose from the mission frame's x axis toward y; along y while unknown."""
    return math.pi / 2.0 - (nose_rad(status) or 0.0)


def _pose(status: RobotStatus) -> Pose:
    assert status.position_m is not None
    return Pose(position=Vector3(**_xyz(status.position_m)), orientation=_turned(_yaw_rad(status)))


def _xyz(point_m: tuple[float, float, float]) -> dict[str, float]:
    return dict(zip("xyz", point_m, strict=True))


def _turned(yaw_rad: float) -> Quaternion:
    return Quaternion(x=0.0, y=0.0, z=math.sin(yaw_rad / 2.0), w=math.cos(yaw_rad / 2.0))


_NOWHERE = Pose(position=Vector3(), orientation=_turned(0.0))
