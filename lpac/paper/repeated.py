"""The page of the repeated paper: all experiments in a folder on one self-contained page."""

import itertools
import json
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from edge.policy.bundle import Bundle
from lpac.analysis.template import render
from lpac.paper.claims import Effort, Sizes, claims_of
from lpac.study.receiving_robot import ReceivingRobot, message_bytes

# Number of steps whose median is a step's time.
_STEPS = 100
TITLE = "The paper, repeated"


@dataclass(frozen=True, slots=True)
class Chapter:
    """A section of the page: an experiment's command, title, and captions of its figures.

    Its JSON is NAME/NAME.json.
    """

    name: str
    title: str
    figures: Mapping[str, str]


CHAPTERS = (
    Chapter(
        "e1", "E1, transferability",
        {
            "snapshots": "Three worlds that no policy was trained on, at 0, 15, 30 and 60 s: "
            "robots, their paths and Voronoi cells over the density, which is faint where it was "
            "not yet seen.",
            "costs": "Coverage cost over the initial cost, with the baselines.",
        },
    ),
    Chapter(
        "e2", "E2, repeatability",
        {"repeatability": "Cost of all trials, their mean and standard deviation; end positions."},
    ),
    Chapter(
        "e3", "E3, perturbation",
        {"perturbation": "Cost, neighbours in range and speeds; shaded while a robot is away."},
    ),
    Chapter(
        "transfer", "Transfer to other teams and worlds",
        {"conditions": "Mean final cost over clairvoyant Lloyd's, with 95 % intervals."},
    ),
    Chapter(
        "async", "Rates and asynchrony",
        {
            "rates": "Cost over the policy's rate, relative to that at the field's rates. Solid "
            "lines: unsynchronised robots; dashed: synchronised.",
            "staleness": "At the field's rates, with late messages.",
        },
    ),
    Chapter(
        "network", "Network",
        {
            "restarts": "What a stream between two robots gets while all programs restart.",
            "robots": "The same over the number of robots, and the age of their messages.",
        },
    ),
)  # fmt: skip


def write_page(folder: Path, bundle: Bundle, made_by: Mapping[str, Mapping[str, str]]) -> Path:
    """Write index.html and claims.json from the results in `folder`; returns the page's path.

    `made_by` has the provenance of each experiment; others are left out. Raises OSError.
    """
    documents = {
        chapter.name: json.loads((folder / chapter.name / f"{chapter.name}.json").read_text())
        for chapter in CHAPTERS
        if chapter.name in made_by
    }
    claims = claims_of(documents, sizes_of(bundle), effort_of(bundle))
    document = {
        "claims": [asdict(claim) for claim in claims],
        "made_by": {name: dict(entries) for name, entries in made_by.items()},
    }
    (folder / "claims.json").write_text(json.dumps(document, indent=2) + "\n")
    path = folder / "index.html"
    chapters = [chapter for chapter in CHAPTERS if chapter.name in documents]
    path.write_text(
        render(
            "lpac.paper", "repeated.html", title=TITLE, claims=claims, chapters=chapters,
            flown={name: document["flown"] for name, document in documents.items()},
            made_by=made_by, pictures={chapter.name: _pictures(folder, chapter)
                                       for chapter in chapters},
        )
    )  # fmt: skip
    return path


def sizes_of(bundle: Bundle) -> Sizes:
    """Sizes of a policy's messages. Raises BundleError if robots cannot fly it."""
    return Sizes(*(message_bytes(bundle, others) for others in (2, 100)))


def effort_of(bundle: Bundle) -> Effort:
    """Median times of a policy on this machine. Raises BundleError if robots cannot fly it."""
    robots = [ReceivingRobot(others, bundle) for others in (2, 100)]
    took_s = np.zeros((_STEPS, len(robots)))
    # Alternate, so that other load on the machine affects both.
    for step, number in itertools.product(range(_STEPS), range(len(robots))):
        began_s = time.perf_counter()
        robots[number].step()
        took_s[step, number] = time.perf_counter() - began_s
    return Effort(*np.median(took_s, axis=0).tolist())


def _pictures(folder: Path, chapter: Chapter) -> dict[str, bytes]:
    """PNG of each existing figure, by name."""
    paths = {name: folder / chapter.name / f"{name}.png" for name in chapter.figures}
    return {name: path.read_bytes() for name, path in paths.items() if path.exists()}
