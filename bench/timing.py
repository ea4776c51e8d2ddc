"""Timing: variants in turn in one process, or each run in its own process."""

import gc
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from time import perf_counter
from typing import ParamSpec, TypeVar

import numpy as np

from edge.core import F64

_WARM_UP_CALLS = 10
_P = ParamSpec("_P")
_T = TypeVar("_T")


def interleaved(
    variants: Mapping[str, Callable[[], object]], rounds: int, round_s: float
) -> dict[str, F64]:
    """Seconds per call of each variant, (rounds,), taken in turn: A B C A B C ...

    In each round a variant is called for about `round_s`.
    """
    calls = {}
    for name, call in variants.items():
        _seconds_per_call(call, _WARM_UP_CALLS)
        calls[name] = max(1, round(round_s / _seconds_per_call(call, _WARM_UP_CALLS)))
    times = {name: np.empty(rounds) for name in variants}
    gc.disable()
    try:
        for i in range(rounds):
            for name, call in variants.items():
                times[name][i] = _seconds_per_call(call, calls[name])
    finally:
        gc.enable()
    return times


def in_own_process(run: Callable[_P, _T], *args: _P.args, **kwargs: _P.kwargs) -> _T:
    """Call `run` in a fresh process, without memory of other runs; return its result."""
    with ProcessPoolExecutor(max_workers=1, mp_context=get_context("spawn")) as process:
        return process.submit(run, *args, **kwargs).result()


def quartiles(values: F64 | list[float]) -> dict[str, float]:
    """Median and quartiles."""
    q1, median, q3 = np.percentile(values, (25, 50, 75))
    return {"median": float(median), "q1": float(q1), "q3": float(q3)}


def with_quartiles(figure: Mapping[str, float], digits: int = 2) -> str:
    """`quartiles` as text."""
    return f"{figure['median']:.{digits}f} ({figure['q1']:.{digits}f} - {figure['q3']:.{digits}f})"


def _seconds_per_call(call: Callable[[], object], calls: int) -> float:
    start_s = perf_counter()
    for _ in range(calls):
        call()
    return (perf_counter() - start_s) / calls
