"""From a checkpoint and its parameters to a bundle."""

import hashlib
from collections.abc import Mapping
from dataclasses import fields, replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch

from edge.policy.bundle import (
    SCHEMA_VERSION,
    Bundle,
    BundleError,
    Manifest,
    load_bundle,
    make_bundle,
)
from edge.policy.family import TOLERANCE
from edge.policy.lpac.images import EXPLORED, MAP_CHANNELS
from edge.policy.lpac.manifest import GOLDEN, Images, LpacManifest
from edge.policy.lpac.policy import LpacPolicy
from export.checkpoint import POSITION_SIZE, Checkpoint, CheckpointError, read_checkpoint
from export.golden import golden_vectors
from export.graphs import OPSET, build_graphs
from export.parameters import PolicyParameters, read_parameters
from export.training_maps import contradiction

# Of a robot's greatest speed, the actions of trainings that are known come to 0.3 to 1.5.
_SLOWEST, _FASTEST = 0.1, 3.0


def export_bundle(
    checkpoint: Path,
    parameters: Path,
    name: str | None = None,
    *,
    cnn: Path | None = None,
    force: bool = False,
) -> Bundle:
    """Make the bundle of a checkpoint: a state dict's file, or a folder of one file per tensor.

    `parameters` is our parameter file or a coverage_control_params.toml; unless it is a `force`,
    neither what the network remembers of its training nor a bundle of it that lies beside it, as
    `lpac train` leaves them, may contradict it. `name` is the policy's name,
    by default the checkpoint's. A folder holds no CNN: its bundle is without perception, but for
    that of the state dict `cnn`, which replaces a CNN that there is.

    The bundle has passed `verify` on this machine. Raises CheckpointError or ConfigError, one line
    each.
    """
    network = read_checkpoint(checkpoint)
    trained = read_parameters(parameters)
    # Hashes are sha256.
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
    if not force and (why := _doubt(checkpoint, network, trained)):
        raise CheckpointError(
            f"{parameters}: is hardly what {cnn or checkpoint} was trained with: {why}. "
            "If it is, --force exports it"
        )
    try:
        return bundle_of(network, trained, name or checkpoint.stem, provenance)
    except CheckpointError as error:
        raise CheckpointError(f"{checkpoint}: {error}") from None


def _doubt(checkpoint: Path, network: Checkpoint, trained: PolicyParameters) -> str | None:
    """Why these are hardly the parameters that it was trained with; None if they may be."""
    return (
        _other_than_beside(checkpoint, network, trained)
        or _other_speed(network, trained.training.max_speed)
        or (contradiction(network.cnn, trained.perception) if network.cnn else None)
    )


def _other_than_beside(
    checkpoint: Path, network: Checkpoint, trained: PolicyParameters
) -> str | None:
    """Describe how a bundle of this checkpoint in the folder of its name differs."""
    beside = checkpoint.with_suffix("")
    try:
        manifest = load_bundle(beside).manifest
    except (BundleError, OSError):
        return None
    if manifest.provenance.get("checkpoint_sha256") != network.sha256:
        return None
    perception = manifest.perception
    if perception is not None:  # This follows from the network.
        perception = replace(perception, unseen_as_nan=trained.perception.unseen_as_nan)
    differing = [
        f"{field.name} = {getattr(given, field.name)} (there {getattr(known, field.name)})"
        for given, known in (
            (trained.perception, perception),
            (trained.training, manifest.training),
        )
        if known is not None
        for field in fields(given)
        if getattr(given, field.name) != getattr(known, field.name)
    ]
    return (
        f"the bundle {beside} of it was made with others: {', '.join(differing)}"
        if differing
        else None
    )


def _other_speed(network: Checkpoint, max_speed: float) -> str | None:
    """Training's actions were about as fast as robots may fly: some faster, where it overshot."""
    mean, std = (np.asarray(of, np.float64) for of in (network.action.mean, network.action.std))
    speed = float(np.sqrt(np.square(mean).sum() + np.square(std).sum()))
    if _SLOWEST * max_speed < speed < _FASTEST * max_speed:
        return None
    return (
        f"with max_speed = {max_speed:g}, the actions that it was trained with, {speed:.2g} on "
        f"average (rms), would be {speed / max_speed:.2g} times as fast"
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


def bundle_of(
    network: Checkpoint, trained: PolicyParameters, name: str, provenance: Mapping[str, str]
) -> Bundle:
    """The bundle of a network in memory; it has passed `verify` on this machine.

    `provenance` says where the network came from; the exporter adds itself. Whether what is unseen
    is NaN in the local map follows from the network's images, whatever `trained` says. Raises
    CheckpointError, one line.
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
    manifest = Manifest(
        schema=SCHEMA_VERSION,
        name=name,
        perception=perception,
        training=trained.training,
        payload_limit=trained.messages.payload_limit,
        payload_types=trained.messages.payload_types,
        provenance={
            **provenance,
            "exporter": f"lpac-edge {version('lpac-edge')}",
            "torch": torch.__version__,
        },
        files={},  # make_bundle puts them in
        parameters=LpacManifest(OPSET, network.geometry, images).parameters,
    )
    bundle = make_bundle(manifest, files)
    for check in LpacPolicy(bundle).verify():
        if not check.passed:
            raise CheckpointError(
                f"{check.name}: float32 rounding alone gives a relative error of "
                f"{check.relative_error:.1e}, allowed is {TOLERANCE:g}"
            )
    return bundle
