"""The times of rows: dates and numbers in seconds, the time of a step, and gaps."""

from __future__ import annotations

import contextlib
import warnings
from typing import Any

import numpy as np
import pandas as pd

from torch_qpmpc.errors import QPError

#: FEWEST steps in a row have another sampling time if their mean differs from the log's by more
#: than the share ONE_DT; a clock is coarse if more than that share of rows repeat a time.
FEWEST, ONE_DT = 10, 0.1
#: The steps over which a coarse clock is read, if a trajectory has that many.
SPANS = (60, 12, 1)


def seconds(column: pd.Series, day_first: bool | None) -> np.ndarray:
    """Return a column of times, dates in seconds."""
    name = str(column.name)
    if isinstance(column.dtype, pd.PeriodDtype):
        column = column.dt.to_timestamp()
    ways = [column]
    if column.dtype.kind not in "mM":
        numbers: Any = pd.to_numeric(column, errors="coerce")
        if numbers.notna().any():
            return np.asarray(numbers, dtype=float)
        ways = _dates(column, day_first)
    if not ways or column.isna().all():
        got = f"{name} with {str(column.iloc[0])!r}"
        raise QPError.expected("time", got, "numbers or dates of one format")
    times = [(dates - dates.min()).dt.total_seconds().to_numpy() for dates in ways]
    if len(times) == 1 or np.array_equal(*map(np.diff, times), equal_nan=True):
        return times[0]
    changes = [np.diff(x) for x in times]
    uneven = [np.abs(x - np.nanmedian(x)) / (abs(np.nanmedian(x)) or 1.0) for x in changes]
    day, month = map(np.nanmean, uneven)
    text = (
        f"The dates in {name} may begin with the day or the month: its steps are more even if it "
        f"is the {'day' if day <= month else 'month'}. Pass day_first={day <= month} if that is so."
    )
    warnings.warn(text, UserWarning, stacklevel=4)
    return times[int(day > month)]


def _dates(column: pd.Series, day_first: bool | None) -> list[pd.Series]:
    """Return the dates in each way that they can be read."""
    dates = []
    ways: list[Any] = [{"format": "ISO8601"}]
    ways += [{"dayfirst": x} for x in (True, False) if day_first in (x, None)]
    for way in ways:
        with contextlib.suppress(ValueError, TypeError), warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # on dates that need no guess
            dates.append(pd.to_datetime(column, utc=True, **way))
            if "format" in way:
                break
    return dates


def gaps_of(
    times: np.ndarray | None, inside: np.ndarray, marks: np.ndarray
) -> tuple[np.ndarray, float | None]:
    """Return True for the steps of a trajectory across a gap, and the time of the other steps."""
    if times is None or not inside.any():
        return np.zeros_like(inside), None
    change = np.where(inside, np.diff(times), np.nan)
    tick = 0.0
    if (change == 0).sum() > ONE_DT * inside.sum():  # a clock that shows whole seconds, say
        tick = np.min(change[change > 0], initial=np.inf)
    for lag in SPANS if tick else (1,):
        apart = (times[lag:] - times[:-lag])[marks[lag:] == marks[:-lag]]
        if len(apart):
            break
    dt = float(np.nanmedian(apart) / lag)
    if not 0 < dt < np.inf:
        raise QPError.expected("time", f"steps of {dt:g}", "times that increase", "Sort the rows.")
    gaps = inside & ~(np.abs(change - dt) <= 0.5 * dt + tick)
    if len(change) >= FEWEST:
        rows = np.lib.stride_tricks.sliding_window_view(change, FEWEST)
        own = rows.mean(1)
        even = (np.abs(rows - own[:, None]) <= 0.5 * own[:, None] + tick).all(1)
        off = np.where(even, np.abs(own - dt), 0)
        if off.max() > ONE_DT * dt + tick / FEWEST:
            row = int(np.argmax(off > 0.99 * off.max()))
            got = f"steps of {own[row]:g} from row {row} on, and of {dt:g} in the median"
            raise QPError.expected("time", got, "one sampling time", "Resample the data.")
    return gaps, dt
