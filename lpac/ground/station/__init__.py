"""The one process that speaks to the fleet: station, commands, its protocol, server and clients."""
