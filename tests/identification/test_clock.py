"""Times as loggers write them."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pandas as pd
import pytest

import torch_qpmpc as qm
from tests.logs import NAMES, lengths, room
from torch_qpmpc import QPError


def clock(text: str | None = None, start: str = "2020-09-01", freq: str = "15min") -> Any:
    times = pd.date_range(start, periods=60, freq=freq)
    return times if text is None else times.strftime(text)


STEPS = pd.to_timedelta(900 * np.arange(60), unit="s")
PERIODS = pd.period_range("2020-09-01", periods=60, freq="15min")


@pytest.mark.parametrize(
    "times",
    [
        *(clock(), clock().tz_localize("Europe/Berlin"), STEPS, PERIODS, 900 * np.arange(60)),
        *(clock().to_pydatetime().astype(object), STEPS.to_pytimedelta()),
        *(clock().astype(str), clock("%Y-%m-%dT%H:%MZ"), clock("%b %d, %Y %I:%M %p")),
        clock().floor("h"),  # four rows an hour
    ],
    ids=lambda times: f"{type(times).__name__} {times[0]}",
)
@pytest.mark.parametrize("place", ["index", "column"])
def test_times_are_read_from_a_column_or_the_index(times, place):
    frame, number = room(), not hasattr(times, "freq") or isinstance(times[0], str)
    frame = frame.assign(t=times)
    if place == "index" and not number:
        frame = frame.set_index("t")
    frame = frame.iloc[np.r_[:20, 30:60]]
    log = qm.read_log(frame, **NAMES, time="t" if number or place == "column" else None)
    assert (lengths(log), log.dt) == ([19, 29], 900)


FORMATS = ("%d/%m/%Y %H:00", "%d.%m.%y %H:%M:%S", "%m/%d/%Y %H:%M", "%d-%m-%Y %H:%M")


@pytest.mark.parametrize("text", FORMATS)
@pytest.mark.parametrize("start", ["2020-09-29 13:45", "2020-09-02", "2020-09-12 20:00"])
@pytest.mark.parametrize("freq", ["15min", "h", "6h"])
def test_dates_may_begin_with_the_day(text, start, freq):
    """Where both readings are dates with other gaps, a warning says so."""
    frame = room().assign(t=clock(text, start, freq))
    dt = {"15min": 900, "h": 3600, "6h": 21600}[freq]
    options: Any = {**NAMES, "time": "t"}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        log = qm.read_log(frame, **options)
    assert (lengths(log), log.dt) == ([59], dt)
    days = {(x.day, x.month) for x in clock(None, start, freq)}
    said = [str(x.message) for x in caught]
    ambiguous = len(days) > 1 and all(max(pair) <= 12 for pair in days)
    ambiguous = bool(said) if "%y" in text else ambiguous  # pandas guesses row by row
    first = text.startswith("%d")
    assert [f"day_first={first}" in x for x in said] == [True] * ambiguous
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert qm.read_log(frame, **options, day_first=first).dt == dt


def test_a_clock_of_whole_seconds_may_show_a_time_twice():
    frame = room(100)
    for dt in (0.5, 0.4, 0.25, 0.1):
        frame["t"] = np.floor(dt * np.arange(100) + 0.01)
        assert (lengths(log := qm.read_log(frame, **NAMES, time="t")), log.dt) == ([99], dt)
    frame.loc[50:, "t"] += 2
    assert lengths(qm.read_log(frame, **NAMES, time="t")) == [49, 49]
    with pytest.raises(QPError, match=r"^time: got steps of 0, expected times that increase"):
        qm.read_log(frame.assign(t=3.0), **NAMES, time="t")


def test_jitter_is_no_gap_and_a_step_back_is_one():
    frame = room()
    frame["t"] += 0.05 * np.random.default_rng(0).random(60)
    assert lengths(qm.read_log(frame, **NAMES, time="t")) == [59]
    frame.loc[30:, "t"] -= 10
    assert lengths(qm.read_log(frame, **NAMES, time="t")) == [29, 29]
