"""Concurrent tasks on several robots, one outcome per robot."""

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from typing import Generic, NamedTuple, TypeVar

from lpac.fleet.session import FleetError
from lpac.fleet.settings import RobotHost

T = TypeVar("T")


class Outcome(NamedTuple, Generic[T]):
    """Result for one robot: a value or a `problem`. `interrupted`: by Ctrl-C."""

    robot: RobotHost
    value: T | None
    problem: str | None
    interrupted: bool = False


async def for_each(
    robots: Sequence[RobotHost],
    task: Callable[[RobotHost], Awaitable[T]],
    on_outcome: Callable[[Outcome[T]], None] = lambda _: None,
) -> list[Outcome[T]]:
    """Run `task` for all robots concurrently; return the outcomes in the robots' order."""

    async def one(robot: RobotHost) -> Outcome[T]:
        try:
            outcome = Outcome(robot, await task(robot), None)
        except (FleetError, ValueError, OSError) as error:
            outcome = Outcome[T](robot, None, " ".join(str(error).split()))
        except LookupError as error:
            outcome = Outcome[T](robot, None, f"its answer lacks something: {error!r}")
        on_outcome(outcome)
        return outcome

    # On Ctrl-C a task group awaits all sessions; gather awaits only the first.
    async with asyncio.TaskGroup() as group:
        tasks = [group.create_task(one(robot)) for robot in robots]
    return [task.result() for task in tasks]
