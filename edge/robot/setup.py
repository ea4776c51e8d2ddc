"""Set up a vehicle once: its system id and failsafe parameters.

Parameters that take effect after a reboot are set here, too.
"""

import time
from collections.abc import Sequence
from typing import NamedTuple

from edge.core.ports import Vehicle, VehicleSetup
from edge.core.vehicle import VehicleState
from edge.flight.failsafe import Requirement, check

_SYSTEM_ID = "MAV_SYS_ID"
# PX4 sends heartbeats at 1 Hz, so this also detects a second vehicle on the link.
_LISTEN_S = 2.5
_PERIOD_S = 0.1


class SetupError(OSError):
    """Failure to set up the vehicle; one line with the cause and the remedy."""


class SetupReport(NamedTuple):
    """Outcome of setting up the vehicle that answers as `system_id`.

    `changes` are the parameters that were set, `problems` those still wrong. With `needs_reboot`,
    some changes take effect only when the autopilot restarts.
    """

    system_id: int
    changes: tuple[str, ...]
    problems: tuple[str, ...]
    needs_reboot: bool


def set_up(
    autopilot: Vehicle,
    setup: VehicleSetup,
    requirements: Sequence[Requirement],
    system_id: int,
    wait_s: float,
) -> SetupReport:
    """Set the wrong parameters of the one vehicle that is received within `wait_s`.

    Raises SetupError if there is none, or more than one, or if it is not disarmed; OSError if it
    falls silent or refuses.
    """
    answers_as = _only_vehicle(autopilot, wait_s)
    names = [requirement.name for requirement in requirements]
    before = setup.read_parameters([*names, _SYSTEM_ID])
    changes = []
    needs_reboot = answers_as != system_id
    for requirement in requirements:
        value = before[requirement.name]
        if value is None or requirement.problem(value) is None:
            continue
        wanted = requirement.value_to_set
        if wanted is None:
            # Takes effect after a reboot; the first allowed value is the best.
            wanted, needs_reboot = requirement.values[0], True
        _refuse_unless_disarmed(autopilot.state())
        setup.set_parameter(requirement.name, wanted)
        changes.append(f"{requirement.name} from {value:g} to {wanted:g}")
    # Last: an autopilot that takes it at once no longer answers as the same vehicle.
    own = before[_SYSTEM_ID]
    if own != system_id:
        _refuse_unless_disarmed(autopilot.state())
        after = setup.read_parameters(names)
        setup.set_parameter(_SYSTEM_ID, system_id)
        changes.append(f"{_SYSTEM_ID} from {own} to {system_id}")
    else:
        after = setup.read_parameters(names) if changes else before
    return SetupReport(answers_as, tuple(changes), check(tuple(requirements), after), needs_reboot)


def _only_vehicle(autopilot: Vehicle, wait_s: float) -> int:
    until_s = time.monotonic() + wait_s
    connected_at_s = None
    while True:
        now_s = time.monotonic()
        state = autopilot.state()
        if state.connected and connected_at_s is None:
            connected_at_s = now_s
        if connected_at_s is None and now_s > until_s:
            raise SetupError(
                f"no autopilot connected within {wait_s:g} s: check its power, and the program "
                "that forwards its MAVLink"
            )
        if connected_at_s is not None and now_s - connected_at_s > _LISTEN_S:
            break
        time.sleep(_PERIOD_S)
    assert state.system_id is not None
    if state.other_system_ids:
        ids = ", ".join(map(str, sorted({state.system_id, *state.other_system_ids})))
        raise SetupError(
            f"more than one vehicle is on this link (system ids {ids}): disconnect all but the one "
            "to set up"
        )
    _refuse_unless_disarmed(state)
    return state.system_id


def _refuse_unless_disarmed(state: VehicleState) -> None:
    if not state.connected or state.armed is not False:
        word = "armed" if state.connected and state.armed else "not known to be disarmed"
        raise SetupError(f"the vehicle is {word}: nothing was set; disarm it first")
