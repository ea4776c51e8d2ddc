"""Lands a vehicle whose program is gone, at the word of whoever has a link to its computer."""

import contextlib
import socket
import time
from typing import Any, Dict

from edge.drivers.px4.raw_mavlink import land_command
from lpac.fleet.on_robot import service
from lpac.fleet.on_robot.calls import Refused, call, say

# Where PX4's sticks fly the vehicle.
_PILOTED = ("manual", "stabilized", "altitude", "position")
# PX4 tells its mode once a second.
_ANSWER_S = 8.0
_COMPONENT = 198  # beside the robot's program and its watchdog


@call
def land(mavlink_port: int, system_id: int) -> Dict[str, Any]:
    """Let PX4 land where it is; `mode` is PX4's then, by its own heartbeat.

    Refused while the program runs, and while a pilot flies: neither is to be fought with.
    """
    state = service.service()
    if state["fresh"]:
        raise Refused(
            "its program runs: `lpac mission land` lands it, in pilot after `lpac mission rejoin`"
        )
    say("listens to PX4")
    beat = service.hear_heartbeat(mavlink_port)
    if beat is None:
        raise Refused("nothing is heard of PX4 at UDP port %d" % mavlink_port)
    if beat["system_id"] != system_id:
        raise Refused(
            "PX4 is system %d, not %d: mend the fleet file" % (beat["system_id"], system_id)
        )
    if not beat["armed"]:
        raise Refused("it is disarmed: nothing is to land")
    if beat["mode"] in _PILOTED:
        raise Refused("a pilot flies it (%s): he lands it" % beat["mode"])
    say("lands it")
    with contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as udp:
        # As the robot's program, whose port PX4's side may know; one that hangs still has it.
        with contextlib.suppress(OSError):
            udp.bind(("0.0.0.0", mavlink_port))
        until_s, sequence = time.monotonic() + _ANSWER_S, 0
        while beat["armed"] and beat["mode"] != "land":
            if time.monotonic() > until_s:
                raise Refused("it does not land, and is in %s: a pilot must take it" % beat["mode"])
            sequence += 1
            udp.sendto(land_command(sequence, system_id, _COMPONENT), beat["sender"])
            beat = service.hear_heartbeat(mavlink_port) or beat
    return {"mode": beat["mode"], "armed": beat["armed"]}
