"""Robust averages over seeds, with their confidence intervals, or the ranges of a few values."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import bootstrap

from torch_qpmpc.checks import check_number, check_seed, check_whole
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
        if self.few:
            return f"(range of {self.count}: {low} to {high})"
        return f"[{low}, {high}]"


def spread_name(counts: Iterable[int]) -> str:
    """Return the name of spreads of so many values each."""
    few = {count < FEWEST for count in counts}
    if few == {True}:
        return "range"
    return "95% interval" + (" (range of fewer than six)" if True in few else "")


def interquartile_mean(x: np.ndarray, axis: int = 0) -> np.ndarray:
    """Compute the mean of the middle half of the values along ``axis``.

    It uses more of the data than the median, and ignores outliers like the median.

    Args:
        x: the values ``(.., n, ..)``; unless n is a multiple of four, two are weighted in part.
        axis: the axis of n.

    Example:
        >>> import numpy as np
        >>> from torch_qpmpc.study.statistics import interquartile_mean
        >>> float(interquartile_mean(np.array([0.0, 1.0, 3.0, 1000.0])))
        2.0
    """
    try:
        ordered = np.sort(np.moveaxis(np.asarray(x, dtype=float), axis, -1), axis=-1)
    except ValueError as error:  # no numbers, or no such axis
        raise QPError.expected("x", f"{error}", f"numbers along axis {axis}") from error
    if not ordered.shape[-1]:
        raise QPError.expected("x", "no values", f"at least one along axis {axis}")
    n = ordered.shape[-1]
    edges = np.clip(np.arange(n + 1), n / 4, 3 * n / 4)
    return ordered @ np.diff(edges) / (n / 2)


def bootstrap_interval(
    strata: Sequence[np.ndarray],
    statistic: Callable[..., np.ndarray] = np.median,
    *,
    level: float = 0.95,
    resamples: int = 2000,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the stratified percentile bootstrap interval of a statistic of all runs.

    Each stratum, such as the seeds of one case, is resampled separately, so that every case keeps
    its number of runs. With fewer than about ten runs it is too short: see `spread`.

    Args:
        strata: arrays ``(n_i, ...)``.
        statistic: a function of an array and ``axis``.
        level: the level of confidence.
        resamples: number of resamples.
        seed: seed of the resampling.

    Returns:
        The lower and the upper end, each ``(...)``.

    Raises:
        QPError: a stratum is empty, or an argument is invalid.

    Example:
        >>> import numpy as np
        >>> from torch_qpmpc.study.statistics import bootstrap_interval
        >>> low, high = bootstrap_interval([np.full(5, 0.9), np.full(7, 0.9)])
        >>> float(low), float(high)
        (0.9, 0.9)
    """
    if isinstance(strata, np.ndarray) or not isinstance(strata, Sequence):
        got = type(strata).__name__
        raise QPError.expected("strata", got, "a list of arrays", "Pass [x] for a single stratum.")
    strata = [np.asarray(stratum) for stratum in strata]
    if any(s.ndim == 0 or s.shape[1:] != strata[0].shape[1:] for s in strata):
        shapes = [s.shape for s in strata]
        raise QPError.expected("strata", f"shapes {shapes}", "(n_i, ...) with ... the same for all")
    if not callable(statistic):
        raise QPError.expected("statistic", repr(statistic), "a function, such as numpy.median")
    check_number("level", level, lambda x: 0 < x < 1, "a level in (0, 1)", "95% is 0.95.")
    check_whole("resamples", resamples, 1)
    check_seed(seed)
    if not strata or not all(len(stratum) for stratum in strata):
        sizes = [len(stratum) for stratum in strata]
        raise QPError.expected("strata", f"sizes {sizes}", "at least one run in each")
    # scipy needs two runs per stratum: repeat a single run, and drop the copy in the statistic.
    doubled = [np.repeat(stratum, 1 + (len(stratum) == 1), axis=0) for stratum in strata]

    def of_all(*drawn: np.ndarray, axis: int) -> np.ndarray:
        runs = [x[..., : len(stratum)] for x, stratum in zip(drawn, strata, strict=True)]
        return statistic(np.concatenate(runs, axis=axis), axis=axis)

    low, high = bootstrap(
        doubled,
        of_all,
        confidence_level=level,
        n_resamples=resamples,
        method="percentile",
        rng=seed,
    ).confidence_interval
    return low, high


def spread(
    strata: Sequence[np.ndarray], statistic: Callable[..., np.ndarray] = np.median
) -> Spread:
    """Compute the 95% bootstrap interval of a statistic, or the range of few values.

    Args:
        strata: as in `bootstrap_interval`; the smallest one counts.
        statistic: a function of an array and ``axis``.

    Raises:
        QPError: as in `bootstrap_interval`.

    Example:
        >>> import numpy as np
        >>> from torch_qpmpc.study.statistics import spread
        >>> spread([np.array([0.7, 0.9, 0.8])]).text(".1f")
        '(range of 3: 0.7 to 0.9)'
    """
    low, high = bootstrap_interval(strata, statistic)
    together = np.concatenate([np.asarray(stratum) for stratum in strata])
    if few := min(map(len, strata)) < FEWEST:
        low, high = together.min(0), together.max(0)
    return Spread(low, high, len(together), few)
