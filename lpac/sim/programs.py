"""The programs of this project that the simulator starts beside itself."""

import sys


def python_program(module: str, *arguments: str) -> list[str]:
    """The command line that runs a module as a program, in this Python.

    Whatever lies in the working directory, a folder `edge` of the user's own too, it is this
    project that runs: -P keeps that directory out of the modules' path.
    """
    return [sys.executable, "-P", "-m", module, *arguments]
