"""Becomes a program without real-time priority, which ends with the one that started it.

`python -I lpac/sim/sitl/ordinary.py PARENT PROGRAM ...`, PARENT being the id of who starts it. PX4
makes its threads real-time ones where it may, as root may, and starves all else on the machine.
"""

import ctypes
import os
import resource
import signal
import sys

_PR_SET_PDEATHSIG = 1
_PR_CAPBSET_DROP = 24
_CAP_SYS_NICE = 23


def _become(parent: int, command: list[str]) -> None:
    prctl = ctypes.CDLL(None, use_errno=True).prctl
    # Who may not drop it, an ordinary user, does not have it; but may have been given priorities.
    prctl(_PR_CAPBSET_DROP, _CAP_SYS_NICE, 0, 0, 0)
    resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
    prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:
        sys.exit(f"{command[0]}: who started it has ended")
    try:
        os.execv(command[0], command)
    except OSError as error:
        sys.exit(f"{command[0]}: {error.strerror}")


if __name__ == "__main__":
    _become(int(sys.argv[1]), sys.argv[2:])
