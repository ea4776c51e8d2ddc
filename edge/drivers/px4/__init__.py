"""PX4 by MAVLink: autopilot, telemetry, events, watchdog."""
