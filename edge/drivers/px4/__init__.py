"""PX4 over MAVLink: autopilot, telemetry, events, watchdog."""
