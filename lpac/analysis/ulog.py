"""Reads PX4's log (ULog) by topic."""

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy.typing as npt
from pyulog import ULog
from pyulog.exceptions import ULogException

# Values of each field by name, in the order of the log.
Topic = dict[str, npt.NDArray[Any]]


def read_topics(path: Path, names: Sequence[str]) -> dict[str, Topic]:
    """Read the first instances of these topics.

    A truncated log, for example of a killed PX4, is read as far as possible; a missing or invalid
    one gives nothing.
    """
    try:
        with path.open("rb") as file:
            log = ULog(file, [*names])
    except (OSError, ULogException, struct.error):
        # Not even the header is complete.
        return {}
    return {data.name: data.data for data in log.data_list if data.multi_id == 0}
