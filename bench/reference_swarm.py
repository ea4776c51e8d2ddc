"""The reference library flying its policy: CoverageControl's simulator, its LPAC in batched torch.

As its own controller does, in every time step all robots' maps go through the network as one batch
and the whole swarm's graph through its layers. The maps are taken from the simulator and resized as
torchvision does it, without the library's own copies of them, which cost more. Only what is
measured imports it (GPL, Python 3.11 on x86-64).
"""

import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from importlib.machinery import PathFinder
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional
from torch_geometric.data import Data  # type: ignore[import-untyped]

from edge.core import F64
from edge.core.world import GaussianFeature
from edge.policy.bundle import Manifest
from edge.policy.lpac.manifest import LpacManifest

_LIBRARY = "coverage_control"
# The package of the network alone: the one around it wants torchvision.
_MODELS = "bench_coverage_control_models"


def is_installed() -> bool:
    """Whether the library is."""
    return PathFinder.find_spec(_LIBRARY) is not None


class ReferenceSwarm:
    """A swarm of the library, on one thread; positions are in model units, inside the world."""

    def __init__(
        self,
        manifest: Manifest,
        checkpoint: Path,
        features: Sequence[GaussianFeature],
        positions: F64,
    ) -> None:
        """`checkpoint` is the state dict that the bundle of `manifest` was exported from."""
        torch.set_num_threads(1)
        perception, training = manifest.perception, manifest.training
        assert perception is not None
        lpac = LpacManifest.of(manifest)
        assert lpac.images is not None
        core = _part(_LIBRARY, "_core", "")
        parameters = core.Parameters()
        parameters.pNumRobots = len(positions)
        parameters.pWorldMapSize = parameters.pRobotMapSize = perception.world_size
        parameters.pResolution = 1.0
        parameters.pLocalMapSize = perception.local_map_size
        parameters.pSensorSize = perception.sensor_size
        parameters.pCommunicationRange = perception.communication_range
        parameters.pMaxRobotSpeed = training.max_speed
        parameters.pTimeStep = self.time_step_s = training.time_step
        parameters.pTruncationBND = training.idf_truncation
        parameters.pNorm = training.idf_norm
        parameters.pCheckOscillations = False
        world = core.WorldIDF(parameters)
        for each in features:
            world.AddNormalDistribution(
                core.BivariateNormalDistribution(
                    np.array(each.mean), np.array(each.sigma), each.correlation, each.scale
                )
            )
        world.GenerateMapCPU()
        self._points = core.PointVector
        self._system = core.CoverageSystem(parameters, world, self._points(list(positions)))
        self._network = _network(torch.load(checkpoint, weights_only=True), lpac.images.size)
        self._perception = perception
        self._image_size = lpac.images.size

    def step(self) -> None:
        """All perceive, exchange and move for a time step."""
        with torch.inference_mode():
            actions = self._network(self._inputs())
            actions = actions * self._network.actions_std + self._network.actions_mean
        self._system.StepActions(self._points(list(actions.double().numpy())))

    def cost(self) -> float:
        """The coverage cost of now, as the library computes it."""
        return float(self._system.GetObjectiveValue())

    def _inputs(self) -> Data:
        system, perception, size = self._system, self._perception, self._image_size
        robots = range(system.GetNumRobots())
        raw = np.stack(
            [
                [system.GetRobotLocalMap(robot) for robot in robots],
                [system.GetRobotObstacleMap(robot) for robot in robots],
            ],
            axis=1,
        )
        maps = functional.interpolate(
            torch.from_numpy(raw), (size, size), mode="bilinear", antialias=True
        )
        heard = torch.from_numpy(
            np.array(system.GetCommunicationMaps(size), np.float32).reshape(-1, 2, size, size)
        )
        positions = torch.from_numpy(np.array(list(system.GetRobotPositions()), np.float32))
        distances = torch.cdist(positions, positions).fill_diagonal_(torch.inf)
        return Data(
            x=torch.cat([maps[:, :1], heard, maps[:, 1:]], 1),
            edge_index=(distances < perception.communication_range).nonzero().T.contiguous(),
            pos=(positions + perception.world_size / 2.0) / perception.world_size,
        )


def _network(state: Mapping[str, Tensor], image_size: int) -> Any:
    """The library's LPAC with these weights."""
    convolution = state["cnn_backbone.conv0.weight"]
    tap = state["gnn_backbone.graph_conv_0.lins.0.weight"]
    cnn = {
        "InputDim": convolution.shape[1],
        "LatentSize": convolution.shape[0],
        "KernelSize": convolution.shape[2],
        "NumLayers": _count(state, "cnn_backbone.conv{}.weight"),
        "ImageSize": image_size,
        "OutputDim": 2,
    }
    gnn = {
        "InputDim": tap.shape[1],
        "LatentSize": tap.shape[0],
        "NumHops": _count(state, "gnn_backbone.graph_conv_0.lins.{}.weight") - 1,
        "NumLayers": _count(state, "gnn_backbone.graph_conv_{}.bias"),
        "OutputDim": 2,
    }
    model = _part(_MODELS, "lpac", "nn/models").LPAC({"CNNBackBone": cnn, "GNNBackBone": gnn})
    model.load_state_dict(state)
    return model.eval()


def _part(package: str, module: str, folder: str) -> ModuleType:
    """A module of the library's `folder`, without what the packages around it import."""
    spec = PathFinder.find_spec(_LIBRARY)
    assert spec is not None and spec.origin is not None
    if package not in sys.modules:
        around = ModuleType(package)
        around.__path__ = [str(Path(spec.origin).parent / folder)]
        sys.modules[package] = around
    return import_module(f"{package}.{module}")


def _count(state: Mapping[str, Tensor], name: str) -> int:
    return sum(name.format(number) in state for number in range(len(state)))
