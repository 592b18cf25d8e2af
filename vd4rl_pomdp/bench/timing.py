"""Seconds of calls, measured so that a noisy machine cannot bend their ratios much."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import torch


def seconds_of(function: Callable[[], Any], repeats: int) -> float:
    """Median seconds of a call, after one that is not counted."""
    times = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        function()
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    return statistics.median(times[1:])


def alternating(rounds: int, *functions: Callable[[], Any]) -> list[float]:
    """Median seconds of each function, called in turns: a machine that slows down slows all of them."""
    times = [[seconds_of(function, 1) for function in functions] for _ in range(rounds)]
    return [statistics.median(column) for column in zip(*times, strict=True)]


def rate(function: Callable[[], Any], count: int) -> float:
    """Calls per CPU-second, after some that are not counted."""
    for _ in range(5):
        function()
    start = time.process_time()
    for _ in range(count):
        function()
    return count / (time.process_time() - start)
