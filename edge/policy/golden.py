"""Golden outputs: torch's, computed in float64, in a bundle's npz file."""

import io
import zipfile
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from edge.core import F32
from edge.core.part import in_one_line
from edge.policy.bundle import BundleError
from edge.policy.family import GoldenCheck

GOLDEN = "golden.npz"
# The shipped policy's unpack to 0.3 MB.
_MAX_BYTES = 2**24

Arrays = Mapping[str, npt.NDArray[Any]]


def checks_of(
    file: bytes, checks: Callable[[Arrays], Iterator[GoldenCheck]]
) -> Iterator[GoldenCheck]:
    """Checks of the file's arrays by name.

    Raises BundleError if the file cannot be read or does not fit the policy.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(file)) as archive:
            size = sum(info.file_size for info in archive.infolist())
        if size > _MAX_BYTES:
            raise BundleError(
                f"{GOLDEN}: unpacks to {size} bytes; at most {_MAX_BYTES} are allowed"
            )
        yield from checks(dict(np.load(io.BytesIO(file), allow_pickle=False)))
    except KeyError as error:
        raise BundleError(f"{GOLDEN}: {error} is missing") from None
    except Exception as error:
        if isinstance(error, BundleError):
            raise
        raise BundleError(f"{GOLDEN}: does not fit the graphs: {in_one_line(error)}") from None


def relative_error(output: F32, golden: F32) -> float:
    """The largest error of a row over the row's largest value or a third of the overall largest.

    The row's value shows a weight that affects few rows. The third of the overall value keeps out
    rows that are mostly rounding because their parts cancel.
    """
    if golden.size == 0:
        return 0.0 if output.shape == golden.shape else float("inf")
    errors, sizes = (
        np.abs(values).reshape(len(golden), -1).max(axis=1)
        for values in (output.astype(np.float64) - golden, golden)
    )
    scales = np.maximum(sizes, sizes.max() / 3.0)
    with np.errstate(divide="ignore"):  # outputs of zero: any error is infinite
        ratios = np.divide(errors, scales, out=np.zeros_like(errors), where=errors != 0.0)
    return float(ratios.max())
