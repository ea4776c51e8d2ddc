"""PX4's own log (ULog), topic by topic."""

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy.typing as npt
from pyulog import ULog
from pyulog.exceptions import ULogException

# By the name of a field: its values, in the order in which they were logged.
Topic = dict[str, npt.NDArray[Any]]


def read_topics(path: Path, names: Sequence[str]) -> dict[str, Topic]:
    """Topics of these names, of their first instances.

    A log that ends in the middle, as of a PX4 that was killed, is read as far as it goes; one that
    is not there, or is no log, holds nothing.
    """
    try:
        with path.open("rb") as file:
            log = ULog(file, [*names])
    except (OSError, ULogException, struct.error):
        # Not even its beginning was written.
        return {}
    return {data.name: data.data for data in log.data_list if data.multi_id == 0}
