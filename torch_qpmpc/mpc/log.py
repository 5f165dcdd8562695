"""Trajectories of a plant from CSV files, DataFrames, arrays and TensorDicts, and their faults."""

from __future__ import annotations

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

if TYPE_CHECKING:
    import pandas as pd

#: The largest magnitude, whose squares are finite.
LARGEST = 1e100
#: A column is constant, or a linear function of others, up to this share of its size.
STILL = 1e-6
#: A part with at least FEWEST steps has another sampling time if its median step differs from the
#: whole log's by more than the share ONE_DT.
FEWEST, ONE_DT = 10, 0.1
#: The column of a DataFrame's index of dates.
DATES = "the index"
KINDS = "a CSV file, a DataFrame, a dict of arrays, a list of these, or a TensorDict of steps"
#: A column's header with its unit, as in ``T [degC]``.
HEADER = re.compile(r"\s*(.*?)\s*\[(.*)\]\s*")
NEXT = ("next", "observation")
REMEDY = "Pass logged steps as TorchRL's collectors and rollouts return them."
#: Flags of a step that ends its trajectory.
ENDS = (("next", "done"), ("next", "terminated"), ("next", "truncated"))
#: Keys of collectors and of `torchrl.collectors.utils.split_trajectories`.
IDS = (("collector", "traj_ids"), ("traj_ids",))
MASKS = (("collector", "mask"), ("mask",))
#: Times and step counts, whose increments are constant without a gap.
TIMES = (("time",), ("step_count",))


class Trajectory(NamedTuple):
    """Consecutive steps in float64: y ``(T + 1, n_x)``, u ``(T, n_u)`` and d ``(T, n_d)``."""

    y: Tensor
    u: Tensor
    d: Tensor

    @property
    def steps(self) -> int:
        """The number of steps, T."""
        return len(self.u)

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
        return _named(_of_steps(data, n_x, len(known or ())), outputs, inputs, known)
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


def as_log(data: Any, n_x: int | None = None, n_d: int | None = None) -> Log:
    """Return ``data`` as a `Log`, read by `read_log` if it is none.

    A trajectory of steps in a TensorDict ends at a done flag, where the id of the trajectory
    changes, and where the next observation is not the one of the following step, as in steps
    sampled at random. A step within a trajectory during which ``time`` or ``step_count`` jumps is
    left out; masks of padded steps are respected.

    Args:
        data: a `Log`, or as in `read_log`; or steps ``(T,)`` or ``(episodes, T)``, or a lazy stack
            or list of ``(T,)`` of different lengths, with ``observation``, ``action``, ``("next",
            "observation")`` and, for ``n_d > 0``, ``preview``, whose first entries are d_k.
        n_x: the number of outputs, the last entries of ``observation``; None for all of them.
        n_d: entries of d_k.

    Raises:
        QPError: as in `read_log`, or the log has other sizes.
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
    """Cut all steps into ``count`` consecutive parts of nearly equal length, for cross-validation.

    A trajectory that lies in several parts is cut.
    """
    total = sum(trajectory.steps for trajectory in trajectories)
    bounds = [total * i // count for i in range(count + 1)]
    parts: list[list[Trajectory]] = [[] for _ in range(count)]
    begin = 0
    for trajectory in trajectories:
        for part, first, last in zip(parts, bounds[:-1], bounds[1:], strict=True):
            start, stop = max(first - begin, 0), min(last - begin, trajectory.steps)
            if start < stop:
                part.append(trajectory.between(start, stop))
        begin += trajectory.steps
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
    """Return the columns of ``names``; ``y`` may stand for ``y1``, ``y2``, ..."""
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
    valid, ends = _cuts(steps, valid, (following[:, :-1] != y[:, 1:]).any(-1))
    trajectories = []
    for row in range(len(y)):
        start = 0
        for stop in (*(ends[row, :-1].nonzero().flatten() + 1).tolist(), y.shape[1]):
            if valid[row, start:stop].all():
                outputs = torch.cat((y[row, start:stop], following[row, stop - 1 : stop]))
                trajectories.append(Trajectory(outputs, u[row, start:stop], d[row, start:stop]))
            start = stop
    return trajectories


def kept_steps(steps: Any) -> Tensor:
    """Return True for the steps that `as_log` keeps, in the log's shape."""
    rows = steps if steps.batch_dims == 2 else steps.unsqueeze(0)
    jumps = (rows[NEXT][:, :-1] != rows["observation"][:, 1:]).flatten(2).any(-1)
    return _cuts(rows, valid_steps(rows), jumps)[0].reshape(steps.shape)


def _cuts(steps: Any, valid: Tensor, jumps: Tensor) -> tuple[Tensor, Tensor]:
    """Return the steps that are kept, and those that end a trajectory, ``(episodes, T)``.

    Args:
        steps: the logged steps.
        valid: True for those that are not padding.
        jumps: True where the next observation differs from the following step's,
            ``(episodes, T - 1)``.
    """
    ends = _flags(steps, ENDS, default=False)
    ends[:, :-1] |= jumps
    for key in IDS:
        if (ids := steps.get(key, None)) is not None:
            ids = _narrow(key, ids, steps.shape)
            ends[:, :-1] |= ids[:, 1:] != ids[:, :-1]
    for key in TIMES:
        if (times := steps.get(key, None)) is not None:
            valid = valid & ~_jumps(_narrow(key, times, steps.shape), ends)
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


def _jumps(times: Tensor, ends: Tensor) -> Tensor:
    """Mark the steps ``(episodes, T)`` before an end during which the time jumps."""
    eps = torch.finfo(times.dtype if times.is_floating_point() else torch.float64).eps
    times, inside = times.double(), ~ends[:, :-1]
    change = times.diff(dim=1)
    gaps = torch.zeros_like(ends)
    if inside.any():
        step = change[inside].median()
        rounding = 4 * eps * times.abs()[:, 1:]
        gaps[:, :-1] = inside & ~((change - step).abs() <= 0.5 * step.abs() + rounding)
    return gaps


def _entry(
    steps: Any, key: tuple[str, ...], valid: Tensor, width: int | None = None, first: bool = False
) -> Tensor:
    """Return the first or last ``width`` entries under ``key`` in float64, ``(episodes, T, n)``."""
    name, value = _name(key), steps.get(key, None)
    if value is None:
        present = ", ".join(_name(x) for x in steps.keys(True, True)) or "nothing"
        raise QPError.expected("trajectories", f"only {present}", f"an entry {name}", REMEDY)
    batch = tuple(steps.shape)
    wanted = f"a real tensor {(*batch, 'n')}"
    if width is not None:
        wanted += f" with n >= {width}"
    if not isinstance(value, Tensor) or value.is_complex() or value.ndim != len(batch) + 1:
        got = f"shape {tuple(value.shape)}" if isinstance(value, Tensor) else type(value).__name__
        raise QPError.expected(name, got, wanted, REMEDY)
    if value.shape[-1] < (width or 1):
        raise QPError.expected(name, f"shape {tuple(value.shape)}", wanted)
    value = value.detach().to("cpu", torch.float64)
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
    """Return one flag, id or time for each step; there are several for several agents, say."""
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
