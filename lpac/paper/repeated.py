"""The paper, repeated: what its experiments left in a folder, as one page that holds everything."""

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

# Of which the median is how long one takes.
_STEPS = 100
TITLE = "The paper, repeated"


@dataclass(frozen=True, slots=True)
class Chapter:
    """An experiment of the page: its command, what it is, and its figures' captions.

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
            "robots, their paths and Voronoi cells over the density, which is faint where no "
            "robot had looked by then.",
            "costs": "Coverage cost over that at the start, beside the baselines.",
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
        {"conditions": "Mean cost at the end over clairvoyant Lloyd's, with 95 % intervals."},
    ),
    Chapter(
        "async", "Rates and asynchrony",
        {
            "rates": "Cost over the policy's rate, relative to that at the field's rates. Solid "
            "lines: each robot at its own moments; dashed: all robots in step.",
            "staleness": "At the field's rates, with messages that are late.",
        },
    ),
    Chapter(
        "network", "Network",
        {
            "restarts": "What a stream between two robots gets while all programs restart.",
            "robots": "The same over the number of robots, and how old their messages are.",
        },
    ),
)  # fmt: skip


def write_page(folder: Path, bundle: Bundle, made_by: Mapping[str, Mapping[str, str]]) -> Path:
    """index.html and claims.json of what lies in `folder`; gives the page's path.

    `made_by` says of each experiment what made it; one that is missing there is left out. Raises
    OSError.
    """
    documents = {
        chapter.name: json.loads((folder / chapter.name / f"{chapter.name}.json").read_text())
        for chapter in CHAPTERS
        if chapter.name in made_by
    }
    claims = claims_of(documents, sizes_of(bundle), effort_of(bundle))
    told = {
        "claims": [asdict(claim) for claim in claims],
        "made_by": {name: dict(its) for name, its in made_by.items()},
    }
    (folder / "claims.json").write_text(json.dumps(told, indent=2) + "\n")
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
    """Of the messages of a bundle's policy. Raises BundleError if no robot can fly it."""
    return Sizes(*(message_bytes(bundle, others) for others in (2, 100)))


def effort_of(bundle: Bundle) -> Effort:
    """Of a bundle's policy, medians, on this machine. Raises BundleError if no robot can fly it."""
    robots = [ReceivingRobot(others, bundle) for others in (2, 100)]
    took_s = np.zeros((_STEPS, len(robots)))
    # In turns, so that what else the machine does meanwhile hits both.
    for step, number in itertools.product(range(_STEPS), range(len(robots))):
        began_s = time.perf_counter()
        robots[number].step()
        took_s[step, number] = time.perf_counter() - began_s
    return Effort(*np.median(took_s, axis=0).tolist())


def _pictures(folder: Path, chapter: Chapter) -> dict[str, bytes]:
    """PNG by figure, of those that were drawn."""
    paths = {name: folder / chapter.name / f"{name}.png" for name in chapter.figures}
    return {name: path.read_bytes() for name, path in paths.items() if path.exists()}
