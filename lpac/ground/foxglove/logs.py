"""`lpac foxglove log`: convert a ground's log to an MCAP file of Foxglove's own messages."""

from collections.abc import Callable, Sequence
from pathlib import Path

from foxglove import Context, open_mcap

from edge.drivers.log_reader import read
from lpac.ground.foxglove.channels import Channels
from lpac.ground.foxglove.view import FoxgloveView


def ground_logs(folder: Path) -> list[Path]:
    """Find the ground's logs below a folder, in order. Raises ValueError if there are none."""
    if not folder.is_dir():
        raise ValueError(f"{folder}: is not a folder")
    paths = sorted(path for path in folder.rglob("ground-*.mcap") if path.is_file())
    if not paths:
        raise ValueError(
            f"{folder}: has no ground's log (ground-*.mcap): `lpac record` writes one; Foxglove "
            "opens a robot's own log, robot-*.mcap, directly"
        )
    return paths


def convert(paths: Sequence[Path], out: Path, progress: Callable[[int], None]) -> None:
    """Write the messages that a live view would show; `progress` gets the number of files done.

    Raises FlightLogError for a file that is not a log, or OSError.
    """
    context = Context()
    channels, view = Channels(context), FoxgloveView()
    with out.open("wb") as file, open_mcap(file, context=context):
        for number, path in enumerate(paths, 1):
            for topic, unix_time_s, message in read(path):
                for shown in (*view.take(topic, unix_time_s, message), *view.tick(unix_time_s)):
                    channels.publish(shown)
            progress(number)
