"""Provenance of an experiment: command, policies, draws, and versions."""

import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

import edge
import lpac
from lpac.sim.kept import code_digest
from lpac.study.study import Study


def made_by(
    command: str, bundle_ids: Sequence[str], drawn: Mapping[str, str] | None = None
) -> dict[str, str]:
    """Provenance by name; `drawn` has the worlds or seeds."""
    entries = {"command": f"lpac {command}", "bundle": ", ".join(bundle_ids), **(drawn or {})}
    return {
        **{what: value for what, value in entries.items() if value},
        "lpac-edge": f"{version('lpac-edge')}, code {code_digest(edge, lpac)[:12]}",
        "python": platform.python_version(),
        **{package: version(package) for package in ("numpy", "onnxruntime")},
    }


def made_by_study(command: str, study: Study) -> dict[str, str]:
    """Provenance of a study, with its bundles and worlds."""
    ids = [each.bundle_id for method in study.methods for each in method.trainings]
    first, last = study.draws[0].world, study.draws[-1].world
    policies = [
        f"{method.name}: {_from_here(each.path)}, {each.bundle_id[:12]}"
        for method in study.methods
        for each in method.trainings
    ]
    worlds = f"{first} to {last} of the {study.world_set} set, and their seeds"
    return made_by(command, ids, {"policies": "; ".join(policies), "worlds": worlds})


def _from_here(path: str) -> str:
    """Make a path below the working directory relative, without anything of this machine."""
    here = Path.cwd()
    return str(Path(path).relative_to(here)) if Path(path).is_relative_to(here) else path
