"""`lpac foxglove log`: a ground's log as an MCAP file with Foxglove's own messages."""

from collections.abc import Callable, Sequence
from pathlib import Path

from foxglove import Context, open_mcap

from lpac.analysis.log_reader import read
from lpac.ground.foxglove.channels import Channels
from lpac.ground.foxglove.view import FoxgloveView


def ground_logs(folder: Path) -> list[Path]:
    """The ground's logs below a folder, in their order. Raises ValueError if there are none."""
    if not folder.is_dir():
        raise ValueError(f"{folder}: is not a folder")
    paths = sorted(path for path in folder.rglob("ground-*.mcap") if path.is_file())
    if not paths:
        raise ValueError(
            f"{folder}: holds no log of a ground (ground-*.mcap): `lpac record` writes one; a "
            "robot's own log, robot-*.mcap, Foxglove opens as it is"
        )
    return paths


def convert(paths: Sequence[Path], out: Path, progress: Callable[[int], None]) -> None:
    """Write what Foxglove would have been shown live; `progress` is told the number of files done.

    Raises FlightLogError for a file that is no log, OSError for one that cannot be read or written.
    """
    context = Context()
    channels, view = Channels(context), FoxgloveView()
    with out.open("wb") as file, open_mcap(file, context=context):
        for number, path in enumerate(paths, 1):
            for topic, unix_time_s, message in read(path):
                for shown in (*view.take(topic, unix_time_s, message), *view.tick(unix_time_s)):
                    channels.publish(shown)
            progress(number)
