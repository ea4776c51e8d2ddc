"""The workstation: simulators, ground control, analysis, deployment, and the `lpac` command."""
