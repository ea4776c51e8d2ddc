"""Run a program without real-time priority; it ends with its parent.

`python -I lpac/sim/sitl/ordinary.py PARENT PROGRAM ...`, where PARENT is the id of the parent
process. As root PX4 gives its threads real-time priority, and starves all else on the machine.
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
    # An ordinary user lacks the capability, and may not drop it, but may have an RLIMIT_RTPRIO.
    prctl(_PR_CAPBSET_DROP, _CAP_SYS_NICE, 0, 0, 0)
    resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
    prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:
        sys.exit(f"{command[0]}: the parent process has ended")
    try:
        os.execv(command[0], command)
    except OSError as error:
        sys.exit(f"{command[0]}: {error.strerror}")


if __name__ == "__main__":
    _become(int(sys.argv[1]), sys.argv[2:])
