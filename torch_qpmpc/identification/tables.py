"""Logs of CSV files, DataFrames and arrays, and the faults of their columns."""

import csv
import io
import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from torch_qpmpc.checks import ungraded
from torch_qpmpc.errors import QPError
from torch_qpmpc.identification.clock import FEWEST, gaps_of, seconds, shows_times
from torch_qpmpc.identification.log import LARGEST, STILL, Log, Trajectory, runs
from torch_qpmpc.identification.subspace import unmoved_outputs

#: A number that repeats is a mark, such as -9999, if it is this many ranges of all others away, and
#: so are errors: numbers in two rows or more, but at most the share FEW of them. A slow sensor
#: has a new value in the share OFTEN of every m-th rows.
FAR, FEW, OFTEN = 10, 0.05, 0.9
#: The column of a DataFrame's index of times, and the one of an index in a file, by pandas.
TIME_INDEX, FILE_INDEX = "the index", "Unnamed: 0"
#: A column's header with its unit, as in ``T [degC]``.
HEADER = re.compile(r"\s*(.*?)\s*\[([^][]*)\]\s*$")
#: How pandas reads numbers of other spellings.
PANDAS = "pandas.read_csv(.., sep=.., engine='python', %s)"
KINDS = "a CSV file, a DataFrame, a dict of arrays, a list of these, or a TensorDict of steps"


def read_tables(
    data: Any,
    signals: Sequence[Sequence[str] | None],
    time: str | None,
    episode: str | None,
    day_first: bool | None,
) -> Log:
    """Return the log of tables with the ``signals`` (outputs, inputs, known); see `read_log`."""
    frames = [_frame(part) for part in (data if isinstance(data, list | tuple) else [data])]
    if not frames:
        raise QPError.expected("data", "an empty list", KINDS)
    marks = np.repeat(np.arange(len(frames)), [len(frame) for frame in frames])
    headers, units = _name_columns(frames)
    frame = pd.concat(frames, ignore_index=True)
    listed = [x if x is None else [*map(str, [x] if isinstance(x, str) else x)] for x in signals]
    chosen = [x and [headers.get(name.strip()) or name for name in x] for x in listed]
    time, episode = (x if x is None else headers.get(str(x).strip(), x) for x in (time, episode))
    taken = {time, episode, *(name for names in chosen for name in names or ())}
    kinds = zip(chosen, "yud", ("outputs", "inputs", "known"), strict=True)
    y, u, d = (_columns(frame, *kind, taken) for kind in kinds)
    names = (*y, *u, *d)
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise QPError.expected("column", f"{twice[0]!r} twice", "each once")
    values, words = _numbers(frame, names)
    times, dt_unit, read = _times(frame, time, day_first)
    dt_unit = dt_unit or units.get(str(time), "")
    if episode is not None:
        column = _column(frame, episode)
        marks = marks + (column != column.shift()).cumsum().to_numpy()
    if times is not None:
        again = np.diff(times, prepend=np.nan) == 0
        rows = np.column_stack((np.nan_to_num(values, nan=np.inf), marks))
        if again.any() and (rows[1:] == rows[:-1])[again[1:]].all():
            values, times, marks = (x[~again] for x in (values, times, marks))
            words.append(f"{_count(again.sum(), 'row')} left out that repeat the one before")
    usual = values[(np.abs(values) <= LARGEST).all(1)]
    if noticed := (*_marked(usual, names), *_dependent(usual, names), *_repeated(values, y)):
        warnings.warn(f"In this log, {'; '.join(noticed)}.", UserWarning, stacklevel=3)
    trajectories, dt, note = _split(values, times, marks, (len(y), len(u), len(d)), dt_unit)
    units = {name: x for name, x in units.items() if name in names}
    return Log(trajectories, y, u, d, units, dt, (note, *read, *words, *noticed), dt_unit)


def _split(
    values: Any, times: np.ndarray | None, marks: Any, sizes: tuple[int, int, int], unit: str
) -> tuple[list[Trajectory], float | None, str]:
    """Return the trajectories in rows ``values`` [y, u, d], the time of a step, and a note."""
    n_y = sizes[0]
    fits = np.abs(values) <= LARGEST  # False for NaN
    known, measured = fits[:, n_y:].all(1), fits[:, :n_y].any(1)
    inside = marks[1:] == marks[:-1]
    gaps, dt = gaps_of(times, inside, marks, unit)
    steps = known[:-1] & inside & ~gaps
    edges, used = [], np.zeros(len(values), bool)
    for i, k in runs(steps):  # from the first row with an output to the last
        rows = i + np.flatnonzero(measured[i : k + 1])
        if len(rows) > 1:
            edges.append((rows[0], rows[-1]))
            used[rows[0] : rows[-1] + 1] = True
    if not edges:
        got = f"{len(values)} rows, of which no two have outputs and all inputs between them"
        raise QPError.expected("data", got, "rows with a number in each column")
    y, u, d = torch.as_tensor(values).split(sizes, dim=1)
    y = y.masked_fill(~torch.as_tensor(fits[:, :n_y]), torch.nan)
    trajectories = [Trajectory(y[i : k + 1], u[i:k], d[i:k]) for i, k in edges]
    counted = f"{_count(gaps.sum(), 'gap')}, {_count(len(edges), 'trajectory')}"
    note = f"{_count(len(values), 'row')}: {counted}, {1 - used.mean():.1%} of rows dropped"
    if missing := (~fits[used, :n_y]).mean():
        note += f", {missing:.1%} of outputs missing"
    return trajectories, dt, note


def _count(number: int, noun: str) -> str:
    return f"{number} {noun if number == 1 else f'{noun}s'.replace('ys', 'ies')}"


def _frame(part: Any) -> pd.DataFrame:
    if isinstance(part, str | Path):
        try:
            return _read_csv(Path(part))
        except (OSError, ValueError, Warning) as error:
            got, want = f"{part}, which cannot be read ({error})", "a CSV file that begins with"
            raise QPError.expected("data", got, f"{want} a name for each field") from error
    if isinstance(part, pd.DataFrame):
        if isinstance(part.index, pd.MultiIndex):
            remedy = "Call reset_index(), and name its columns by time= and episode=."
            raise QPError.expected("data", "an index of several levels", "one of times", remedy)
        timed = isinstance(part.index, pd.DatetimeIndex | pd.TimedeltaIndex | pd.PeriodIndex)
        return part.assign(**{TIME_INDEX: part.index}) if timed else part.copy()
    if not isinstance(part, Mapping):
        raise QPError.expected("data", type(part).__name__, KINDS)
    columns: dict[str, pd.Series] = {}
    for name, value in part.items():
        array = np.asarray(ungraded(str(name), value))
        array = np.ma.array(array, mask=np.ma.getmask(value))  # which is NaN for pandas
        if array.ndim not in (1, 2):
            raise QPError.expected(str(name), f"shape {array.shape}", "shape (T,) or (T, n)")
        for i, column in enumerate(np.atleast_2d(array.T)):
            single = array.ndim == 1 or array.shape[1] == 1
            columns[name if single else f"{name}{i + 1}"] = pd.Series(column)
    longest = max((len(column) for column in columns.values()), default=0)
    for name, column in columns.items():
        if len(column) < longest - 1:
            expected = f"{longest} rows, as others, or {longest - 1}"
            raise QPError.expected(str(name), f"{len(column)} rows", expected)
    return pd.DataFrame(columns)  # which fills a missing last row with NaN


def _read_csv(path: Path) -> pd.DataFrame:
    """Read a CSV file by its header; an empty field beyond that is a delimiter too many.

    The delimiter that the header has most of, of comma, semicolon, tab and bar, is the file's.
    Unless it is a comma, all numbers may have decimal commas.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        is_utf_16 = error.object[:2] in (b"\xff\xfe", b"\xfe\xff")
        text = path.read_text(encoding="utf-16" if is_utf_16 else "cp1252")
    headers = {}
    for sep in ",;\t|":
        rows = csv.reader(io.StringIO(text), delimiter=sep, skipinitialspace=True)
        headers[sep] = next(filter(None, rows), [])
    sep = max(headers, key=lambda sep: len(headers[sep]))
    decimal = "." if sep == "," else ","
    number = rf'(?m)(?:^|[{sep}])\s*"?[-+]?(\d+%s\d+)"?\s*(?=[{sep}]|$)'
    both = [x[1] for mark in (r"\.", ",") if sep != "," and (x := re.search(number % mark, text))]
    if len(both) == 2 and any(re.fullmatch(r"\d{1,3}\D\d{3}", x) for x in both):
        way = PANDAS % "decimal=.., thousands=.."
        raise ValueError(f"points and commas in {' and '.join(both)}: pass a DataFrame, by {way}")
    options: Any = {"index_col": False, "skipinitialspace": True, "low_memory": False}
    with warnings.catch_warnings():
        warnings.simplefilter("error", pd.errors.ParserWarning)  # that fields would be lost
        frame = pd.read_csv(io.StringIO(text), sep=sep, decimal=decimal, **options)
    # Without pandas's other names for what is there twice.
    return frame.set_axis(headers[sep], axis=1)


def _bare(header: Any) -> str:
    """Return a header without its unit."""
    return HEADER.sub(r"\1", str(header)).strip()


def _name_columns(frames: Sequence[pd.DataFrame]) -> tuple[dict[str, str], dict[str, str]]:
    """Name the columns without units where that is clear; return names by header, and units."""
    headers, units = dict[str, str](), dict[str, str]()
    for frame in frames:
        bare, names = [_bare(x) for x in frame.columns], []
        for header, name in zip(map(str, frame.columns), bare, strict=True):
            name = name if bare.count(name) == 1 else header.strip()
            names.append(name or f"Unnamed: {len(names)}")
            headers.setdefault(header.strip(), names[-1])
            unit = match[2] if (match := HEADER.fullmatch(header)) else None
            if unit is not None and units.setdefault(name, unit) != unit:
                got = f"{name} in {units[name]} and in {unit}"
                raise QPError.expected("data", got, "one unit in all episodes", "Convert one.")
        frame.columns = names
    return headers, units


def _columns(
    frame: pd.DataFrame, names: Sequence[str] | None, default: str, kind: str, taken: set[Any]
) -> tuple[str, ...]:
    """Return the columns of ``names``; ``y`` may stand for ``y1``, ``y2``, ..."""
    present = [x for x in frame.columns if names is not None or x not in taken]
    columns = []
    for name in names or [default]:
        numbered = [x for x in present if re.fullmatch(rf"{re.escape(name)}\d+", x)]
        columns += [name] if name in present or (names and not numbered) else numbered
    if not columns and kind != "known":
        got = f"none, and columns {', '.join(frame.columns)}"
        remedy = f"Pass read_log(.., {kind}=[..])."
        raise QPError.expected(kind, got, f"names of columns, or {default}1, ..", remedy)
    return tuple(columns)


def _numbers(frame: pd.DataFrame, names: Sequence[str]) -> tuple[np.ndarray, list[str]]:
    """Return the columns as float64, with NaN for words without digits, and notes on these."""
    values, notes = np.empty((len(frame), len(names))), []
    for i, name in enumerate(names):
        column = _column(frame, name)
        numbers: Any = pd.to_numeric(column, errors="coerce")
        values[:, i] = np.asarray(numbers, dtype=float)
        words = column[numbers.isna() & column.notna()].astype(str)
        odd = words[words.str.contains(r"^[^#]*\d") & (words.map(_bare) != name)]
        if len(odd):
            got = f"{name} with {odd.iloc[0]!r} in row {odd.index[0]}, one of {len(odd)}"
            raise QPError.expected("column", got, "1234.5", _remedy(odd.iloc[0]))
        if not np.isfinite(values[:, i]).any():
            raise QPError.expected("column", f"{name}, without a number", "numbers, as 0 and 1")
        if len(words):
            rows = _count(len(words), "row")
            notes.append(f"{name} is no number in {rows}, as in {words.iloc[0]!r}")
    return values, notes


def _remedy(text: str) -> str:
    """Return how to read a text of a number, with a decimal comma or separated thousands."""
    marks, ways = re.sub(r"^[-+]|\d", "", text), list[str]()
    if marks and re.fullmatch(r"[.,'\u2019\s]+", marks):
        ways += [f"thousands={marks[0]!r}"] * bool(re.match(r"[-+]?\d{1,3}(\D\d{3})+(?!\d)", text))
        ways += ["decimal=','"] * (marks[-1] == "," and marks.count(",") == 1)
    if not ways:
        return "Leave a number alone in each cell: units belong in the header, as in 'q [kW]'."
    return f"Pass a DataFrame: {PANDAS % (', ' if len(marks) > 1 else ' or ').join(ways)}."


def _column(frame: pd.DataFrame, name: str) -> Any:
    count = list(frame.columns).count(name)
    if count != 1:
        got = f"{name!r}, which is {'missing' if count == 0 else 'there twice'}"
        expected = f"one of {', '.join(dict.fromkeys(frame.columns))}"
        raise QPError.expected("column", got, expected)
    return frame[name]


def _times(
    frame: pd.DataFrame, name: str | None, day_first: bool | None
) -> tuple[np.ndarray | None, str, list[str]]:
    """Return the times, their unit and notes; None without a column of times."""
    if name is None:
        name, first = TIME_INDEX, frame.iloc[:1, 0]
        if frame.columns[0] == FILE_INDEX and shows_times(first):
            name = FILE_INDEX
        if name not in frame.columns:
            return None, "", []
    column = _column(frame, name).infer_objects()
    if column.dtype.kind not in "mM" and not isinstance(column.dtype, pd.PeriodDtype):
        column = column.where(column.astype(str).map(_bare) != column.name)  # a header in between
    return seconds(column, day_first)


def _marked(values: np.ndarray, names: Sequence[str]) -> list[str]:
    """Name the columns with numbers that are far from all others: one, as -9999, or a few."""
    notes = []
    for name, column in zip(names, values.T, strict=True):
        x, counts = np.unique(column, return_counts=True)
        if counts[1:-1].sum() < FEWEST or not np.ptp(x[1:-1]):
            continue
        far = (np.diff(x)[[0, -1]] > FAR * np.ptp(x[1:-1])) & (counts[[0, -1]] > 1)
        notes += [
            f"{name} is {x[end]:.6g} in {counts[end]} rows, far from all others, which may mark "
            "missing numbers: replace them by NaN"
            for end in np.array([0, -1])[far]
        ]
        away = np.abs(column - np.median(column))
        last = np.sort(away)[-int(FEW * len(away)) - 1 :]
        few = np.cumsum((np.diff(last) > 2 * FAR * last[:-1]) & (last[:-1] > 0)).astype(bool).sum()
        if few > 1 and not far.any():
            such = f"in {few} rows, such as {column[away.argmax()]:.6g}"
            notes.append(f"{name} is far from all others {such}: replace errors by NaN")
    return notes


def _repeated(values: np.ndarray, outputs: Sequence[str]) -> list[str]:
    """Replace values that a sensor repeats until every m-th row by NaN, and name it.

    In a plant at rest, outputs repeat as inputs do: these change in other rows. A set-point stays.
    """
    notes, moves = [], np.flatnonzero(np.diff(values[:, len(outputs) :], axis=0).any(1))
    numbers = torch.as_tensor(np.where(np.abs(values) <= LARGEST, values, np.nan))
    y, u = numbers.tensor_split((len(outputs),), 1)
    still = unmoved_outputs([Trajectory(y, u[:-1].nan_to_num(), u[:-1, :0])])
    for i, name in enumerate(outputs):
        rows = 1 + np.flatnonzero(np.diff(values[:, i]))  # NaN is no repeat
        m = int(np.gcd.reduce(np.diff(rows))) if len(rows) > FEWEST else 1
        if not still[i] and len(rows) * m > OFTEN * len(values) and len({*(moves % m)}) > 1:
            values[np.arange(len(values)) % m != rows[0] % m, i] = np.nan
            notes.append(f"{name} has a new value every {m} rows: its repeats are taken as missing")
    return notes


def _dependent(values: np.ndarray, names: Sequence[str]) -> list[str]:
    """Name the columns that are constant or a linear function of columns before them."""
    X = values - (middle := values.mean(0))
    size = np.sqrt(np.square(X).mean(0))
    notes, kept = list[str](), list[int]()
    for i, name in enumerate(names):
        if size[i] <= STILL * abs(middle[i]):
            notes.append(f"{name} is constant at {middle[i]:.6g}")
            continue
        x, others = X[:, i] / size[i], X[:, kept] / size[kept]
        weights = np.linalg.lstsq(others, x, rcond=None)[0]
        if len(X) > len(names) and np.sqrt(np.square(x - others @ weights).mean()) <= STILL:
            of = [names[j] for j, weight in zip(kept, weights, strict=True) if abs(weight) > STILL]
            notes.append(f"{name} is a linear function of {', '.join(of)}")
        else:
            kept.append(i)
    return notes
