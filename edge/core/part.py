"""Errors and results of another package's code, as one line for its author."""

import traceback

import numpy as np


class PartError(ValueError):
    """A part of the robot, such as its policy or sensor, failed; the text is for people."""


def in_one_line(error: Exception) -> str:
    """Describe an exception, and the line of the package's own code that led to it.

    A PartError has its text already.
    """
    if isinstance(error, PartError):
        return str(error)
    text = " ".join(f"{type(error).__name__}: {error}".removesuffix(": ").split())
    places = [
        (*frame.f_code.co_filename.rpartition("/")[::2], line)
        for frame, line in traceback.walk_tb(error.__traceback__)
    ]
    # The first place is the caller. Code below the package, such as numpy, says less to its author.
    called = places[1:]
    if not called:
        return text
    package = called[0][0]
    folder, file, line = [place for place in called if place[0].startswith(package)][-1]
    return f"{text} ({folder.rpartition('/')[2]}/{file}, line {line})"


def array_problem(name: str, values: object, shape: tuple[int, ...]) -> str:
    """Why a part's array is invalid; "" if it has the shape and is finite."""
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "fiub":
        what = f"{values.dtype}s" if isinstance(values, np.ndarray) else type(values).__name__
        return f"{name} is of type {what}: must be a numpy array of floats, of shape {shape}"
    if values.shape != shape:
        return f"{name} has shape {values.shape}: must be {shape}"
    return "" if np.isfinite(values).all() else f"{name} has values that are not finite"
