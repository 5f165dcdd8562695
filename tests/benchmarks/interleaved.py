"""Interleaved timing of two functions, so that other load does not affect their ratio."""

import time
from collections.abc import Callable
from statistics import median
from typing import Any

import torch


class Interleaved:
    """pytest-benchmark's pedantic mode, with rounds of a reference in between."""

    def __init__(self, benchmark: Any) -> None:
        self._benchmark = benchmark

    def run(
        self,
        timed: Callable[[], Any],
        *,
        rounds: int,
        warmup: int = 1,
        before: Callable[[], Any] | None = None,
        reference: Callable[[], Any] | None = None,
        every: int = 1,
    ) -> Any:
        """Time ``timed`` in ``rounds`` rounds after ``warmup`` untimed ones.

        ``before`` is called before each round, untimed, and before that, in each ``every``-th
        round, the single-threaded ``reference``, whose median goes into the row as
        ``reference_seconds``.

        Returns:
            What ``timed`` returned last.
        """
        seconds: list[float] = []
        done = -warmup

        def setup() -> None:
            nonlocal done
            torch.set_num_threads(1)
            if reference is not None and done >= 0 and done % every == 0:
                began = time.perf_counter()
                reference()
                seconds.append(time.perf_counter() - began)
            done += 1
            if before is not None:
                before()

        result = self._benchmark.pedantic(timed, setup=setup, rounds=rounds, warmup_rounds=warmup)
        if seconds:
            self._benchmark.extra_info["reference_seconds"] = median(seconds)
        return result
