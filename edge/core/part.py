"""Describe errors of third-party policies and sensors in one line for their author."""

import traceback

import numpy as np


class PartError(ValueError):
    """Failure of a part of the robot, such as its policy or sensor; the text is for people."""


def in_one_line(error: Exception) -> str:
    """Describe an exception, and the last line in the part's own package that led to it.

    Returns the text of a PartError unchanged.
    """
    if isinstance(error, PartError):
        return str(error)
    text = " ".join(f"{type(error).__name__}: {error}".removesuffix(": ").split())
    places = [
        (*frame.f_code.co_filename.rpartition("/")[::2], line)
        for frame, line in traceback.walk_tb(error.__traceback__)
    ]
    # The first frame is our caller's. Frames of libraries, such as numpy, help the author less.
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
