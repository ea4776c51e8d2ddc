"""Training task of a family: its expert, and what a good flight is.

Processes that fly have it, so that this module, and a task's own, load no torch.
"""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

from edge.core import F64, Bools
from lpac.sim.baselines import BaselineName
from lpac.sim.points import Preparation
from lpac.study.flights import CostCurve, FlightGroup, PlannedFlight, curves_of
from lpac.train.config import DataConfig
from lpac.train.expert import Expert, make_expert


class Teacher(Protocol):
    """Expert in one world; it knows where all robots truly are, and how they move."""

    def look(self, positions: F64, alive: Bools) -> None:
        """Take notice of what the robots at `positions` (N, 2) see that are left."""

    def velocities(
        self,
        positions: F64,
        alive: Bools,
        robots: Sequence[int] | None = None,
        moving: F64 | None = None,
    ) -> F64:
        """Velocities that `robots` (m,), or all N, should fly: (m, 2); 0 of those not left.

        They are at true positions (N, 2) and fly `moving` (N, 2), in model units and model units/s;
        None: they stand.
        """


class Task(Protocol):
    """Training task: the expert that networks imitate, and what a good flight is.

    Can be pickled.
    """

    @property
    def baselines(self) -> Sequence[BaselineName]:
        """Baselines in the model card, over the same worlds; may be none."""

    def expert_name(self, data: DataConfig) -> str:
        """Name of the expert, for the model card."""

    def teacher(self, data: DataConfig, world: Preparation) -> Teacher:
        """A new one, for that world."""

    def costs(self, flights: FlightGroup) -> list[tuple[PlannedFlight, CostCurve]]:
        """Fly them; policies are chosen by the cost at the end over that at the start.

        Raises BundleError, ValueError, OSError.
        """


CLAIRVOYANT: BaselineName = "clairvoyant-cvt"
# Beside the one that knows all.
BASELINES: tuple[BaselineName, ...] = ("decentralized-cvt", "decentralized-cvt-prior")


class CoverageTask(NamedTuple):
    """The paper's: see `Task`."""

    @property
    def baselines(self) -> Sequence[BaselineName]:
        """See `Task`."""
        return (*BASELINES, CLAIRVOYANT)

    def expert_name(self, data: DataConfig) -> str:
        """See `Task`."""
        return {
            "clairvoyant-cvt": "ClairvoyantCVT, which knows the whole world",
            "best-of-lloyd": f"the best of {data.lloyd_runs} runs of Lloyd's algorithm on the "
            "whole world",
            "exploring-cvt": "ExploringCVT, which knows what all robots together have seen",
        }[data.expert]

    def teacher(self, data: DataConfig, world: Preparation) -> Expert:
        """The configured expert."""
        return make_expert(data, world)

    def costs(self, flights: FlightGroup) -> list[tuple[PlannedFlight, CostCurve]]:
        """The coverage cost."""
        return curves_of(flights)
