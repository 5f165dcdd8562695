"""Robust averages over seeds, and how sure they are."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from torch_qpmpc.errors import QPError


def interquartile_mean(x: np.ndarray, axis: int = 0) -> np.ndarray:
    """The mean of the middle half along ``axis``: of an order statistic, the part that lies there.

    It uses more of the data than the median, and like it does not see a few outliers.

    Args:
        x: ``(.., n, ..)``; where n is no multiple of four, two values count in part.

    Example:
        >>> import numpy as np
        >>> from torch_qpmpc.statistics import interquartile_mean
        >>> float(interquartile_mean(np.array([0.0, 1.0, 3.0, 1000.0])))
        2.0
    """
    ordered = np.sort(np.moveaxis(np.asarray(x, dtype=float), axis, -1), axis=-1)
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
    """The stratified percentile bootstrap interval of a statistic of all runs.

    Each stratum, as the seeds of one case, is resampled by itself, so that every case keeps its
    number of runs.

    Args:
        strata: arrays ``(n_i, ...)``.
        statistic: of an array, along ``axis``.
        level: of confidence.
        resamples, seed: of the bootstrap.

    Returns:
        The lower and the upper end, each ``(...)``.

    Raises:
        QPError: a stratum is empty.

    Example:
        >>> import numpy as np
        >>> from torch_qpmpc.statistics import bootstrap_interval
        >>> low, high = bootstrap_interval([np.full(5, 0.9), np.full(7, 0.9)])
        >>> float(low), float(high)
        (0.9, 0.9)
    """
    if not strata or not all(len(stratum) for stratum in strata):
        sizes = [len(stratum) for stratum in strata]
        raise QPError.expected("strata", f"sizes {sizes}", "at least one run in each")
    rng = np.random.default_rng(seed)
    drawn = [
        np.asarray(stratum)[rng.integers(len(stratum), size=(resamples, len(stratum)))]
        for stratum in strata
    ]
    values = statistic(np.concatenate(drawn, axis=1), axis=1)
    low, high = np.quantile(values, [(1 - level) / 2, (1 + level) / 2], axis=0)
    return low, high
