"""Parameters from our own file and from CoverageControl's."""

from pathlib import Path

import pytest

from edge.core.perception import PerceptionParameters
from edge.core.schema import ConfigError
from edge.policy.bundle import Training
from export.parameters import read_parameters
from tests.conftest import ROOT
from tests.published import AUTHORS_PARAMETERS, MADE, sources

OURS = ROOT / "policies" / "lpac_l2_k3_n10_512.toml"

COVERAGE_CONTROL = """
NumRobots = 1
[Environment.Maps]
Resolution = 1
WorldMapSize = 300
RobotMapSize = 300
LocalMapSize = 128
[Environment.IDF]
TruncationBND = 2.5
Norm = 4
UnknownImportance = 0.5
RobotMapUseUnknownImportance = true
[RobotModel]
SensorSize = 32
CommunicationRange = 64.5
MaxRobotSpeed = 3
TimeStep = 0.1
[Algorithm]
EpisodeSteps = 2100
"""
# All keys that the shipped policy's authors set; `{size}` is the world's.
AUTHORS_FILE = """
NumRobots = 1
[Environment]
[Environment.Maps]
Resolution = 1
WorldMapSize = {size} # cells
RobotMapSize = {size}
LocalMapSize = 256
[Environment.Maps.UpdateSettings]
UpdateRobotMap = true
UpdateSensorView = true
UpdateExplorationMap = false
UpdateSystemMap = true
[Environment.IDF]
NumGaussianFeatures = 1
TruncationBND = 2
Norm = 1
MinSigma = 40
MaxSigma = 60
MinPeak = 6
MaxPeak = 10
UnknownImportance = 0.5
RobotMapUseUnknownImportance = false
[RobotModel]
SensorSize = 64
CommunicationRange = 256
MaxRobotSpeed = 5
RobotInitDist = {size}
RobotPosHistorySize = 40
TimeStep = 0.2
[RobotModel.AddNoise]
AddNoisePositions = false
PositionsNoiseSigma = 0.1
[Algorithm]
EpisodeSteps = 2100
[Algorithm.Global-CVT]
LloydMaxIterations = 1000
LloydNumTries = 20
[Algorithm.Exploration]
NumFrontiers = 10
"""
OUR_FILE = """
[perception]
world_size = 300
local_map_size = 128
sensor_size = 32
communication_range = 64.5
[training]
max_speed = 3
time_step = 0.1
"""


def read(text: str, folder: Path) -> tuple[PerceptionParameters, Training]:
    (folder / "parameters.toml").write_text(text)
    read = read_parameters(folder / "parameters.toml")
    return read.perception, read.training


def test_the_shipped_file() -> None:
    read = read_parameters(OURS)
    perception, training = read.perception, read.training
    assert perception == PerceptionParameters(512, 256, 64, 256.0)
    assert training == Training(max_speed=5.0, time_step=0.2)


@pytest.fixture(params=sources(AUTHORS_PARAMETERS))
def authors_parameters(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A folder of CoverageControl's files, in the form of the paper's authors."""
    if request.param != MADE:
        return Path(request.param)
    for size in (512, 1024):
        path = tmp_path / f"coverage_control_params_{size}.toml"
        path.write_text(AUTHORS_FILE.format(size=size))
    return tmp_path


def test_coverage_control_file_says_the_same_as_ours(authors_parameters: Path) -> None:
    theirs, ours = (
        read_parameters(authors_parameters / "coverage_control_params_512.toml"),
        read_parameters(OURS),
    )
    assert (theirs.perception, theirs.training) == (ours.perception, ours.training)
    perception = read_parameters(
        authors_parameters / "coverage_control_params_1024.toml"
    ).perception
    assert perception.world_size == 1024


def test_coverage_control_keys(tmp_path: Path) -> None:
    perception, training = read(COVERAGE_CONTROL, tmp_path)
    assert perception == PerceptionParameters(300, 128, 32, 64.5, unknown_importance=2.0)
    assert training == Training(3.0, 0.1, idf_truncation=2.5, idf_norm=4.0)
    known = COVERAGE_CONTROL.replace("Importance = true", "Importance = false")
    assert read(known, tmp_path)[0].unknown_importance == 0.0


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("Resolution = 1", "Resolution = 0.5", "[Environment.Maps] Resolution = 0.5: allowed is 1"),
        (
            "RobotMapSize = 300",
            "RobotMapSize = 200",
            "[Environment.Maps] RobotMapSize = 200: allowed is WorldMapSize = 300",
        ),
        ("SensorSize = 32", "", "[RobotModel] SensorSize is missing"),
        ("SensorSize = 32", "SensorSize = 31", "perception: sensor_size = 31: must be positive"),
        ("SensorSize = 32", "SensorSize = 32.0", "[RobotModel] SensorSize = 32.0: expected int"),
        ("Norm = 4", "Norm = true", "[Environment.IDF] Norm = True: expected float"),
        ("[RobotModel]", "[Robot]", "[RobotModel] SensorSize is missing"),
        ("TimeStep = 0.1", "TimeStep = 0", "training: time_step = 0.0: must be above 0"),
    ],
)
def test_coverage_control_mistakes(old: str, new: str, line: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as error:
        read(COVERAGE_CONTROL.replace(old, new), tmp_path)
    assert str(error.value).startswith(f"{tmp_path / 'parameters.toml'}: {line}")


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("world_size = 300", "", "perception: world_size is missing"),
        ("world_size", "size", "perception: unknown key 'size'; known are world_size, "),
        ("[training]", "[train]", "unknown key 'train'; known are perception, training"),
        ("max_speed = 3", "max_speed = -3", "training: max_speed = -3: must be above 0"),
        ("max_speed = 3", "max_speed = ", "is not TOML: Invalid value (at line 8, column 13)"),
    ],
)
def test_mistakes_in_our_file(old: str, new: str, line: str, tmp_path: Path) -> None:
    assert read(OUR_FILE, tmp_path)[1] == Training(3.0, 0.1)
    with pytest.raises(ConfigError) as error:
        read(OUR_FILE.replace(old, new), tmp_path)
    assert str(error.value).startswith(f"{tmp_path / 'parameters.toml'}: {line}")
    assert "\n" not in str(error.value)


def test_files_that_are_no_text(tmp_path: Path) -> None:
    (tmp_path / "model.pt").write_bytes(b"PK\x03\x04\xff\xfe")
    with pytest.raises(ConfigError, match=r"model\.pt: is not TOML: "):
        read_parameters(tmp_path / "model.pt")
    with pytest.raises(ConfigError, match=r"absent\.toml: cannot be read: there is no such file"):
        read_parameters(tmp_path / "absent.toml")
    with pytest.raises(ConfigError, match=r": is a folder; a file is needed$"):
        read_parameters(tmp_path)
