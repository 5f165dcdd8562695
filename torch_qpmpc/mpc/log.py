"""Trajectories of a plant from CSV files, DataFrames, arrays and TensorDicts, and their faults."""

from __future__ import annotations

import contextlib
import csv
import re
import sys
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.checks import check_whole
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.validation import ungraded

if TYPE_CHECKING:
    import pandas as pd

#: The largest magnitude, whose squares are finite.
LARGEST = 1e100
#: A column is constant, or a linear function of others, up to this share of its size.
STILL = 1e-6
#: FEWEST steps in a row have another sampling time if their mean differs from the log's by more
#: than the share ONE_DT; a clock is coarse if more than that share of rows repeat a time.
FEWEST, ONE_DT = 10, 0.1
#: The steps over which a coarse clock is read, if a trajectory has that many.
SPANS = (60, 12, 1)
#: A number that repeats is a mark, such as -9999, if it is this many ranges of all others away.
FAR = 10
#: The column of a DataFrame's index of times.
TIME_INDEX = "the index"
KINDS = "a CSV file, a DataFrame, a dict of arrays, a list of these, or a TensorDict of steps"
#: A column's header with its unit, as in ``T [degC]``.
HEADER = re.compile(r"\s*(.*?)\s*\[(.*)\]\s*")
NEXT = ("next", "observation")
#: The next outputs, where the observations are estimates.
MEASURED = ("next", "measured")
REMEDY = "Pass logged steps as TorchRL's collectors and rollouts return them."
#: Flags of a step that ends its trajectory.
ENDS = (("next", "done"), ("next", "terminated"), ("next", "truncated"))
#: Keys of collectors and of `torchrl.collectors.utils.split_trajectories`.
IDS = (("collector", "traj_ids"), ("traj_ids",))
MASKS = (("collector", "mask"), ("mask",))


class Trajectory(NamedTuple):
    """Consecutive steps in float64: y ``(T + 1, n_x)``, u ``(T, n_u)`` and d ``(T, n_d)``."""

    y: Tensor
    u: Tensor
    d: Tensor

    @property
    def steps(self) -> int:
        """The number of steps, T."""
        return self.u.shape[0]  # len takes ten times as long

    def between(self, start: int, stop: int) -> Trajectory:
        """Return the steps start, .., stop - 1."""
        return Trajectory(self.y[start : stop + 1], self.u[start:stop], self.d[start:stop])


@dataclass(frozen=True, eq=False)
class Log:
    """Trajectories with the names of their signals; ``print`` shows what `read_log` did.

    Attributes:
        trajectories: consecutive steps: outputs y, inputs u and known signals d.
        outputs, inputs, known: the names of the entries of y, u and d.
        units: units by name, where known.
        dt: the time between steps, in the unit of the time column or in seconds; None without one.
        notes: sentences on what was split, left out or noticed.
    """

    trajectories: Sequence[Trajectory]
    outputs: tuple[str, ...]
    inputs: tuple[str, ...]
    known: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    dt: float | None = None
    notes: tuple[str, ...] = ()

    @property
    def steps(self) -> int:
        """The number of steps of all trajectories."""
        return sum(trajectory.steps for trajectory in self.trajectories)

    def label(self, name: str) -> str:
        """Return ``name`` with its unit, as ``T [degC]``."""
        return f"{name} [{self.units[name]}]" if name in self.units else name

    def __str__(self) -> str:
        signals = {"outputs": self.outputs, "inputs": self.inputs, "known": self.known}
        named = "; ".join(
            f"{kind} {', '.join(map(self.label, names))}"
            for kind, names in signals.items()
            if names
        )
        every = "" if self.dt is None else f", one step every {self.dt:g}"
        return "\n".join((f"{self.steps} steps{every}: {named}", *self.notes))


def read_log(
    data: Any,
    outputs: Sequence[str] | None = None,
    inputs: Sequence[str] | None = None,
    known: Sequence[str] | None = None,
    time: str | None = None,
    episode: str | None = None,
    day_first: bool | None = None,
) -> Log:
    """Read a log of a plant: row k has outputs y_k, the inputs u_k applied until k + 1, and d_k.

    A trajectory ends at a gap in ``time``, where ``episode`` changes, and at a row with a missing
    number. The last row of a trajectory needs only outputs.

    Args:
        data: the path of a CSV file, a DataFrame, a mapping of arrays ``(T,)`` or ``(T, n)``, or a
            list of these, one for each episode; or steps as in `identify`. A unit in a header, as
            in ``T [degC]``, is not part of the name. A shorter array lacks the last row.
        outputs, inputs, known: the columns of y, u and, optionally, d; by default ``y``, ``u`` and
            ``d`` or ``y1``, ``y2``, .. and so on.
        time: the column of times: numbers, dates, periods or time differences; by default a
            DataFrame's index of these. A clock may show one time for several rows.
        episode: the column of marks that differ between episodes.
        day_first: True for dates such as 29/09/2020, False for 09/29/2020; by default the reading
            with fewer gaps.

    Returns:
        The log. A `UserWarning` names columns that are constant, a linear function of others or
        marked by a number such as -9999, and dates that may be read in two ways.

    Raises:
        QPError: a column is missing, named twice, without numbers or with text such as ``1,5`` or
            ``3 kW``; the sampling time changes; or no two consecutive rows are complete.

    Example:
        >>> import numpy as np, torch_qpmpc as qm
        >>> rng = np.random.default_rng(0)
        >>> rows = {"T [degC]": rng.normal(size=9), "q": rng.normal(size=9)}
        >>> rows["t"] = [0, 1, 2, 3, 4, 9, 10, 11, 12]
        >>> print(qm.read_log(rows, outputs=["T"], inputs=["q"], time="t"))
        7 steps, one step every 1: outputs T [degC]; inputs q
        9 rows: 1 gap, 2 trajectories, 0.0% of rows dropped
    """
    import pandas as pd

    if _is_steps(data):
        if time is not None or episode is not None:
            want = "None for a TensorDict, whose own flags are used"
            raise QPError.expected("time, episode", f"{time!r} and {episode!r}", want)
        n_x = None if outputs is None else len(outputs)
        return _named(_of_steps(data, n_x, len(known or ())), outputs, inputs, known)
    frames = [_frame(part) for part in (data if isinstance(data, list | tuple) else [data])]
    if not frames:
        raise QPError.expected("data", "an empty list", KINDS)
    marks = np.repeat(np.arange(len(frames)), [len(frame) for frame in frames])
    frame = pd.concat(frames, ignore_index=True)
    headers = [HEADER.fullmatch(str(header)) for header in frame.columns]
    units = {match[1]: match[2] for match in headers if match}
    frame.columns = [_bare(header) for header in frame.columns]
    chosen = [[x] if isinstance(x, str) else x for x in (outputs, inputs, known)]
    taken = {time, episode, *(name for names in chosen for name in names or ())}
    kinds = zip(chosen, "yud", ("outputs", "inputs", "known"), strict=True)
    y, u, d = (_columns(frame, *kind, taken) for kind in kinds)
    names = (*y, *u, *d)
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise QPError.expected("column", f"{twice[0]!r} twice", "each once")
    (values, words), times = _numbers(frame, names), _times(frame, time, day_first)
    if episode is not None:
        column = _column(frame, episode)
        marks = marks + (column != column.shift()).cumsum().to_numpy()
    trajectories, dt, note = _split(values, times, marks, (len(y), len(u), len(d)))
    usual = values[(np.abs(values) <= LARGEST).all(1)]
    if noticed := (*_marked(usual, names), *_dependent(usual, names)):
        warnings.warn(f"In this log, {'; '.join(noticed)}.", UserWarning, stacklevel=2)
    units = {name: x for name, x in units.items() if name in names}
    return Log(trajectories, y, u, d, units, dt, (note, *words, *noticed))


def as_log(data: Any, n_x: int | None = None, n_d: int | None = None) -> Log:
    """Return ``data`` as a `Log`, read by `read_log` if it is none.

    A trajectory of steps in a TensorDict ends at a done flag, where the id of the trajectory
    changes, and where the next observation is not the one of the following step, as in steps
    sampled at random. Masks of padded steps are respected.

    Args:
        data: a `Log`, or as in `read_log`; or steps ``(T,)`` or ``(episodes, T)``, or a lazy stack
            or list of ``(T,)`` of different lengths, with ``observation``, ``action``, ``("next",
            "observation")`` and, for ``n_d > 0``, ``preview``, whose first entries are d_k.
        n_x: the number of outputs, the last entries of ``observation``; None for all of them.
        n_d: entries of d_k.
    """
    if _is_steps(data):
        return _named(_of_steps(data, n_x, 0 if n_d is None else n_d))
    log = data if isinstance(data, Log) else read_log(data)
    for name, size, names in (("n_x", n_x, log.outputs), ("n_d", n_d, log.known)):
        if size is not None and size != len(names):
            got = f"{size!r}, but {len(names)} of {', '.join(names) or 'none'}"
            raise QPError.expected(name, got, "the log's own", f"Omit {name}.")
    return log


def folds(trajectories: Sequence[Trajectory], count: int) -> list[list[Trajectory]]:
    """Cut all steps into ``count`` consecutive parts of nearly equal length."""
    total = sum(trajectory.steps for trajectory in trajectories)
    bounds = [total * i // count for i in range(count + 1)]
    parts: list[list[Trajectory]] = [[] for _ in range(count)]
    begin = 0
    for trajectory in trajectories:
        steps = trajectory.steps
        for part, first, last in zip(parts, bounds[:-1], bounds[1:], strict=True):
            start, stop = max(first - begin, 0), min(last - begin, steps)
            if start < stop:
                whole = stop - start == steps
                part.append(trajectory if whole else trajectory.between(start, stop))
        begin += steps
    return parts


# Tables


def _split(
    values: Any, times: np.ndarray | None, marks: Any, sizes: tuple[int, int, int]
) -> tuple[list[Trajectory], float | None, str]:
    """Return the trajectories in rows ``values`` [y, u, d], the time of a step, and a note."""
    n_y = sizes[0]
    fits = np.abs(values) <= LARGEST  # False for NaN
    whole, measured = fits.all(1), fits[:, :n_y].all(1)
    inside = marks[1:] == marks[:-1]
    gaps, dt = _gaps(times, inside, marks)
    steps = whole[:-1] & measured[1:] & inside & ~gaps
    edges = np.flatnonzero(np.diff(np.concatenate(([0], steps, [0])))).reshape(-1, 2)
    if not len(edges):
        got = f"{len(values)} rows, of which no two in a row are complete"
        raise QPError.expected("data", got, "consecutive rows with a number in each column")
    used = np.concatenate((steps, [False])) | np.concatenate(([False], steps))
    y, u, d = torch.as_tensor(values).split(sizes, dim=1)
    trajectories = [Trajectory(y[i : k + 1], u[i:k], d[i:k]) for i, k in edges.tolist()]
    counted = f"{_count(gaps.sum(), 'gap')}, {_count(len(edges), 'trajectory')}"
    note = f"{_count(len(values), 'row')}: {counted}, {1 - used.mean():.1%} of rows dropped"
    return trajectories, dt, note


def _count(number: int, noun: str) -> str:
    return f"{number} {noun if number == 1 else f'{noun}s'.replace('ys', 'ies')}"


def _frame(part: Any) -> pd.DataFrame:
    import pandas as pd

    if isinstance(part, str | Path):
        try:
            return _read_csv(Path(part))
        except (OSError, ValueError, Warning) as error:
            got = f"{part}, which cannot be read ({error})"
            raise QPError.expected("data", got, "a CSV file") from error
    if isinstance(part, pd.DataFrame):
        timed = isinstance(part.index, pd.DatetimeIndex | pd.TimedeltaIndex | pd.PeriodIndex)
        return part.assign(**{TIME_INDEX: part.index}) if timed else part.copy()
    if not isinstance(part, Mapping):
        raise QPError.expected("data", type(part).__name__, KINDS)
    columns: dict[str, pd.Series] = {}
    for name, value in part.items():
        array = np.asarray(ungraded(str(name), value))
        if array.ndim not in (1, 2):
            raise QPError.expected(str(name), f"shape {array.shape}", "shape (T,) or (T, n)")
        for i, column in enumerate(array.reshape(len(array), -1).T):
            single = array.ndim == 1 or array.shape[1] == 1
            columns[name if single else f"{name}{i + 1}"] = pd.Series(column)
    longest = max((len(column) for column in columns.values()), default=0)
    for name, column in columns.items():
        if len(column) < longest - 1:
            expected = f"{longest} rows, as others, or {longest - 1}"
            raise QPError.expected(str(name), f"{len(column)} rows", expected)
    return pd.DataFrame(columns)  # which fills a missing last row with NaN


def _read_csv(path: Path) -> pd.DataFrame:
    """Read a CSV file by its header; an empty field beyond that is a delimiter too many."""
    import pandas as pd

    with path.open(encoding="utf-8-sig", newline="") as file, warnings.catch_warnings():
        warnings.simplefilter("error", pd.errors.ParserWarning)  # that fields would be lost
        header = next(filter(None, csv.reader(file, skipinitialspace=True)), [])
        file.seek(0)  # no address in the internet
        frame = pd.read_csv(file, index_col=False, skipinitialspace=True, low_memory=False)
    return frame.set_axis(header, axis=1)  # without pandas's other names for what is there twice


def _bare(header: Any) -> str:
    """Return a header without its unit."""
    return HEADER.sub(r"\1", str(header)).strip()


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
    """Return the columns as float64, with NaN for words, and notes on these.

    Text with digits that is no number would be lost, and is refused.
    """
    import pandas as pd

    values, notes = np.empty((len(frame), len(names))), []
    for i, name in enumerate(names):
        column = _column(frame, name)
        numbers: Any = pd.to_numeric(column, errors="coerce")
        values[:, i] = np.asarray(numbers, dtype=float)
        words = column[numbers.isna() & column.notna()].astype(str)
        odd = words[words.str.contains(r"\d") & (words.map(_bare) != name)]
        if len(odd):
            got, want = f"{name} with {odd.iloc[0]!r} in {_count(len(odd), 'row')}", "1234.5"
            remedy = (
                "Pass a DataFrame: pandas.read_csv(.., decimal=',') reads decimal commas, and "
                "thousands=',' separators; units belong in the header, as in 'q [kW]'."
            )
            raise QPError.expected("column", got, want, remedy)
        if not np.isfinite(values[:, i]).any():
            got = f"{name}, without a number"
            raise QPError.expected("column", got, "a column of numbers")
        if len(words):
            rows = _count(len(words), "row")
            notes.append(f"{name} is no number in {rows}, as in {words.iloc[0]!r}")
    return values, notes


def _column(frame: pd.DataFrame, name: str) -> Any:
    count = list(frame.columns).count(name)
    if count != 1:
        got = f"{name!r}, which is {'missing' if count == 0 else 'there twice'}"
        expected = f"one of {', '.join(dict.fromkeys(frame.columns))}"
        raise QPError.expected("column", got, expected)
    return frame[name]


def _times(frame: pd.DataFrame, name: str | None, day_first: bool | None) -> np.ndarray | None:
    """Return the times, dates in seconds; None without a column of times."""
    import pandas as pd

    if name is None and TIME_INDEX not in frame.columns:
        return None
    column = _column(frame, name := name or TIME_INDEX).infer_objects()
    if isinstance(column.dtype, pd.PeriodDtype):
        column = column.dt.to_timestamp()
    ways = [column]
    if column.dtype.kind not in "mM":
        numbers: Any = pd.to_numeric(column, errors="coerce")
        if numbers.notna().any():
            return np.asarray(numbers, dtype=float)
        column = column.where(column.astype(str).map(_bare) != name)  # a header in between
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
    warnings.warn(text, UserWarning, stacklevel=3)
    return times[int(day > month)]


def _dates(column: pd.Series, day_first: bool | None) -> list[pd.Series]:
    """Return the dates in each way that they can be read."""
    import pandas as pd

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


def _gaps(
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


def _marked(values: np.ndarray, names: Sequence[str]) -> list[str]:
    """Name the columns with a number that repeats and is far from all others, as -9999."""
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
    return notes


def _dependent(values: np.ndarray, names: Sequence[str]) -> list[str]:
    """Name the columns that are constant or a linear function of columns before them."""
    middle = values.mean(0)
    X = values - middle
    size = np.sqrt(np.square(X).mean(0))
    notes: list[str] = []
    kept: list[int] = []
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


# Steps of TorchRL


def _is_steps(data: Any) -> bool:
    """Return True for TensorDicts, without importing TensorDict."""
    if (library := sys.modules.get("tensordict")) is None:
        return False
    parts = data if isinstance(data, list | tuple) else [data]
    return len(parts) > 0 and all(isinstance(part, library.TensorDictBase) for part in parts)


def _named(
    trajectories: Sequence[Trajectory],
    outputs: Sequence[str] | None = None,
    inputs: Sequence[str] | None = None,
    known: Sequence[str] | None = None,
) -> Log:
    """Return the log of trajectories, by default with the names y1, .., u1, .. and d1, ..."""
    names = []
    for kind, part in {"outputs": outputs, "inputs": inputs, "known": known}.items():
        letter, size = "yud"[len(names)], trajectories[0][len(names)].shape[-1]
        if part is not None and len(part) != size:
            raise QPError.expected(kind, f"{list(part)}", f"{size} names")
        names.append(tuple(part or (f"{letter}{i + 1}" for i in range(size))))
    return Log(trajectories, *names)


def _of_steps(data: Any, n_x: int | None, n_d: int) -> list[Trajectory]:
    """Return the trajectories in logged steps, in order; see `as_log`."""
    check_whole("n_d", n_d, 0)
    if n_x is not None:
        check_whole("n_x", n_x, 1)
    trajectories = [one for part in logs(data) for one in _of_rows(part, n_x, n_d)]
    sizes = {(one.y.shape[1], one.u.shape[1]) for one in trajectories}
    if len(sizes) > 1:
        got = f"logs of (n_x, n_u) = {', '.join(map(str, sorted(sizes)))}"
        raise QPError.expected("trajectories", got, "logs of the same sizes", REMEDY)
    if not trajectories:
        raise QPError.expected("trajectories", "no steps", "logged steps", REMEDY)
    return trajectories


def _of_rows(data: Any, n_x: int | None, n_d: int) -> list[Trajectory]:
    """Return the trajectories in steps ``(T,)`` or ``(episodes, T)``."""
    if data.batch_dims not in (1, 2):
        got = f"shape {tuple(data.shape)}"
        raise QPError.expected("trajectories", got, "shape (T,) or (episodes, T)", REMEDY)
    steps = data if data.batch_dims == 2 else data.unsqueeze(0)
    valid = valid_steps(steps)
    y = _entry(steps, ("observation",), valid, n_x)
    u = _entry(steps, ("action",), valid)
    following = _entry(steps, NEXT, valid, n_x)
    if y.shape[-1] != following.shape[-1]:
        got = f"{following.shape[-1]} entries, but {y.shape[-1]} in observation"
        raise QPError.expected(_name(NEXT), got, "the same number in both")
    d = u.new_zeros(*u.shape[:-1], 0)
    if n_d:
        d = _entry(steps, ("preview",), valid, n_d, first=True)
    valid, ends = cuts(steps, n_x)
    trajectories = []
    for row in range(len(y)):
        start = 0
        for stop in (*(ends[row, :-1].nonzero().flatten() + 1).tolist(), y.shape[1]):
            if valid[row, start:stop].all():
                outputs = torch.cat((y[row, start:stop], following[row, stop - 1 : stop]))
                trajectories.append(Trajectory(outputs, u[row, start:stop], d[row, start:stop]))
            start = stop
    return trajectories


def cuts(steps: Any, n_x: int | None = None) -> tuple[Tensor, Tensor]:
    """Return the steps that `as_log` keeps, and those that end a trajectory, ``(episodes, T)``."""
    y, following = (steps[key][..., -(n_x or 0) :].cpu() for key in ("observation", NEXT))
    valid, ends = valid_steps(steps), _flags(steps, ENDS, default=False)
    ends[:, :-1] |= (following[:, :-1] != y[:, 1:]).any(-1)
    for key in IDS:
        if (ids := steps.get(key, None)) is not None:
            ids = _narrow(key, ids, steps.shape)
            ends[:, :-1] |= ids[:, 1:] != ids[:, :-1]
    ends |= ~valid
    ends[:, :-1] |= ~valid[:, 1:]
    return valid, ends


def logs(data: Any) -> list[Any]:
    """Return the logs in a list, or in a lazy stack of logs of different lengths; else one."""
    if isinstance(data, list | tuple):
        return list(data)
    return list(data.unbind(0)) if -1 in getattr(data, "shape", ()) else [data]


def valid_steps(steps: Any) -> Tensor:
    """Return True for the steps that are not padding, in the log's shape."""
    return _flags(steps, MASKS, default=True)


def _entry(
    steps: Any, key: tuple[str, ...], valid: Tensor, width: int | None = None, first: bool = False
) -> Tensor:
    """Return the first or last ``width`` entries under ``key`` in float64, ``(episodes, T, n)``."""
    name, value = _name(key), steps.get(key, None)
    if value is None:
        present = ", ".join(_name(x) for x in steps.keys(True, True)) or "nothing"
        raise QPError.expected("trajectories", f"only {present}", f"an entry {name}", REMEDY)
    real = isinstance(value, Tensor) and not value.is_complex()
    if not real or value.ndim != steps.ndim + 1 or value.shape[-1] < (width or 1):
        got = f"shape {tuple(value.shape)}" if isinstance(value, Tensor) else type(value).__name__
        wanted = f"a real tensor {(*steps.shape, 'n')} with n >= {width or 1}"
        raise QPError.expected(name, got, wanted, REMEDY)
    value = ungraded(name, value).detach().to("cpu", torch.float64)
    if width is not None:
        value = value[..., :width] if first else value[..., value.shape[-1] - width :]
    bad = (~value.isfinite() & valid.unsqueeze(-1)).nonzero()
    if len(bad):
        *step, entry = bad[0].tolist()
        got = f"{value[tuple(bad[0])].item()} at step {tuple(step)}, entry {entry}"
        remedy = "Cut the steps that were not measured, and mark the last ones before as done."
        raise QPError.expected(name, got, "finite numbers", remedy)
    large = value.masked_fill(~valid.unsqueeze(-1), 0.0).abs().amax() if value.numel() else 0.0
    if large > LARGEST:
        remedy = "Squares of larger numbers overflow: choose larger units."
        raise QPError.expected(name, f"{large:.3g}", f"numbers up to {LARGEST:g}", remedy)
    return value


def _narrow(key: tuple[str, ...], value: Any, batch: torch.Size) -> Tensor:
    """Return one flag or id for each step; there are several for several agents, say."""
    if not isinstance(value, Tensor) or value.numel() != batch.numel():
        got = f"shape {tuple(value.shape)}" if isinstance(value, Tensor) else type(value).__name__
        expected = f"shape {tuple(batch)} or {(*batch, 1)}"
        raise QPError.expected(_name(key), got, expected, "Pass one for each step.")
    return value.reshape(batch).cpu()


def _flags(steps: Any, keys: tuple[tuple[str, ...], ...], default: bool) -> Tensor:
    """Return flags ``(episodes, T)``: all of the masks, or any of the ends of trajectories."""
    flags = torch.full(steps.shape, default)
    for key in keys:
        if (value := steps.get(key, None)) is not None:
            value = _narrow(key, value, steps.shape).bool()
            flags = flags & value if default else flags | value
    return flags


def _name(key: Any) -> str:
    return key if isinstance(key, str) else ".".join(key)
