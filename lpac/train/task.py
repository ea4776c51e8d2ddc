"""Training task of a family: its expert, and the cost of a flight.

Tasks are sent to the processes that fly, so their modules must not import torch.
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
    """Expert in one world, which knows all robots' true positions and velocities."""

    def look(self, positions: F64, alive: Bools) -> None:
        """Update what the robots at `positions` (N, 2) that are `alive` have seen."""

    def velocities(
        self,
        positions: F64,
        alive: Bools,
        robots: Sequence[int] | None = None,
        moving: F64 | None = None,
    ) -> F64:
        """Velocities (m, 2) that `robots` (m,), or all N, should fly; 0 for failed ones.

        `positions` (N, 2) are true positions in model units, `moving` (N, 2) the present velocities
        in model units/s, None if all robots stand still.
        """


class Task(Protocol):
    """Training task: the expert to imitate, and the cost of a flight.

    Must support pickle.
    """

    @property
    def baselines(self) -> Sequence[BaselineName]:
        """Baselines in the model card, over the same worlds; may be empty."""

    def expert_name(self, data: DataConfig) -> str:
        """Name of the expert, for the model card."""

    def teacher(self, data: DataConfig, world: Preparation) -> Teacher:
        """Make the expert for a world."""

    def costs(self, flights: FlightGroup) -> list[tuple[PlannedFlight, CostCurve]]:
        """Fly them. Policies are selected by final cost over initial cost.

        Raises BundleError, ValueError, OSError.
        """


CLAIRVOYANT: BaselineName = "clairvoyant-cvt"
# Baselines in addition to the clairvoyant one.
BASELINES: tuple[BaselineName, ...] = ("decentralized-cvt", "decentralized-cvt-prior")


class CoverageTask(NamedTuple):
    """The paper's task: see `Task`."""

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
