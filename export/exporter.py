"""From a checkpoint and its parameters to a bundle."""

import hashlib
from collections.abc import Mapping
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import torch

from edge.policy.bundle import SCHEMA_VERSION, Bundle, Manifest, make_bundle
from edge.policy.family import TOLERANCE
from edge.policy.lpac.images import EXPLORED, MAP_CHANNELS
from edge.policy.lpac.manifest import GOLDEN, Images, LpacManifest
from edge.policy.lpac.policy import LpacPolicy
from export.checkpoint import POSITION_SIZE, Checkpoint, CheckpointError, read_checkpoint
from export.golden import golden_vectors
from export.graphs import OPSET, build_graphs
from export.parameters import PolicyParameters, read_parameters
from export.training_maps import contradiction


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
    what the network remembers of its training must not contradict it. `name` is the policy's name,
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
    if network.cnn and not force and (why := contradiction(network.cnn, trained.perception)):
        raise CheckpointError(
            f"{parameters}: is hardly what {cnn or checkpoint} was trained with: {why}. "
            "If it is, --force exports it"
        )
    try:
        return bundle_of(network, trained, name or checkpoint.stem, provenance)
    except CheckpointError as error:
        raise CheckpointError(f"{checkpoint}: {error}") from None


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
