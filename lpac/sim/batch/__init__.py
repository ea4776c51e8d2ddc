"""A simulator of many point robots in many worlds at once, for training and sweeps."""

from lpac.sim.batch.agents import PolicyFailedError as PolicyFailedError
from lpac.sim.batch.flights import BatchedFlights as BatchedFlights
from lpac.sim.batch.flights import BatchMoment as BatchMoment
from lpac.sim.batch.flights import PolicyInputs as PolicyInputs
from lpac.sim.batch.flights import fly_batch as fly_batch
