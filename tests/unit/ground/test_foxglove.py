"""What Foxglove is shown, and the layout that shows it."""

import base64
import dataclasses
import itertools
import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove import Context, layouts
from mcap.reader import make_reader
from typer.testing import CliRunner

from edge.drivers.flight_log import ROBOT_TOPICS, FlightLog
from edge.messages.codec import encode
from edge.messages.mission import FlightState, GroundState, explored_to_bytes
from lpac.analysis.coverage import Coverage
from lpac.analysis.snapshot import Explored, GroundEvent
from lpac.cli.foxglove import _LAYOUT, app
from lpac.ground.cost import Cost
from lpac.ground.foxglove.channels import Channels
from lpac.ground.foxglove.logs import convert, ground_logs
from lpac.ground.foxglove.view import FRAME, FoxgloveView
from lpac.ground.record import TOPICS, GroundMetadata, Recording
from tests.foxglove_client import decoded
from tests.unit.ground.snapshots import FENCE, on_ground, robot, setup, snapshot, status

NOW_S = 1e9


def seen(*corner: int) -> str:
    cells = np.zeros((64, 64), np.bool_)
    cells[corner[0] : corner[0] + 16, corner[1] : corner[1] + 8] = True
    return base64.b64encode(explored_to_bytes(cells)).decode()


def told() -> Iterator[object]:
    """Two robots on their mission, and one that was never heard."""
    yield setup(3)
    yield Explored("r0", seen(0, 0))
    yield Explored("r1", seen(0, 32))
    yield GroundEvent(NOW_S, "refusal", "r1", "does not take off: low battery", "alice")
    first = status(0, heading_rad=math.radians(120.0), position_m=(4.0, 12.0, 5.0))
    second = status(1, state=FlightState.HOLD, battery=0.5)
    heard = (robot(first), robot(second), dataclasses.replace(robot(status(2)), status=None))
    yield snapshot(*heard)


@pytest.fixture(scope="module")
def shown() -> dict[str, list[Any]]:
    """Topic -> messages, as a client understands them."""
    view, found = FoxgloveView(), dict[str, list[Any]]()
    now_s = itertools.count(NOW_S)

    def show(topic: str, at_s: float, message: Any) -> None:
        for each in (*view.take(topic, at_s, message), *view.tick(next(now_s))):
            said = each.message
            if dataclasses.is_dataclass(said):
                understood = json.loads(encode(said))
            else:
                schema = type(said).get_schema()
                understood = decoded(schema.name, schema.data, said.encode())
            found.setdefault(each.topic, []).append(understood)

    recording = Recording(show)
    for message in told():
        recording.take(message, NOW_S)  # type: ignore[arg-type]
    recording.close()
    return found


def test_each_robot_is_where_it_says_it_is(shown: dict[str, list[Any]]) -> None:
    transforms = [message["transforms"][0] for message in shown["/tf"]]
    assert [t["child_frame_id"] for t in transforms] == ["r0", "r1"]
    first = transforms[0]
    assert first["parent_frame_id"] == FRAME
    assert first["translation"] == {"x": 4.0, "y": 12.0, "z": 5.0}
    # North is 30 degrees left of the y axis, so that 120 degrees lead along the x axis.
    assert first["rotation"]["w"] == pytest.approx(1.0)
    entities = [message["entities"][0] for message in shown["/robots"]]
    assert [e["texts"][0]["text"] for e in entities] == ["r0 mission", "r1 hold"]
    assert entities[0]["lifetime"] == "2s"
    assert entities[0]["spheres"][0]["color"] != entities[1]["spheres"][0]["color"]


def test_the_cells_are_those_of_the_world(shown: dict[str, list[Any]]) -> None:
    cells = {
        entity["id"]: entity["lines"][0]["points"] for entity in shown["/cells"][0]["entities"]
    }
    # The line between x = 4 and x = 5; both robots are at y = 12.
    assert {round(p.get("x", 0.0), 3) for p in cells["r0"]} == {0.0, 4.5}
    assert {round(p.get("x", 0.0), 3) for p in cells["r1"]} == {4.5, 32.0}
    (fence,) = shown["/fence"][0]["entities"]
    corners = [(p.get("x", 0.0), p.get("y", 0.0)) for p in fence["lines"][0]["points"]]
    assert corners == list(FENCE.vertices_m)
    # Who is known, and does not count for the cost, has no cell.
    view = FoxgloveView()
    list(view.take("setup", NOW_S, dataclasses.asdict(setup(2))))
    for number in range(2):
        list(
            view.take("status", NOW_S, dataclasses.asdict(status(number)) | {"name": f"r{number}"})
        )
    cost = dataclasses.asdict(Cost("t1", ("r0",), True, 1.0, None, None, None))
    counted = [each.message for each in view.take("cost", NOW_S, cost)][1]
    understood = decoded("foxglove.SceneUpdate", type(counted).get_schema().data, counted.encode())
    assert [entity["id"] for entity in understood["entities"]] == ["r0"]


@pytest.mark.parametrize("topic", ["/density", "/seen"])
def test_grids_lie_as_the_world_does(shown: dict[str, list[Any]], topic: str) -> None:
    grid = shown[topic][-1]
    side = grid["column_count"]
    assert grid["row_stride"] == side and grid["cell_stride"] == 1
    assert grid["cell_size"]["x"] * side == pytest.approx(32.0)
    values = np.frombuffer(base64.b64decode(grid["data"]), np.uint8).reshape(side, side)
    if topic == "/density":
        # Rows lie along x, columns along y.
        density = Coverage.of(setup(3)).density(side)
        np.testing.assert_array_equal(values, density.T)
        assert values.max() == 255


def test_what_was_seen_by_how_many() -> None:
    view = FoxgloveView()
    list(view.take("setup", NOW_S, dataclasses.asdict(setup(2))))
    for name, cells in (("r0", seen(0, 0)), ("r1", seen(8, 0))):
        list(view.take("explored", NOW_S, {"robot": name, "cells": cells}))
    (grid,) = (shown.message for shown in view.tick(NOW_S) if shown.topic == "/seen")
    understood = decoded("foxglove.Grid", type(grid).get_schema().data, grid.encode())
    values = np.frombuffer(base64.b64decode(understood["data"]), np.uint8).reshape(64, 64)
    assert values[0, :24].tolist() == [1] * 8 + [2] * 8 + [1] * 8
    assert values.sum() == 2 * 16 * 8 and not values[8:].any()
    # Nothing is said twice at once, and all of it again after a while.
    assert not list(view.tick(NOW_S))
    assert {shown.topic for shown in view.tick(NOW_S + 1.0)} >= {"/fleet", "/seen", "/density"}


def test_a_row_for_each_robot_in_the_fleets_order(shown: dict[str, list[Any]]) -> None:
    fleet = shown["/fleet"][-1]
    assert [row["name"] for row in fleet["robots"]] == ["r0", "r1", "r2"]
    assert fleet["robots"][0]["heard_s_ago"] >= 1.0
    assert fleet["trial"] == "t1" and 0.0 < fleet["seen_share"] < 0.1
    assert shown["/robot/r1"][-1]["battery"] == 0.5
    (said,) = shown["/log"]
    assert (said["level"], said["name"]) == ("WARNING", "r1")
    assert "/robot/r2" not in shown


def test_a_robot_that_knows_nothing_of_itself_is_a_row() -> None:
    view = FoxgloveView()
    list(view.take("setup", NOW_S, dataclasses.asdict(dataclasses.replace(setup(1), world=""))))
    said = dataclasses.asdict(on_ground(0)) | {"name": "r0"}
    topics = {shown.topic for shown in view.take("status", NOW_S, said)}
    assert topics == {"/robot/r0"}
    due = {shown.topic: shown.message for shown in view.tick(NOW_S)}
    assert due.keys() == {"/fleet", "/fence", "/seen"}
    assert due["/fleet"].robots[0].height_m is None


def test_the_fence_is_the_one_that_the_ground_told() -> None:
    view = FoxgloveView()
    told = dataclasses.replace(FENCE, vertices_m=((0.0, 0.0), (40.0, 0.0), (0.0, 40.0)))
    list(view.take("setup", NOW_S, dataclasses.asdict(setup(1))))
    list(view.take("state", NOW_S, dataclasses.asdict(GroundState(4, "alice", fence=told))))
    (fence,) = (shown.message for shown in view.tick(NOW_S) if shown.topic == "/fence")
    understood = decoded("foxglove.SceneUpdate", type(fence).get_schema().data, fence.encode())
    assert len(understood["entities"][0]["lines"][0]["points"]) == 3


def test_what_is_not_a_logs_is_one_line() -> None:
    with pytest.raises(ValueError, match=r"^RobotStatus: .*battery`$"):
        list(FoxgloveView().take("status", NOW_S, {"name": "r0", "battery": "full"}))


# Logs


def recorded(folder: Path) -> None:
    log = FlightLog(folder, GroundMetadata("field", "1"), TOPICS, sync_period_s=0.0)
    recording = Recording(log.record)
    for message in told():
        recording.take(message, NOW_S)  # type: ignore[arg-type]
    recording.close()
    log.close()


def test_a_log_becomes_what_was_shown_live(tmp_path: Path, shown: dict[str, list[Any]]) -> None:
    recorded(tmp_path / "logs")
    done: list[int] = []
    convert(ground_logs(tmp_path), tmp_path / "out.mcap", done.append)
    assert done == [1]
    found: dict[str, list[Any]] = {}
    with (tmp_path / "out.mcap").open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages(log_time_order=False):
            assert schema is not None
            assert NOW_S - 1.0 < message.log_time / 1e9 <= NOW_S
            if channel.message_encoding == "json":
                understood = json.loads(message.data)
            else:
                understood = decoded(schema.name, schema.data, message.data)
            found.setdefault(channel.topic, []).append(understood)
    assert found.keys() == shown.keys()
    for topic in ("/tf", "/robots", "/cost", "/cells", "/log", "/robot/r0", "/robot/r1"):
        assert found[topic] == shown[topic]


def test_without_a_grounds_log_it_says_what_helps(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"has no ground's log .*`lpac record`"):
        ground_logs(tmp_path)
    with pytest.raises(ValueError, match="is not a folder"):
        ground_logs(tmp_path / "absent")
    names = [f"ground-{number}.mcap" for number in range(9)]
    for name in reversed(names):
        (tmp_path / name).touch()
    (tmp_path / "ground-9.mcap").mkdir()
    assert [path.name for path in ground_logs(tmp_path)] == names


def test_the_commands_write_what_they_say(tmp_path: Path) -> None:
    recorded(tmp_path / "logs")
    for arguments in (["layout", "-o", "panels.json"], ["log", "logs", "-o", "fleet.mcap"]):
        paths = [str(tmp_path / a) if a[0] != "-" and i else a for i, a in enumerate(arguments)]
        told = CliRunner().invoke(app, paths)
        assert told.exit_code == 0 and paths[-1] in told.stdout, told
    assert json.loads((tmp_path / "panels.json").read_text()) == LAYOUT
    assert (tmp_path / "fleet.mcap").read_bytes().endswith(b"\x89MCAP0\r\n")


# The layout

LAYOUT = json.loads(_LAYOUT.read_text())
CONFIG: dict[str, dict[str, Any]] = LAYOUT["configById"]


def panels(layout: Any) -> set[str]:
    if isinstance(layout, str):
        tabs = CONFIG[layout].get("tabs", ())
        return {layout}.union(*(panels(tab["layout"]) for tab in tabs))
    assert layout["direction"] in ("row", "column")
    return panels(layout["first"]) | panels(layout["second"])


def schemas() -> dict[str, tuple[str, dict[str, Any]]]:
    """Of each topic, live or of a log: the schema's name, and itself if it is JSON."""
    found = {
        name: (described.schema_name, json.loads(described.schema))
        for name, described in {**TOPICS, **ROBOT_TOPICS}.items()
    }
    channels = Channels(Context())
    for name, channel in {**channels._foxglove, **channels._json}.items():
        schema = channel.schema()
        is_json = schema.encoding == "jsonschema"
        found[name] = (schema.name, json.loads(schema.data) if is_json else {})
    return found


def test_every_panel_is_placed_once() -> None:
    assert panels(LAYOUT["layout"]) == CONFIG.keys()
    kinds = {panel.partition("!")[0] for panel in CONFIG}
    assert kinds == {"3D", "Plot", "StateTransitions", "Table", "RosOut", "RawMessages", "Tab"}


_BY_KIND: dict[str, Any] = {
    "3D": layouts.ThreeDeeConfig,
    "Plot": layouts.PlotConfig,
    "StateTransitions": layouts.StateTransitionsConfig,
    "Table": layouts.TableConfig,
    "RosOut": layouts.LogConfig,
    "RawMessages": layouts.RawMessagesConfig,
}
_BY_SCHEMA: dict[str, Any] = {
    "foxglove.Grid": layouts.BaseRendererGridTopicSettings,
    "foxglove.SceneUpdate": layouts.BaseRendererSceneUpdateTopicSettings,
    "foxglove.PoseInFrame": layouts.BaseRendererPoseTopicSettings,
}


def keys(kind: Any) -> set[str]:
    return set(kind()._to_dict())


def test_panels_have_settings_that_foxglove_knows() -> None:
    """As its SDK describes them; a file's panels also have their titles."""
    topics = schemas()
    for panel, config in CONFIG.items():
        kind = panel.partition("!")[0]
        if kind == "Tab":
            continue
        assert config.keys() - {"title", "foxglovePanelTitle"} <= keys(_BY_KIND[kind]), panel
        for entry in config.get("paths", ()):
            series = {
                "Plot": layouts.PlotSeries,
                "StateTransitions": layouts.StateTransitionsSeries,
            }
            assert entry.keys() <= keys(series[kind]), panel
        for topic, drawn in config.get("topics", {}).items():
            assert drawn.keys() <= keys(_BY_SCHEMA[topics[topic][0]]), topic
        assert config.get("cameraState", {}).keys() <= keys(layouts.ThreeDeeCameraState)
        scene = config.get("scene", {})
        assert scene.keys() <= keys(layouts.BaseRendererSceneSettings)
        assert scene.get("transforms", {}).keys() <= keys(layouts.BaseRendererTransforms)


def paths() -> list[str]:
    found = [entry["value"] for config in CONFIG.values() for entry in config.get("paths", ())]
    return [*found, *(c["topicPath"] for c in CONFIG.values() if "topicPath" in c)]


@pytest.mark.parametrize("path", paths())
def test_what_panels_plot_is_said(path: str) -> None:
    topic, *fields = re.split(r"\.", path)
    _, schema = schemas()[topic]
    for field in fields:
        name, _, index = field.partition("[")
        schema = schema["properties"][name]
        if index:
            assert schema["type"] == "array"
            schema = schema["items"]
    if fields and "robots" not in fields[-1]:
        assert schema["type"] in ("number", "string")


def test_what_panels_draw_is_said_and_drawable() -> None:
    known = schemas()
    drawn = {topic for config in CONFIG.values() for topic in config.get("topics", ())}
    assert {known[topic][0] for topic in drawn} == {
        "foxglove.Grid", "foxglove.SceneUpdate", "foxglove.PoseInFrame",
    }  # fmt: skip
    assert {c["topicToRender"] for c in CONFIG.values() if "topicToRender" in c} == {"/log"}
    assert known["/log"][0] == "foxglove.Log"
    assert {c["followTf"] for c in CONFIG.values() if "followTf" in c} == {FRAME}


def test_grids_are_coloured_by_fields_that_they_have(shown: dict[str, list[Any]]) -> None:
    for topic in ("/density", "/seen"):
        (field,) = shown[topic][-1]["fields"]
        assert CONFIG["3D!fleet"]["topics"][topic]["colorField"] == field["name"]
