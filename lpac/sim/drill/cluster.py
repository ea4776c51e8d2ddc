"""Flights over a Ray cluster: its nodes have the same installation, and the bundle at its path."""

from collections.abc import Iterator, Sequence

import ray

from lpac.sim.drill.campaign import FlightOutcome, FlightTask, Pool, fly_order


def over_ray(address: str) -> Pool:
    """A pool of all cores of the cluster at `address`. Raises ConnectionError if there is none."""

    def pool(orders: Sequence[FlightTask]) -> Iterator[FlightOutcome]:
        ray.init(address=address, log_to_driver=False, ignore_reinit_error=True)
        try:
            # A lost node costs the flights that it was flying: others fly them again.
            fly = ray.remote(num_cpus=1, max_retries=3)(fly_order)
            flights = [fly.remote(order) for order in orders]
            while flights:
                [flown], flights = ray.wait(flights, num_returns=1)
                yield ray.get(flown)
        finally:
            ray.shutdown()

    return pool
