"""Code for the robot's own Python: 3.6 or newer, the standard library alone.

Nothing of it is installed: each session sends it over SSH (`lpac.fleet.session`).
"""
