"""Robust averages over seeds, with their confidence intervals, or the ranges of a few values."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import bootstrap

from torch_qpmpc.errors import QPError

#: Fewest values of an interval: of three normal ones, a median's of 95 % covers in 75 % of cases.
FEWEST = 6


class Spread(NamedTuple):
    """The ends of a 95% interval of ``count`` values, or of their range if they are ``few``."""

    low: np.ndarray
    high: np.ndarray
    count: int
    few: bool

    def text(self, digits: str = ".3f") -> str:
        """Format the ends: ``[0.1, 0.3]``, or ``(range of 3: 0.1 to 0.3)``."""
        low, high = (format(float(end), digits) for end in (self.low, self.high))
        return f"(range of {self.count}: {low} to {high})" if self.few else f"[{low}, {high}]"


def interquartile_mean(x: np.ndarray, axis: int = 0) -> np.ndarray:
    """Compute the mean of the middle half of the n values along ``axis``.

    Unless n is a multiple of four, two values are weighted in part.
    """
    ordered = np.sort(np.moveaxis(x, axis, -1), axis=-1)
    n = ordered.shape[-1]
    edges = np.clip(np.arange(n + 1), n / 4, 3 * n / 4)
    return ordered @ np.diff(edges) / (n / 2)


def spread(
    strata: Sequence[np.ndarray], statistic: Callable[..., np.ndarray] = np.median
) -> Spread:
    """Compute the 95% bootstrap interval of a statistic of all runs, or the range of few values.

    Each of the ``strata`` ``(n_i, ...)``, such as the seeds of one case, is resampled separately;
    the smallest n_i decides between interval and range. ``statistic`` has an ``axis``.
    """
    sizes, together = [len(stratum) for stratum in strata], np.concatenate(strata)
    if not all(sizes):
        raise QPError.expected("strata", f"sizes {sizes}", "at least one run in each")
    if min(sizes) < FEWEST:
        return Spread(together.min(0), together.max(0), len(together), True)

    def of_all(*drawn: np.ndarray, axis: int) -> np.ndarray:
        return statistic(np.concatenate(drawn, axis=axis), axis=axis)

    interval = bootstrap(strata, of_all, n_resamples=2000, method="percentile", rng=0)
    return Spread(*interval.confidence_interval, len(together), False)
