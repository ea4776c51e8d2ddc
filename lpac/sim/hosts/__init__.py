"""Robot computers on this machine: containers with a system, an SSH server and a vehicle each."""
