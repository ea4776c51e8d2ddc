"""Robots' places in the flight: assigned by the ground, and reported by the robots."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace

from edge.messages.mission import Place, RobotStatus
from lpac.analysis.snapshot import FleetSetup

_AT_PLACE_M = 0.01


def with_places(
    setup: FleetSetup, places: Mapping[str, Place], names: Mapping[int, str]
) -> FleetSetup:
    """Apply a state's `places`, by robot id, to the setup."""
    if not places:
        return setup
    seated = {place.slot: (names.get(int(r), ""), place) for r, place in places.items()}
    slots = []
    for slot in setup.slots:
        robot, place = slot.robot, slot.place
        if slot.place.slot in seated:
            robot, place = seated[slot.place.slot]
        elif robot and str(setup.robots[robot]) in places:
            robot = ""  # It has moved to another slot.
        slots.append(replace(slot, place=place, robot=robot))
    return replace(setup, slots=tuple(slots))


def places_of(setup: FleetSetup, statuses: Iterable[RobotStatus]) -> dict[str, Place]:
    """Places of robots that do not have their configured one, by robot id."""
    configured = {setup.robots[s.robot]: s.place for s in setup.slots if s.robot}
    places = {}
    for status in statuses:
        above_m = status.slot_height_m - setup.base_height_m
        try:
            place = Place(max(0, round(above_m / setup.slot_spacing_m)), status.landing_point_m)
        except ValueError:  # It reports an invalid place.
            continue
        known = configured.get(status.robot_id)
        there = known is not None and (
            math.dist(status.landing_point_m, known.landing_point_m) < _AT_PLACE_M
        )
        if known is None or known.slot != place.slot or not there:
            places[str(status.robot_id)] = place
    return places
