"""Drivers: implementations of `edge.core.ports` for real hardware, networks and disks."""
