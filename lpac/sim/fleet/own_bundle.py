"""The policy of whole robots in a world, or with a range, of another size than in training.

A robot takes both from its bundle, so that these get a bundle of their own.
"""

from dataclasses import replace
from pathlib import Path

from edge.policy.bundle import BundleError, load_bundle, make_bundle, write_bundle


def bundle_with(
    path: Path, folder: Path, *, world_size: int | None, communication_range: float | None
) -> Path:
    """The bundle at `path`, or one in `folder` that differs from it only in what is given.

    Both are in model units. Raises BundleError, also for one without perception, and OSError.
    """
    bundle = load_bundle(path)
    trained = bundle.manifest.perception
    if trained is None:
        raise BundleError(f"{path}: the bundle has no perception: it cannot fly")
    perception = replace(
        trained,
        world_size=trained.world_size if world_size is None else world_size,
        communication_range=(
            trained.communication_range if communication_range is None else communication_range
        ),
    )
    if perception == trained:
        return path
    files = {name: bundle.files[name] for name in bundle.manifest.files}
    write_bundle(make_bundle(replace(bundle.manifest, perception=perception), files), folder)
    return folder
