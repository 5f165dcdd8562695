"""Logs of a plant from CSV files, DataFrames and arrays, with notes on their faults."""

from __future__ import annotations

import re
import sys
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.trajectories import LARGEST, Trajectory, read_trajectories

if TYPE_CHECKING:
    import pandas as pd

#: A column is constant, or a linear function of others, up to this share of its size.
STILL = 1e-6
#: Parts with at least so many steps whose median step differs from that of the whole log by more
#: than this share of it have another sampling time.
FEWEST, ONE_DT = 10, 0.1
#: The column of a DataFrame's index of dates.
DATES = "the index"
KINDS = "a CSV file, a DataFrame, a dict of arrays, a list of these, or a TensorDict of steps"
#: A column's header with its unit, as in ``T [degC]``.
HEADER = re.compile(r"\s*(.*?)\s*\[(.*)\]\s*")


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
) -> Log:
    """Read a log of a plant: row k has outputs y_k, the inputs u_k applied until k + 1, and d_k.

    A trajectory ends at a gap in ``time``, where ``episode`` changes, and at a row with a missing
    number. The last row of a trajectory needs only outputs.

    Args:
        data: the path of a CSV file, a DataFrame, a mapping of arrays ``(T,)`` or ``(T, n)``, or a
            list of these, one for each episode; or steps as in `identify`. A unit in a header, as
            in ``T [degC]``, is not part of the name. Arrays shorter by one row lack the last.
        outputs, inputs, known: the columns of y, u and, optionally, d; by default ``y``, ``u`` and
            ``d`` or ``y1``, ``y2``, .. and so on.
        time: the column of times, numbers or dates; by default a DataFrame's index of dates.
        episode: the column of marks that differ between episodes.

    Returns:
        The log. A `UserWarning` names columns that are constant or a linear function of others.

    Raises:
        QPError: a column is missing, named twice or without numbers, or no two consecutive rows
            are complete.

    Example:
        >>> import numpy as np, torch_qpmpc as qm
        >>> rng = np.random.default_rng(0)
        >>> rows = {"T [degC]": rng.normal(size=9), "q": rng.normal(size=9)}
        >>> rows["t"] = [0, 1, 2, 3, 4, 9, 10, 11, 12]
        >>> print(qm.read_log(rows, outputs=["T"], inputs=["q"], time="t"))
        7 steps, one step every 1: outputs T [degC]; inputs q
        9 rows: 1 gap, 2 trajectories, 0.0% of rows dropped
    """
    if _is_steps(data):
        if time is not None or episode is not None:
            want = "None for a TensorDict, whose own times and flags are used"
            raise QPError.expected("time, episode", f"{time!r} and {episode!r}", want)
        n_x = None if outputs is None else len(outputs)
        trajectories = read_trajectories(data, n_x, len(known or ()))
        return _named(trajectories, outputs, inputs, known)
    frame, marks = _table(data)
    headers = [HEADER.fullmatch(str(header)) for header in frame.columns]
    units = {match[1]: match[2] for match in headers if match}
    frame.columns = [HEADER.sub(r"\1", str(header)) for header in frame.columns]
    y = _columns(frame, outputs, "y", "outputs")
    u = _columns(frame, inputs, "u", "inputs")
    d = _columns(frame, known, "d", "known")
    names = (*y, *u, *d)
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise QPError.expected("column", f"{twice[0]!r} twice", "each once")
    values, times = _numbers(frame, names), _times(frame, time)
    if episode is not None:
        _check_column(frame, episode)
        marks = marks + (frame[episode] != frame[episode].shift()).cumsum().to_numpy()
    trajectories, dt, note = _split(values, times, marks, (len(y), len(u), len(d)))
    dependent = _dependent(values[(np.abs(values) <= LARGEST).all(1)], names)
    if dependent:
        warnings.warn(f"In this log, {'; '.join(dependent)}.", UserWarning, stacklevel=2)
    units = {name: x for name, x in units.items() if name in names}
    return Log(trajectories, y, u, d, units, dt, (note, *dependent))


def _split(
    values: Any, times: np.ndarray | None, marks: Any, sizes: tuple[int, int, int]
) -> tuple[list[Trajectory], float | None, str]:
    """Return the trajectories in rows ``values`` [y, u, d], the time of a step, and a note."""
    n_y = sizes[0]
    fits = np.abs(values) <= LARGEST  # False for NaN
    whole, measured = fits.all(1), fits[:, :n_y].all(1)
    inside = marks[1:] == marks[:-1]
    gaps, dt = _gaps(times, inside, marks[1:])
    steps = whole[:-1] & measured[1:] & inside & ~gaps
    edges = np.flatnonzero(np.diff(np.concatenate(([0], steps, [0])))).reshape(-1, 2)
    if not len(edges):
        got = f"{len(values)} rows, of which no two in a row are complete"
        raise QPError.expected("data", got, "consecutive rows with a number in each column")
    trajectories, used = [], np.zeros(len(values), dtype=bool)
    for start, stop in edges.tolist():
        y, u, d = torch.as_tensor(values[start : stop + 1]).split(sizes, dim=1)
        trajectories.append(Trajectory(y, u[:-1], d[:-1]))
        used[start : stop + 1] = True
    n_gaps, count = int(gaps.sum()), len(edges)
    note = (
        f"{len(values)} rows: {n_gaps} gap{'s' * (n_gaps != 1)}, {count} "
        f"trajector{'y' if count == 1 else 'ies'}, {1 - used.mean():.1%} of rows dropped"
    )
    return trajectories, dt, note


def as_log(data: Any, n_x: int | None = None, n_d: int | None = None) -> Log:
    """Return ``data`` as a `Log`, read by `read_log` if it is none; sizes are as in `identify`.

    Raises:
        QPError: as in `read_log`, or the log has other sizes.
    """
    if _is_steps(data):
        return _named(read_trajectories(data, n_x, n_d or 0))
    log = data if isinstance(data, Log) else read_log(data)
    for name, size, names in (("n_x", n_x, log.outputs), ("n_d", n_d, log.known)):
        if size is not None and size != len(names):
            got = f"{size!r}, but {len(names)} of {', '.join(names) or 'none'}"
            raise QPError.expected(name, got, "the log's own", f"Omit {name}.")
    return log


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

    def names(kind: str, letter: str, chosen: Sequence[str] | None, size: int) -> tuple[str, ...]:
        if chosen is not None and len(chosen) != size:
            raise QPError.expected(kind, f"{list(chosen)}", f"{size} names")
        return tuple(chosen or (f"{letter}{i + 1}" for i in range(size)))

    y, u, d = (part.shape[-1] for part in trajectories[0])
    return Log(
        trajectories,
        names("outputs", "y", outputs, y),
        names("inputs", "u", inputs, u),
        names("known", "d", known, d),
    )


def _table(data: Any) -> tuple[pd.DataFrame, np.ndarray]:
    """Return all rows, and the number of the episode of each."""
    import pandas as pd

    parts = data if isinstance(data, list | tuple) else [data]
    frames = [_frame(part) for part in parts]
    if not frames:
        raise QPError.expected("data", "an empty list", KINDS)
    marks = np.repeat(np.arange(len(frames)), [len(frame) for frame in frames])
    return pd.concat(frames, ignore_index=True), marks


def _frame(part: Any) -> pd.DataFrame:
    import pandas as pd

    if isinstance(part, str | Path):
        try:
            with Path(part).open(encoding="utf-8-sig") as file:  # no address in the internet
                return pd.read_csv(file, skipinitialspace=True)
        except (OSError, ValueError) as error:
            got = f"{part}, which cannot be read ({error})"
            raise QPError.expected("data", got, "a CSV file") from error
    if isinstance(part, pd.DataFrame):
        dated = isinstance(part.index, pd.DatetimeIndex)
        return part.assign(**{DATES: part.index}) if dated else part.copy()
    if not isinstance(part, Mapping):
        raise QPError.expected("data", type(part).__name__, KINDS)
    columns: dict[str, pd.Series] = {}
    for name, value in part.items():
        array = np.asarray(value)
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


def _columns(
    frame: pd.DataFrame, names: Sequence[str] | None, default: str, kind: str
) -> tuple[str, ...]:
    """Return the columns of ``names``, of which ``y`` may stand for ``y1``, ``y2``, ..."""
    chosen = [default] if names is None else [names] if isinstance(names, str) else list(names)
    columns = []
    for name in chosen:
        numbered = [x for x in frame.columns if re.fullmatch(rf"{re.escape(name)}\d+", x)]
        columns += [name] if name in frame.columns else numbered or [name]
    if names is None and columns == [default] and default not in frame.columns:
        columns = []
    if not columns and kind != "known":
        got = f"none, and columns {', '.join(frame.columns)}"
        remedy = f"Pass read_log(.., {kind}=[..])."
        raise QPError.expected(kind, got, f"names of columns, or {default}1, ..", remedy)
    return tuple(columns)


def _numbers(frame: pd.DataFrame, names: Sequence[str]) -> np.ndarray:
    """Return the columns as float64, with NaN for what is no number."""
    import pandas as pd

    values = np.empty((len(frame), len(names)))
    for i, name in enumerate(names):
        _check_column(frame, name)
        values[:, i] = np.asarray(pd.to_numeric(frame[name], errors="coerce"), dtype=float)
        if not np.isfinite(values[:, i]).any():
            got = f"{name}, without a number"
            raise QPError.expected("column", got, "a column of numbers")
    return values


def _check_column(frame: pd.DataFrame, name: str) -> None:
    count = list(frame.columns).count(name)
    if count != 1:
        got = f"{name!r}, which is {'missing' if count == 0 else 'there twice'}"
        expected = f"one of {', '.join(dict.fromkeys(frame.columns))}"
        raise QPError.expected("column", got, expected)


def _times(frame: pd.DataFrame, name: str | None) -> np.ndarray | None:
    """Return the times, dates in seconds; None without a column of times."""
    import pandas as pd

    if name is None and DATES not in frame.columns:
        return None
    _check_column(frame, name := name or DATES)
    column = frame[name]
    if pd.api.types.is_numeric_dtype(column):
        return column.to_numpy(dtype=float)
    try:
        dates = pd.to_datetime(column, utc=True)
    except (ValueError, TypeError) as error:
        raise QPError.expected("time", f"{name} ({error})", "numbers or dates") from error
    return (dates - dates.min()).dt.total_seconds().to_numpy()


def _gaps(
    times: np.ndarray | None, inside: np.ndarray, marks: np.ndarray
) -> tuple[np.ndarray, float | None]:
    """Return True for the steps of a trajectory across a gap, and the time of the other steps."""
    if times is None or not inside.any():
        return np.zeros_like(inside), None
    change = np.diff(times)
    dt = float(np.nanmedian(change[inside]))
    if not dt > 0:
        raise QPError.expected("time", f"steps of {dt:g}", "times that increase", "Sort the rows.")
    for mark in np.unique(marks[inside]):
        own = change[inside & (marks == mark)]
        if len(own) >= FEWEST and abs(np.nanmedian(own) - dt) > ONE_DT * dt:
            got = f"steps of {np.nanmedian(own):g} in one part, and of {dt:g} in the median"
            raise QPError.expected("time", got, "one sampling time", "Resample the data.")
    return inside & ~(np.abs(change - dt) <= 0.5 * dt), dt


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
