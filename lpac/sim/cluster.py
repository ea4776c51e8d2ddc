"""Tasks over a Ray cluster: its nodes have the same installation, and each file at its path."""

import socket
from collections.abc import Callable, Generator, Sequence

import ray

from edge.core.address import host_and_port
from lpac.sim.cores import Outcome, Pool, Task

_ANSWERS_WITHIN_S = 5.0


def over_ray(address: str) -> Pool:
    """A pool of all cores of the cluster at `address`: HOST:PORT, or what `ray.init` takes.

    Raises ConnectionError if nothing listens there, ValueError for an invalid host.
    """
    found = host_and_port("--ray", address)
    if found is not None:
        # Ray itself would retry for minutes.
        try:
            socket.create_connection(found, _ANSWERS_WITHIN_S).close()
        except OSError as error:
            raise ConnectionError(f"no Ray cluster at {address}: {error}") from None

    def pool(
        do: Callable[[Task], Outcome], tasks: Sequence[Task]
    ) -> Generator[Outcome, None, None]:
        ray.init(address=address, log_to_driver=False, ignore_reinit_error=True)
        try:
            # The tasks of a lost node are run again elsewhere.
            remote = ray.remote(num_cpus=1, max_retries=3)(do)
            given = [remote.remote(task) for task in tasks]
            while given:
                [done], given = ray.wait(given, num_returns=1)
                outcome: Outcome = ray.get(done)
                yield outcome
        finally:
            ray.shutdown()

    return pool
