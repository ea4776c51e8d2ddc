"""Flights over a Ray cluster: its nodes have the same installation, and the bundle at its path."""

import socket
from collections.abc import Iterator, Sequence

import ray

from lpac.sim.drill.campaign import FlightOutcome, FlightTask, Pool, fly_order

_ANSWERS_WITHIN_S = 5.0


def over_ray(address: str) -> Pool:
    """A pool of all cores of the cluster at `address`: HOST:PORT, or what `ray.init` takes.

    Raises ConnectionError if nobody listens there.
    """
    host, _, port = address.rpartition(":")
    if host and port.isdigit():
        # Ray would try for minutes.
        try:
            socket.create_connection((host, int(port)), _ANSWERS_WITHIN_S).close()
        except OSError as error:
            raise ConnectionError(f"no Ray cluster at {address}: {error}") from None

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
