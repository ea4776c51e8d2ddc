"""The same for many robots at once: none waits for another, and every one has an outcome."""

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from typing import Generic, NamedTuple, TypeVar

from lpac.fleet.session import FleetError
from lpac.fleet.settings import RobotHost

T = TypeVar("T")


class Outcome(NamedTuple, Generic[T]):
    """Outcome for one robot: a value, or why there is none.

    `interrupted`: Ctrl-C came before it was done.
    """

    robot: RobotHost
    value: T | None
    problem: str | None
    interrupted: bool = False


async def for_each(
    robots: Sequence[RobotHost],
    task: Callable[[RobotHost], Awaitable[T]],
    on_outcome: Callable[[Outcome[T]], None] = lambda _: None,
) -> list[Outcome[T]]:
    """Do `task` with all robots side by side; the outcomes in the robots' order."""

    async def one(robot: RobotHost) -> Outcome[T]:
        try:
            outcome = Outcome(robot, await task(robot), None)
        except (FleetError, ValueError, OSError) as error:
            outcome = Outcome[T](robot, None, " ".join(str(error).split()))
        except LookupError as error:
            outcome = Outcome[T](robot, None, f"its answer lacks something: {error!r}")
        on_outcome(outcome)
        return outcome

    # Not gather, which on Ctrl-C waits for the first session alone to be ended in order.
    async with asyncio.TaskGroup() as group:
        tasks = [group.create_task(one(robot)) for robot in robots]
    return [task.result() for task in tasks]
