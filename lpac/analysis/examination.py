"""Records of the missions in flight logs, with notes for the reader."""

import contextlib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from edge.core.counted import counted
from edge.core.fence import Fence
from edge.core.schema import from_mapping
from edge.drivers.flight_log import FlightMetadata
from edge.messages.mission import world_id as id_of
from edge.policy.bundle import Bundle, BundleError, load_bundle
from lpac.analysis.coverage import Coverage
from lpac.analysis.flight import FlightRecord, Separation
from lpac.analysis.logs import Logs, Progress, configured, read_logs
from lpac.analysis.missions import Mission, find_missions, record_of
from lpac.analysis.statistics import finite

_MOST_NOTES = 3  # in one line


@dataclass(frozen=True, slots=True)
class _World:
    """Sizes of a policy's world, as in `FleetSetup`, and the text of a flight's world file."""

    world_size: int
    sensor_size: int
    env_scale: float
    truncation: float
    norm: float
    world: str = ""
    world_id: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Wanted:
    """Scope of a report.

    `missions` are names; empty for all. `times_s` are those of snapshots; empty for 0, a quarter,
    half and all of each mission. `world` is the world's file, `bundle` the policy's. Messages call
    the world's option `world_option`.
    """

    missions: tuple[str, ...] = ()
    times_s: tuple[float, ...] = ()
    world: Path | None = None
    bundle: Path | None = None
    world_option: str = "--world"

    def __post_init__(self) -> None:
        for time_s in self.times_s:
            if not 0.0 <= time_s < math.inf:
                raise ValueError(f"--times {time_s:g}: must be 0 or above")


class Examined(NamedTuple):
    """Records of the missions in some logs, and notes for the reader.

    `without_cost` maps the name of each mission whose cost is unknown to the reason.
    """

    records: tuple[FlightRecord, ...]
    notes: tuple[str, ...]
    without_cost: Mapping[str, str] = MappingProxyType({})

    def summary(self) -> dict[str, Any]:
        """The records and notes as JSON values."""
        return {"trials": [_values(record) for record in self.records], "notes": list(self.notes)}


_EVERYTHING = Wanted()


def examine(
    folders: Sequence[Path | str],
    wanted: Wanted = _EVERYTHING,
    progress: Progress = lambda *_: None,
) -> Examined:
    """Examine the logs below `folders`.

    Calls `progress` with the current step and the share done. Raises ValueError if there
    are no logs or no missions in them, OSError if something cannot be read.
    """
    paths = [Path(folder) for folder in folders]
    logs = read_logs(paths, progress)
    missions = find_missions(logs)
    chosen = _choose(logs, missions, wanted)
    notes = list(logs.notes)
    worlds = _Worlds(logs, paths, wanted, notes)
    fences = {m.robot_id: _fence(m) for m in logs.metadata}
    records, without_cost = [], {}
    for index, mission in enumerate(chosen):
        before = len(notes)
        progress(f"examining {mission.name}", index / len(chosen))
        record = record_of(
            logs, mission, [other for other in missions if other is not mission],
            *worlds.of(mission), fences.get(mission.robots[0]),
        )  # fmt: skip
        notes += _notes(logs, record, wanted)
        records.append(record)
        if not len(record.normalized):
            why = "; ".join(notes[before:])
            without_cost[record.name] = why or f"{record.name}: the cost is unknown"
    return Examined(tuple(records), tuple(notes), without_cost)


def _choose(logs: Logs, missions: list[Mission], wanted: Wanted) -> list[Mission]:
    """Select the wanted missions. Raises ValueError that names those in the logs."""
    if not missions:
        robots = len(logs.statuses)
        notes = "".join(f"; {note}" for note in logs.notes[:_MOST_NOTES])
        more = len(logs.notes) - _MOST_NOTES
        notes += f"; and {counted(more, 'more note')}" if more > 0 else ""
        raise ValueError(f"no mission in these logs, of {counted(robots, 'robot')}{notes}")
    if not wanted.missions:
        return missions
    names = [mission.name for mission in missions]
    for name in wanted.missions:
        if name not in names:
            raise ValueError(f"--trial {name!r}: the logs have {', '.join(map(repr, names))}")
    return [mission for mission in missions if mission.name in wanted.missions]


class _Worlds:
    """Finds worlds by their id."""

    def __init__(
        self, logs: Logs, folders: Iterable[Path], wanted: Wanted, notes: list[str]
    ) -> None:
        self._logs = logs
        self._bundle = wanted.bundle
        self._notes = notes
        self._world_option = wanted.world_option
        self._given = None if wanted.world is None else wanted.world.read_text("utf-8-sig")
        self._texts = {setup.world_id: setup.world for _, setup in logs.setups if setup.world}
        paths = [path for folder in folders for path in sorted(folder.rglob("*.env"))]
        paths += [Path(configured(m, "policy").get("world", "")) for m in logs.metadata]
        for path in dict.fromkeys(paths):
            # Not every .env file is a world.
            with contextlib.suppress(OSError, UnicodeDecodeError):
                text = path.read_text("utf-8-sig")
                self._texts.setdefault(id_of(text), text)
        self._coverages: dict[_World, Coverage] = {}

    def of(self, mission: Mission) -> tuple[Coverage | None, int]:
        """The world of the mission's flight, and the width of the robots' sensor in cells.

        The world is None, with a note, if it is not found. Raises BundleError if the given
        bundle cannot be loaded or has no perception.
        """
        statuses = [
            status
            for robot in mission.robots
            for status in self._logs.statuses[robot]
            if mission.begin_s <= status.time_s <= mission.end_s
        ]
        world = self._without_text(mission, {s.bundle_id for s in statuses})
        flown = sorted({s.world_id for s in statuses})
        return self._coverage(mission, flown, world), world.sensor_size

    def _coverage(self, mission: Mission, flown: list[str], world: _World) -> Coverage | None:
        if len(flown) > 1:
            self._notes.append(
                f"{mission.name}: the robots flew over several worlds: {', '.join(flown)}"
            )
        text = self._given
        if text is not None and id_of(text) not in flown:
            self._notes.append(
                f"{mission.name}: {self._world_option} is {id_of(text)}; the robots flew over "
                f"{flown[0]}"
            )
        if text is None:
            text = self._texts.get(flown[0])
        if text is None:
            self._notes.append(
                f"{mission.name}: no cost, because the file of world {flown[0]} is missing: "
                f"give it with {self._world_option}"
            )
            return None
        world = replace(world, world=text, world_id=id_of(text))
        if world not in self._coverages:
            self._coverages[world] = Coverage.of(world)
        return self._coverages[world]

    def _without_text(self, mission: Mission, bundle_ids: set[str]) -> _World:
        """Sizes from the ground's log, else from the bundle of a flown policy."""
        setups = [setup for setup in self._logs.setups if setup[1].bundle_id in bundle_ids]
        if setups and self._bundle is None:
            before = [setup for at_s, setup in setups if at_s <= mission.end_s]
            setup = before[-1] if before else setups[0][1]
            return _World(
                setup.world_size, setup.sensor_size, setup.env_scale, setup.truncation, setup.norm
            )
        env_scale = 16.0
        places = []
        for metadata in self._logs.metadata:
            if metadata.bundle_id in bundle_ids:
                env_scale = float(configured(metadata, "policy").get("env_scale", env_scale))
                places.append(Path(metadata.bundle_path))
        if self._bundle is not None:
            return _world_of(self._bundle, load_bundle(self._bundle), env_scale)
        for place in dict.fromkeys(places):
            with contextlib.suppress(BundleError, OSError):
                bundle = load_bundle(place)
                if bundle.id in bundle_ids:  # it may have been replaced
                    return _world_of(place, bundle, env_scale)
        world = _World(512, 64, env_scale, 2.0, 1.0)
        self._notes.append(
            f"{mission.name}: the policy's bundle is missing: give it with --bundle; assuming "
            f"a world of {world.world_size} cells and a sensor of {world.sensor_size}"
        )
        return world


def _world_of(place: Path, bundle: Bundle, env_scale: float) -> _World:
    """Sizes from a bundle. Raises BundleError if it has no perception."""
    perception, training = bundle.manifest.perception, bundle.manifest.training
    if perception is None:
        raise BundleError(f"{place}: the bundle has no perception")
    return _World(
        perception.world_size, perception.sensor_size, env_scale, training.idf_truncation,
        training.idf_norm,
    )  # fmt: skip


def _fence(metadata: FlightMetadata) -> Fence | None:
    """The configured fence; None if it is invalid."""
    try:
        return from_mapping(Fence, configured(metadata, "fence"), "fence")
    except ValueError:
        return None


def _notes(logs: Logs, record: FlightRecord, wanted: Wanted) -> Iterable[str]:
    late_s = [f"{time_s:g}" for time_s in wanted.times_s if time_s > record.duration_s]
    if late_s:
        lasted = f"lasted {record.duration_s:.1f} s"
        yield f"{record.name}: {lasted}: no snapshot at {', '.join(late_s)} s"
    if len(record.cost) and not len(record.normalized):
        yield f"{record.name}: no normalised cost, because the world has no importance"
    silent = [
        robot.name
        for robot in record.robots
        if not {(robot.robot_id, s.boot_nonce) for s in robot.statuses} & logs.programs_logged
    ]
    if silent:
        robots = "any robot" if len(silent) == len(record.robots) else ", ".join(silent)
        yield (
            f"{record.name}: no log of {robots}: the messages that arrived there are unknown; the "
            "rest is from the ground's log"
        )


def _values(record: FlightRecord) -> dict[str, Any]:
    """Numbers of a mission as JSON values."""
    messages = record.messages
    return {
        "trial": record.name,
        "began_unix_s": round(record.begin_s, 3),
        "duration_s": round(record.duration_s, 3),
        "robots": [robot.name for robot in record.robots],
        "worlds": list(record.world_ids),
        "cost": {
            "initial": _entry(record.cost, 0),
            "final": _entry(record.cost, -1),
            "normalized": _entry(record.normalized, -1),
            "lloyd": finite(record.lloyd),
            "normalized_lloyd": finite(record.normalized_lloyd),
            "time_s": record.curve_time_s[: len(record.normalized)].round(3).tolist(),
            "curve": record.normalized.round(6).tolist(),
        },
        "separation": _as_dict(record.separation),
        "fence_margin_m": finite(record.fence_margin_m),
        "truth": {
            "cost": {
                "initial": _entry(record.true_cost, 0),
                "final": _entry(record.true_cost, -1),
                "normalized": _entry(record.normalized_true, -1),
            },
            "separation": _as_dict(record.true_separation),
            "fence_margin_m": finite(record.true_fence_margin_m),
        }
        if record.truth
        else None,
        "restarts": dict(record.restarts),
        "alarms": [alarm._asdict() for alarm in record.alarms],
        "commands": [command._asdict() for command in record.commands],
        "messages": None
        if messages is None
        else {
            "came": len(messages.heard_at_s),
            "lost": messages.lost,
            "rejected": messages.rejected,
            "loss_share": finite(messages.loss_share),
            "age_p50_s": finite(messages.age_quantile_s(0.5)),
            "age_p99_s": finite(messages.age_quantile_s(0.99)),
        },
        "loops": {
            loop: {
                "p99_ms": max(float(late.p99_ms.max()) for late in robots.values()),
                "max_ms": max(float(late.max_ms.max()) for late in robots.values()),
                "overruns": sum(late.overruns for late in robots.values()),
                "failures": sum(late.failures for late in robots.values()),
            }
            for loop, robots in record.lateness.items()
            if robots
        },
        "start_m": record.places_at(0.0),
        "end_m": record.places_at(record.duration_s),
    }


def _as_dict(separation: Separation | None) -> dict[str, Any] | None:
    return None if separation is None else separation._asdict()


def _entry(values: Any, index: int) -> float | None:
    return finite(float(values[index])) if len(values) else None
