"""Times as loggers write them."""

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
    with warnings.catch_warnings(record=True, action="always") as caught:
        log = qm.read_log(frame, **options)
    assert (lengths(log), log.dt) == ([59], dt)
    days = {(x.day, x.month) for x in clock(None, start, freq)}
    said = [str(x.message) for x in caught]
    ambiguous = len(days) > 1 and all(max(pair) <= 12 for pair in days)
    ambiguous = bool(said) if "%y" in text else ambiguous  # pandas guesses row by row
    first = text.startswith("%d")
    assert [f"day_first={first}" in x for x in said] == [True] * ambiguous
    with warnings.catch_warnings(action="error"):
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


# What a column of times means


def spelled(times: Any, text: str) -> list[Any]:
    """Write times as strftime does, or as differences, or with midnight as 24:00."""
    if text == "pandas":
        return (times - times[0]).astype(str).tolist()
    if text == "python":
        return [str(x.to_pytimedelta()) for x in times - times[0]]
    if text == "h:mm:ss":
        total = (times - times[0]).total_seconds().astype(int)
        return [f"{x // 3600}:{x // 60 % 60:02d}:{x % 60:02d}" for x in total]
    if "24" in text:
        midnight = times == times.normalize()
        days = times.where(~midnight, times - pd.Timedelta("1D"))
        hours = zip(days, midnight, strict=True)
        return [day.strftime(text.replace("24", "24" if end else "%H")) for day, end in hours]
    return times.strftime(text).tolist()


#: The spelling, the sampling time in seconds, and whether the reading is one of several.
SPELLINGS = [
    *(("%Y%m%d%H%M%S", dt, False) for dt in (1, 37, 600)),
    *(("%Y%m%d%H%M", dt, False) for dt in (60, 420)),
    *(("%Y%m%d%H", 3600, False), ("%Y%m%d", 86400, False), ("%Y%j", 86400, False)),
    ("%Y%j%H%M", 900, False),
    *(("%y%m%d%H%M", 300, True), ("%y%m%d%H%M%S", 45, True)),
    *(("%H%M%S", dt, True) for dt in (1, 30, 600)),
    *(("%H%M", 300, True), ("%H:%M", 900, False), ("%H:%M:%S", 45, False)),
    ("%H:%M:%S.%f", 5, False),
    *(("%I:%M:%S %p", 600, False), ("%I:%M %p", 600, False), ("%M:%S.%f", 20, False)),
    *(("pandas", 600, False), ("python", 7200, False), ("h:mm:ss", 600, False)),
    *(("%Y-%m-%d 24:%M", 3600, False), ("%Y-%m-%dT24:%M:%S", 900, False), ("24:%M", 1800, False)),
    ("%d.%m.%Y 24:%M", 1800, False),
]


@pytest.mark.parametrize(("text", "dt", "guess"), SPELLINGS)
@pytest.mark.parametrize("start", ["2025-12-30 22:13:00", "2024-02-27 23:00"])
def test_a_clock_means_what_makes_its_steps_even(text, dt, guess, start, tmp_path):
    """From files, which lose leading zeros; with rows that are missing."""
    rows, frame = np.r_[:300, 340:600], room(600)
    first = pd.Timestamp(start).floor("D" if dt == 86400 else f"{min(dt, 3600)}s")
    times = pd.date_range(first, periods=600, freq=f"{dt}s")
    frame["t"] = spelled(times, text)
    frame.iloc[rows].to_csv(tmp_path / "a.csv", index=False)
    with warnings.catch_warnings(record=True, action="always") as caught:
        log = qm.read_log(tmp_path / "a.csv", **NAMES, time="t", day_first=True)
    said = [str(x.message) for x in caught]
    assert (lengths(log), log.dt, log.dt_unit) == ([299, 259], dt, "s"), log
    assert f"one step every {dt} s:" in str(log)
    assert len(said) == guess, said
    assert all(x.startswith("t is read as ") for x in said)
    assert all(x.filename == __file__ for x in caught)


@pytest.mark.parametrize(
    "times",
    [
        np.arange(600),
        np.arange(600) + 1000,
        5 * np.arange(600) + 100,
        60 * np.arange(600),
        1.7e9 + 60 * np.arange(600),
        1.7e12 + 1000 * np.arange(600),
        45292 + np.arange(600) / 96,
        100 * np.arange(600),
        0.25 * np.arange(600),
        np.arange(600) - 300,
    ],
    ids=lambda x: f"{x[0]:.6g} {x[1]:.6g}",
)
def test_even_numbers_are_numbers(times):
    frame = room(600).assign(t=times).rename(columns={"t": "t [h]"})
    rows = np.r_[:300, 340:600]
    with warnings.catch_warnings(action="error"):
        log = qm.read_log(frame.iloc[rows], **NAMES, time="t")
    assert (lengths(log), log.dt_unit) == ([299, 259], "h")
    assert log.dt == pytest.approx(times[1] - times[0], rel=1e-6)


@pytest.mark.parametrize(
    ("first", "name", "dt", "other"),
    [("00:00", "h:mm", 300, "mm:ss"), ("40:00", "mm:ss", 5, "h:mm")],
)
def test_a_clock_that_may_have_hours_or_minutes_is_said_to(first, name, dt, other):
    hours = int(first[:2])
    t = [f"{hours + k // 12:02d}:{k % 12 * 5:02d}" for k in range(60)]
    with pytest.warns(UserWarning, match=f"^t is read as {name}, .*as {other} they would be as ev"):
        log = qm.read_log(room().assign(t=t), **NAMES, time="t")
    assert (lengths(log), log.dt) == ([59], dt)
    assert f"t is read as {name}" in log.notes


def test_empty_times_are_between_their_neighbours():
    frame = room(100)
    frame["t"] = 0.25 * np.arange(100)
    frame.loc[50:, "t"] += 5.0
    frame.loc[~frame.index.isin([*range(0, 100, 7), 49, 50, 99]), "t"] = np.nan
    log = qm.read_log(frame, **NAMES, time="t")
    assert (lengths(log), log.dt) == ([49, 49], 0.25)
    assert "t is empty in 83 rows, which are between their neighbours" in log.notes


def test_many_gaps_are_said():
    t = 0.25 * np.arange(600) + 3.0 * (np.arange(600) // 30)
    with pytest.warns(UserWarning, match=r"^The times have 19 gaps between steps of 0.25, at each"):
        qm.read_log(room(600).assign(t=t), **NAMES, time="t")
    dated = room().assign(t=pd.date_range("2026-03-01", periods=60, freq="min"))
    swapped = dated.iloc[np.arange(60).reshape(-1, 6)[:, [0, 1, 2, 4, 3, 5]].ravel()]
    with pytest.warns(UserWarning, match=r"\? 10 of them go back in time: sort the rows.$"):
        qm.read_log(swapped, **NAMES, time="t")
