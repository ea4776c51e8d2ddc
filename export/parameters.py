"""Reads a policy's training parameters from our TOML file or CoverageControl's."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from edge.core.perception import PerceptionParameters
from edge.core.schema import Bounded, ConfigError, Positive, from_mapping
from edge.core.toml import read_toml
from edge.core.wire import FLOAT_PAYLOADS, PayloadType
from edge.policy.bundle import Training


@dataclass(frozen=True, slots=True)
class PolicyMessages(Bounded):
    """Limits of the policy's messages: see `Manifest.payload_limit` and `payload_types`."""

    payload_limit: Positive | None = None
    payload_types: tuple[PayloadType, ...] = FLOAT_PAYLOADS


@dataclass(frozen=True, slots=True)
class PolicyParameters:
    """Training parameters of a policy and limits of its messages: the tables of our file."""

    perception: PerceptionParameters
    training: Training
    messages: PolicyMessages = field(default_factory=PolicyMessages)


def read_parameters(path: Path) -> PolicyParameters:
    """Read our parameter file, a configuration of `lpac train`, or a coverage_control_params.toml.

    The second is recognised by its [network], the third by its [Environment.Maps]. Raises
    ConfigError that names the file and the line or key.
    """
    document = read_toml(path)
    environment = document.get("Environment")
    if isinstance(environment, Mapping) and "Maps" in environment:
        document = _from_coverage_control(_TableReader(document, path))
    elif "network" in document:
        document = {name: document[name] for name in ("perception", "training") if name in document}
    return from_mapping(PolicyParameters, document, str(path))


@dataclass(frozen=True, slots=True)
class _TableReader:
    """Typed access to a TOML document. A missing value or a wrong type raises ConfigError."""

    document: Mapping[str, object]
    path: Path

    def value(self, table: str, key: str, kind: type) -> object:
        where = f"{self.path}: [{table}] {key}"
        values: object = self.document
        for name in (*table.split("."), key):
            if not isinstance(values, Mapping) or name not in values:
                raise ConfigError(f"{where} is missing")
            values = values[name]
        if type(values) is not kind and not (kind is float and type(values) is int):
            raise ConfigError(f"{where} = {values!r}: expected {kind.__name__}")
        return values

    def integer(self, table: str, key: str) -> int:
        value = self.value(table, key, int)
        assert isinstance(value, int)
        return value

    def number(self, table: str, key: str) -> float:
        value = self.value(table, key, float)
        assert isinstance(value, int | float)
        return float(value)


def _from_coverage_control(reader: _TableReader) -> dict[str, object]:
    """Convert CoverageControl's names and units to those of our file."""
    maps, idf, robot = "Environment.Maps", "Environment.IDF", "RobotModel"
    resolution = reader.number(maps, "Resolution")
    if resolution != 1:
        raise ConfigError(f"{reader.path}: [{maps}] Resolution = {resolution:g}: allowed is 1")
    world_size = reader.integer(maps, "WorldMapSize")
    robot_map_size = reader.integer(maps, "RobotMapSize")
    if robot_map_size != world_size:
        raise ConfigError(
            f"{reader.path}: [{maps}] RobotMapSize = {robot_map_size}: "
            f"allowed is WorldMapSize = {world_size}"
        )
    norm = reader.number(idf, "Norm")
    # CoverageControl gives a fraction of the largest importance, which is the norm.
    unknown = 0.0
    if reader.value(idf, "RobotMapUseUnknownImportance", bool):
        unknown = reader.number(idf, "UnknownImportance") * norm
    return {
        "perception": {
            "world_size": world_size,
            "local_map_size": reader.integer(maps, "LocalMapSize"),
            "sensor_size": reader.integer(robot, "SensorSize"),
            "communication_range": reader.number(robot, "CommunicationRange"),
            "unknown_importance": unknown,
        },
        "training": {
            "max_speed": reader.number(robot, "MaxRobotSpeed"),
            "time_step": reader.number(robot, "TimeStep"),
            "idf_truncation": reader.number(idf, "TruncationBND"),
            "idf_norm": norm,
        },
    }
