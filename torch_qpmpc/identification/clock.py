"""The times of rows: what a column of times means, the time of a step, and gaps.

A column may have several readings: 20260301 is a number or a day, 10:30 has hours or minutes, and
02/03 is in March or in February. The reading with the most even steps counts.
"""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from torch_qpmpc.errors import QPError

#: FEWEST steps in a row have another sampling time if their mean differs from the log's by more
#: than the share ONE_DT; a clock is coarse if more than that share of rows repeat a time.
FEWEST, ONE_DT = 10, 0.1
#: The steps over which a coarse clock is read, if a trajectory has that many.
SPANS = (60, 12, 1)
#: From FEWEST gaps on, which are more than this share of the steps, a warning tells of them.
CUT = 0.01
#: Two readings are equally even if their measures differ by less.
SAME = 1e-6
#: Days in digits, their formats, and whether such numbers are hardly anything else.
DAYS = (("yyyymmdd", "%Y%m%d", True), ("yyyyddd", "%Y%j", True), ("yymmdd", "%y%m%d", False))
#: The pairs of digits of a time of day, the seconds of each, and the first that it cannot be.
CLOCKED, PAIRS = "HHMMSS", ((3600, 25), (60, 60), (1, 60))
DAY, HOUR = 86400.0, 3600.0
CLOCK = r"(?i)^(\d+):(\d\d)(?::(\d\d))?(?:[.,](\d+))?(?:\s*([ap])\.?m\.?)?$"
#: What no date has; pandas reads much else as a time difference.
DIFFERENCE = r"\d\s*(?:days?|hours?|min|minutes?|seconds?|[dhms]|ms|us|ns)\b|^-?P\d"
#: Midnight as the end of a day.
MIDNIGHT = r"(?<![\d:])24:00(?::00(?:\.0+)?)?(?![\d:])"
#: The name of the reading of numbers as what they are.
NUMBERS = "numbers"


class Reading(NamedTuple):
    """A reading of a column: its name and times, in seconds except for plain numbers.

    A clock without days starts again after a ``period``. A ``guess`` may well be wrong.
    """

    name: str
    times: np.ndarray
    period: float = np.inf
    guess: bool = False

    def continued(self) -> Reading:
        """Return the reading with one period more after each step back."""
        if np.isinf(self.period):
            return self
        known, times = np.isfinite(self.times), self.times.copy()
        back = np.diff(times[known], prepend=-np.inf) < 0
        times[known] += self.period * np.cumsum(back)
        return self._replace(times=times)

    @property
    def uneven(self) -> float:
        """The mean distance of the steps from their median, relative to it and at most 1."""
        steps = np.diff(self.times[np.isfinite(self.times)])
        usual = np.median(steps) if len(steps) else -1.0
        if not 0 <= usual < self.period / 2:  # of times that decrease, say
            return np.inf
        return float(np.minimum(np.abs(steps - usual) / (usual or 1.0), 1.0).mean())


def seconds(column: pd.Series, day_first: bool | None) -> tuple[np.ndarray, str, list[str]]:
    """Return the times of a column, their unit ("" of plain numbers), and notes on the reading.

    An empty entry is as far between its neighbours as its row.
    """
    name, empty = str(column.name), column.isna().sum()
    if isinstance(column.dtype, pd.PeriodDtype):
        column = column.dt.to_timestamp()
    readings = [x.continued() for x in _readings(column, day_first)]
    if empty > len(column) - 2:
        got = f"{name}, empty in {empty} of {len(column)} rows"
        raise QPError.expected("time", got, "times in two rows or more", "Omit time=.")
    if not readings:
        texts = column.dropna().astype(str)
        unread = texts[pd.to_datetime(texts, errors="coerce", format="mixed", utc=True).isna()]
        got = f"{name} with {[*unread, *texts][0]!r}"  # the first that is no date in any way
        raise QPError.expected("time", got, "numbers or dates of one format")
    best = min(reading.uneven for reading in readings) + SAME
    chosen = next(reading for reading in readings if reading.uneven <= best)
    if told := _doubt(name, chosen, readings, best):
        warnings.warn(told, UserWarning, stacklevel=5)
    unit = "" if chosen.name == NUMBERS else "s"
    plain = chosen.name == NUMBERS or chosen.name.startswith("dates")
    notes = [] if plain else [f"{name} is read as {chosen.name}"]
    times, rows, known = chosen.times, np.arange(len(column)), np.isfinite(chosen.times)
    if not known.all():
        times = np.interp(rows, rows[known], times[known], np.nan, np.nan)
        notes.append(
            f"{name} is empty in {(~known).sum()} rows, which are between their neighbours"
        )
    return times, unit, notes


def shows_times(column: pd.Series) -> bool:
    """True if the entries are times and no numbers."""
    return column.dtype.kind not in "iuf" and any(_readings(column, None))


def _doubt(name: str, chosen: Reading, readings: list[Reading], best: float) -> str:
    """Return a warning if the column may well mean something else."""
    steps = np.diff(chosen.times)
    others = [x for x in readings if x.name != NUMBERS]
    others = [x for x in others if not np.allclose(np.diff(x.times), steps, equal_nan=True)]
    if chosen.name.startswith("dates, ") and others:
        first = chosen.name.split()[1]
        return (
            f"The dates in {name} may begin with the day or the month: its steps are more even if "
            f"it is the {first}. Pass day_first={first == 'day'} if that is so."
        )
    even = [x.name for x in others if x.uneven <= best]
    if chosen.name != NUMBERS and (chosen.guess or even):
        also = f", and as {even[0]} they would be as even" if even else ""
        return (
            f"{name} is read as {chosen.name}, which makes its steps even{also}. Pass seconds, as "
            "numbers that are no clock's, if that is wrong."
        )
    return ""


def _readings(column: pd.Series, day_first: bool | None) -> Iterator[Reading]:
    """Yield the readings of all of a column's entries with digits, the likeliest first."""
    if column.dtype.kind in "mM":
        yield Reading("dates", _since_first(column))
        return
    if column.dtype.kind in "iuf":
        yield from _of_numbers(column.to_numpy(float))
        return
    texts = column.astype(str).str.strip()
    texts = texts.where(texts.str.contains(r"\d"))
    if texts.isna().all():
        return
    numbers: Any = pd.to_numeric(texts, errors="coerce")
    if (numbers.notna() == texts.notna()).all():
        yield from _of_numbers(numbers.to_numpy(float))
    else:
        for reading in _of_texts(texts.dropna(), day_first):
            times = np.full(len(texts), np.nan)
            times[texts.notna()] = reading.times
            yield reading._replace(times=times)


def _of_numbers(numbers: np.ndarray) -> Iterator[Reading]:
    """Yield the readings of numbers: days by their digits, themselves, and rarer ones."""
    known = np.isfinite(numbers)
    if not known.any():
        return
    whole = np.floor(np.where(known, numbers, numbers[known].min()))
    rest, found = numbers - whole, list[Reading]()
    for name, written, sure in DAYS:
        for pairs in range(4):
            days, clock = np.divmod(whole, 100**pairs)
            times = _of_pairs(clock, pairs)
            if times is None or {len(f"{x:.0f}") for x in (days.min(), days.max())} != {len(name)}:
                continue
            texts = pd.Series(days).map("{:.0f}".format)
            dates = pd.to_datetime(texts, format=written, errors="coerce")
            if dates.dt.year.between(1900, 2100).all():  # none is NaT
                times = _since_first(dates) + times + rest
                found.append(Reading(name + CLOCKED[: 2 * pairs], times, guess=not sure))
    found.append(Reading(NUMBERS, numbers))
    for pairs in (2, 3):
        if (times := _of_pairs(whole, pairs)) is not None:
            found.append(Reading(CLOCKED[: 2 * pairs], times + rest, DAY, guess=True))
    yield from sorted(found, key=lambda reading: reading.guess)


def _of_pairs(digits: np.ndarray, pairs: int) -> np.ndarray | None:
    """Return the seconds of HHMMSS's first pairs of digits, or None if they are no time of day."""
    total = np.zeros(len(digits))
    for i, (length, limit) in enumerate(PAIRS[:pairs]):
        value = digits // 100 ** (pairs - 1 - i)
        value = value % 100 if i else value
        if (value >= limit).any():
            return None
        total += length * value
    return total if digits.min() >= 0 and total.max() <= DAY else None


def _of_texts(texts: pd.Series, day_first: bool | None) -> Iterator[Reading]:
    if (clocks := texts.str.extract(CLOCK))[0].notna().all():
        yield from _of_clocks(clocks)
        return
    if texts.str.contains(DIFFERENCE, case=False).any():
        differences = pd.to_timedelta(texts, errors="coerce")
        if differences.notna().all():
            yield Reading("time differences", differences.dt.total_seconds().to_numpy())
            return
    ended = texts.str.contains(MIDNIGHT)
    texts = texts.str.replace(MIDNIGHT, "00:00", regex=True)
    ways: dict[str, dict[str, Any]] = {"dates": {"format": "ISO8601"}}
    ways |= {
        f"dates, {part} first": {"dayfirst": part == "day"}
        for part in ("day", "month")
        if day_first in (part == "day", None)
    }
    for name, way in ways.items():
        with contextlib.suppress(ValueError, TypeError), warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # on dates that need no guess
            dates = pd.to_datetime(texts, utc=True, **way)
            yield Reading(name, _since_first(dates) + DAY * ended.to_numpy())
            if "format" in way:
                return


def _of_clocks(parts: pd.DataFrame) -> Iterator[Reading]:
    """Yield the readings of a:bb, a:bb.c, a:bb:cc, a:bb:cc.d, with am or pm or without."""
    a, b, c = parts[[0, 1, 2]].fillna("0").to_numpy(float).T
    rest = ("0." + parts[3].fillna("0")).to_numpy(float)
    long, split, halves = parts[[2, 3, 4]].notna().to_numpy().T
    if long.any() != long.all() or (b >= 60).any() or (c >= 60).any():
        return
    if halves.any():
        a = a % 12 + 12.0 * (parts[4].str.lower() == "p").to_numpy()
    elapsed = (a > 24).any()
    hours = HOUR * a + 60 * b + c + rest
    if long.all() or halves.any():
        yield Reading("h:mm:ss", hours, np.inf if elapsed else DAY)
        return
    minutes = Reading("mm:ss", 60 * a + b + rest, np.inf if (a >= 60).any() else HOUR)
    if split.any():  # as spreadsheets show, without the hours
        yield minutes
        return
    either = Reading("h:mm", hours, np.inf if elapsed else DAY), minutes
    yield from reversed(either) if elapsed else either


def _since_first(dates: pd.Series) -> np.ndarray:
    """Return the seconds since the earliest date, or since 0 of time differences."""
    if dates.dtype.kind != "m":
        dates = dates - dates.min()
    return dates.dt.total_seconds().to_numpy()


def gaps_of(
    times: np.ndarray | None, inside: np.ndarray, marks: np.ndarray, unit: str = ""
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
        got = f"steps of {with_unit(dt, unit)}"
        raise QPError.expected("time", got, "times that increase", "Sort the rows.")
    gaps = inside & ~(np.abs(change - dt) <= 0.5 * dt + tick)
    if len(change) >= FEWEST:
        rows = np.lib.stride_tricks.sliding_window_view(change, FEWEST)
        own = rows.mean(1)
        even = (np.abs(rows - own[:, None]) <= 0.5 * own[:, None] + tick).all(1)
        off = np.where(even, np.abs(own - dt), 0)
        if off.max() > ONE_DT * dt + tick / FEWEST:
            row = int(np.argmax(off > 0.99 * off.max()))
            steps = with_unit(own[row], unit), with_unit(dt, unit)
            got = f"steps of {steps[0]} from row {row} on, and of {steps[1]} in the median"
            raise QPError.expected("time", got, "one sampling time", "Resample the data.")
    if gaps.sum() > max(FEWEST, CUT * inside.sum()):
        text = (
            f"The times have {gaps.sum()} gaps between steps of {with_unit(dt, unit)}, at each of "
            "which a trajectory ends: is this how they are meant?"
        )
        back = (change < 0).sum()
        text += f" {back} of them go back in time: sort the rows." * bool(back)
        warnings.warn(text, UserWarning, stacklevel=5)
    return gaps, dt


def with_unit(time: float, unit: str) -> str:
    """Return a time with its unit, as in 0.25 min."""
    return f"{time:g} {unit}".rstrip()
