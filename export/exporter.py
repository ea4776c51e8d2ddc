"""Exports a checkpoint and its training parameters as a bundle."""

import hashlib
from collections.abc import Mapping
from dataclasses import fields, replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch

from edge.core.perception import PerceptionParameters
from edge.policy.bundle import (
    LPAC,
    SCHEMA_VERSION,
    Bundle,
    BundleError,
    Manifest,
    load_bundle,
    make_bundle,
)
from edge.policy.family import TOLERANCE
from edge.policy.golden import GOLDEN
from edge.policy.images import EXPLORED, MAP_CHANNELS
from edge.policy.lpac.manifest import Images, LpacManifest
from edge.policy.lpac.policy import LpacPolicy
from export.checkpoint import POSITION_SIZE, Checkpoint, CheckpointError, read_checkpoint
from export.golden import golden_vectors
from export.graphs import OPSET, build_graphs
from export.parameters import PolicyParameters, read_parameters
from export.training_maps import map_mismatch

# Training actions relative to a robot's maximum speed: 0.3 to 1.5 in all known trainings.
_MIN_SPEED_RATIO, _MAX_SPEED_RATIO = 0.1, 3.0


def export_bundle(
    checkpoint: Path,
    parameters: Path,
    name: str | None = None,
    *,
    cnn: Path | None = None,
    force: bool = False,
) -> Bundle:
    """Make the bundle of a checkpoint: a state dict file, or a folder with one file per tensor.

    `parameters` is our parameter file or a coverage_control_params.toml. It must agree with the
    traces that training left in the network, and with the bundle that `lpac train` wrote beside the
    checkpoint, unless `force` is set. `name` is the policy's name, by default the checkpoint's.
    `cnn` is a state dict whose CNN replaces the checkpoint's. A folder has no CNN; its bundle has
    no perception without `cnn`.

    Runs `verify` on the bundle. Raises CheckpointError or ConfigError, one line each.
    """
    network = read_checkpoint(checkpoint)
    trained = read_parameters(parameters)
    provenance = {
        "checkpoint": checkpoint.name,
        "checkpoint_sha256": network.sha256,
        "parameters": parameters.name,
        "parameters_sha256": hashlib.sha256(parameters.read_bytes()).hexdigest(),
    }
    if cnn is not None:
        other = read_checkpoint(cnn)
        network = _with_cnn(network, other, cnn)
        provenance |= {"cnn": cnn.name, "cnn_sha256": other.sha256}
    if not force and (why := _mismatch(checkpoint, network, trained)):
        raise CheckpointError(
            f"{parameters}: does not match the training of {cnn or checkpoint}: {why}. "
            "Use --force to export it all the same"
        )
    try:
        return bundle_of(network, trained, name or checkpoint.stem, provenance)
    except CheckpointError as error:
        raise CheckpointError(f"{checkpoint}: {error}") from None


def _mismatch(checkpoint: Path, network: Checkpoint, trained: PolicyParameters) -> str | None:
    """The reason why the network was not trained with these parameters, if there is one."""
    return (
        _bundle_mismatch(checkpoint, network, trained)
        or _speed_mismatch(network, trained.training.max_speed)
        or (map_mismatch(network.cnn, trained.perception) if network.cnn else None)
    )


def _bundle_mismatch(
    checkpoint: Path, network: Checkpoint, trained: PolicyParameters
) -> str | None:
    """Differences from the bundle of this checkpoint in the folder of the same name; or None."""
    beside = checkpoint.with_suffix("")
    try:
        manifest = load_bundle(beside).manifest
    except (BundleError, OSError):
        return None
    if manifest.provenance.get("checkpoint_sha256") != network.sha256:
        return None
    perception = manifest.perception
    if perception is not None:  # unseen_as_nan follows from the network
        perception = replace(perception, unseen_as_nan=trained.perception.unseen_as_nan)
    differing = [
        f"{field.name} = {getattr(given, field.name)} (in the bundle {getattr(known, field.name)})"
        for given, known in (
            (trained.perception, perception),
            (trained.training, manifest.training),
        )
        if known is not None
        for field in fields(given)
        if getattr(given, field.name) != getattr(known, field.name)
    ]
    return (
        f"the bundle {beside} of this checkpoint differs: {', '.join(differing)}"
        if differing
        else None
    )


def _speed_mismatch(network: Checkpoint, max_speed: float) -> str | None:
    """Compare the speed of the training actions with `max_speed`. Some trainings exceed it."""
    mean, std = (np.asarray(of, np.float64) for of in (network.action.mean, network.action.std))
    speed = float(np.sqrt(np.square(mean).sum() + np.square(std).sum()))
    if _MIN_SPEED_RATIO * max_speed < speed < _MAX_SPEED_RATIO * max_speed:
        return None
    return (
        f"with max_speed = {max_speed:g}, the mean training action (rms {speed:.2g}) would be "
        f"{speed / max_speed:.2g} times the maximum speed"
    )


def _with_cnn(network: Checkpoint, other: Checkpoint, path: Path) -> Checkpoint:
    if other.cnn is None:
        raise CheckpointError(f"{path}: has no CNN: expected the state dict of a whole network")
    features, taken = len(other.cnn.linear.bias), network.geometry.feature_sizes[0] - POSITION_SIZE
    if features != taken:
        raise CheckpointError(
            f"{path}: its CNN gives {features} features, expected the {taken} that the graph "
            "neural network takes beside the position"
        )
    return replace(network, cnn=other.cnn)


def manifest_of(
    family: str,
    perception: PerceptionParameters | None,
    trained: PolicyParameters,
    name: str,
    provenance: Mapping[str, str],
    parameters: dict[str, object],
) -> Manifest:
    """Manifest of a policy that this exporter made; `make_bundle` adds the files."""
    return Manifest(
        schema=SCHEMA_VERSION,
        name=name,
        family=family,
        perception=perception,
        training=trained.training,
        payload_limit=trained.messages.payload_limit,
        payload_types=trained.messages.payload_types,
        provenance={
            **provenance,
            "exporter": f"lpac-edge {version('lpac-edge')}",
            "torch": torch.__version__,
        },
        files={},
        parameters=parameters,
    )


def bundle_of(
    network: Checkpoint, trained: PolicyParameters, name: str, provenance: Mapping[str, str]
) -> Bundle:
    """Make the bundle of a network in memory and run `verify` on it.

    `provenance` says where the network came from; the exporter's version is added. `unseen_as_nan`
    follows from the network's images, whatever `trained` has. Raises CheckpointError, one line.
    """
    files = {GOLDEN: golden_vectors(network), **build_graphs(network)}
    images = perception = None
    if network.cnn:
        images = Images(
            MAP_CHANNELS[network.cnn.channels],
            network.cnn.image_size,
            len(network.cnn.linear.bias),
        )
        perception = replace(trained.perception, unseen_as_nan=EXPLORED in images.channels)
    parameters = LpacManifest(OPSET, network.geometry, images).parameters
    manifest = manifest_of(LPAC, perception, trained, name, provenance, parameters)
    bundle = make_bundle(manifest, files)
    for check in LpacPolicy(bundle).verify():
        if not check.passed:
            raise CheckpointError(
                f"{check.name}: float32 rounding alone gives a relative error of "
                f"{check.relative_error:.1e}, allowed is {TOLERANCE:g}"
            )
    return bundle
