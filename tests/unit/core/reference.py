"""The reference library, CoverageControl, as the tests' oracle."""

import importlib
import importlib.util
import sys
from collections.abc import Iterable
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from edge.core import F64
from edge.core.world import Feature, GaussianFeature

_NAME = "coverage_control"


def coverage_control_core() -> ModuleType:
    """The library's compiled module, without the torch that its package imports; or a skip."""
    if f"{_NAME}._core" in sys.modules:
        return sys.modules[f"{_NAME}._core"]
    if _NAME in sys.modules:
        return importlib.import_module(f"{_NAME}._core")
    spec = importlib.util.find_spec(_NAME)
    if spec is None or spec.submodule_search_locations is None:
        pytest.skip(f"{_NAME} is not installed (it exists for Python 3.11 on x86_64 only)")
    package = ModuleType(_NAME)
    package.__path__ = list(spec.submodule_search_locations)
    sys.modules[_NAME] = package
    try:
        return importlib.import_module(f"{_NAME}._core")
    finally:
        del sys.modules[_NAME]  # so that other tests can import the whole package


def reference_parameters(
    robots: int, world_size: int = 512, truncation: float = 2.0, norm: float = 1.0
) -> Any:
    """`Parameters` of the default policy's training; noise on positions is off by default."""
    parameters = coverage_control_core().Parameters()
    parameters.pNumRobots = robots
    parameters.pWorldMapSize = world_size
    parameters.pRobotMapSize = world_size
    parameters.pResolution = 1.0
    parameters.pLocalMapSize = 256
    parameters.pSensorSize = 64
    parameters.pCommunicationRange = 256.0
    parameters.pMaxRobotSpeed = 5.0
    parameters.pTimeStep = 0.2
    parameters.pTruncationBND = truncation
    parameters.pNorm = norm
    parameters.pUpdateRobotMap = True
    parameters.pUpdateSensorView = True
    # On, the library's controllers stop a robot that has hardly moved for a while.
    parameters.pCheckOscillations = False
    return parameters


def point_vector(points: Iterable[Iterable[float]] | F64) -> Any:
    """The library's `PointVector` of (n, 2) points."""
    return coverage_control_core().PointVector([np.array(p, np.float64) for p in points])


def reference_world(features: Iterable[Feature], parameters: Any) -> Any:
    """The library's `WorldIDF` of `features`; `GetWorldMap()` is its raster, indexed [x, y]."""
    core = coverage_control_core()
    world = core.WorldIDF(parameters)
    for f in features:
        if isinstance(f, GaussianFeature):
            mean, sigma = np.array(f.mean, np.float64), np.array(f.sigma, np.float64)
            world.AddNormalDistribution(
                core.BivariateNormalDistribution(mean, sigma, f.correlation, f.scale)
            )
        else:
            polygon = core.PolygonFeature(point_vector(f.vertices), f.importance)
            world.AddUniformDistributionPolygon(polygon)
    world.GenerateMapCPU()
    return world


def reference_environment(features: Iterable[Feature], positions: F64) -> Any:
    """The library's `CoverageSystem`, 512 x 512, robots at `positions` (N, 2) inside the world.

    `SetGlobalRobotPositions(point_vector(...))` moves them. It aborts the process when a robot is
    on the world's border or outside.
    """
    core = coverage_control_core()
    parameters = reference_parameters(len(positions))
    world = reference_world(features, parameters)
    return core.CoverageSystem(parameters, world, point_vector(positions))
