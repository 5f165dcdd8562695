"""A plant's linear model and its signals by name, read from the forms that users have."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy.linalg
import torch

from torch_qpmpc.checks import check_number
from torch_qpmpc.errors import QPError
from torch_qpmpc.identification.identification import Identified
from torch_qpmpc.identification.learned import LearnedModel
from torch_qpmpc.identification.subspace import visited
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.mpc.nonlinear import linearised
from torch_qpmpc.mpc.validation import as_tensor, read_numbers

Array = np.ndarray
#: The most rows of errors that a model keeps.
MOST_ERRORS = 2000
WANTED = "(A, B), (A, B, C_y), a control.StateSpace, scipy's dlti, or an identification"


@dataclass(frozen=True, eq=False)
class StateSpace:
    """A discrete linear model, x+ = A x + B u + E d + offset with outputs y = C x.

    Attributes:
        A, B, C, E, offset: ``(n, n)``, ``(n, m)``, ``(n_y, n)``, ``(n, n_d)`` and ``(n,)``; d are
            known signals, such as a measured disturbance or a price.
        dt: the sampling time, or None.
        inputs, outputs, known, units: names of the entries of u, y and d, and units by name.
        noise: L ``(n, n_y)`` and S ``(n_y, n_y)`` of an identification, see `Innovations`.
        visited: mean ``(n,)`` and covariance ``(n, n)`` of the states in its log.
        means: the means of its inputs and known signals, by name.
        errors: its errors of held-out predictions 1, .., N steps ahead, ``(rows, N, n_y)``.
        drifts: [B_w; C_w] ``(n + n_y, n_w)`` of the disturbances that its log shows; they change by
            one in the root mean square of the steps.
        dynamics: the function x+ = f(x, u) or f(x, u, d) of a nonlinear model, which is linearised
            at the ``point`` [d; x; u]; None of a linear one.

    Raises:
        QPError: the shapes do not match, or the names do not.
    """

    A: Array
    B: Array
    C: Array
    E: Array
    offset: Array
    dt: float | None
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    known: tuple[str, ...]
    units: Mapping[str, str] = field(default_factory=dict)
    noise: tuple[Array, Array] | None = None
    visited: tuple[Array, Array] | None = None
    means: Mapping[str, float] = field(default_factory=dict)
    errors: Array | None = None
    drifts: Any = None
    dynamics: Any = None
    point: Any = None

    def __post_init__(self) -> None:
        n, m, n_y, n_d = len(self.A), *map(len, (self.inputs, self.outputs, self.known))
        shapes = {"A": (n, n), "B": (n, m), "E": (n, n_d), "C_y": (n_y, n)}
        for name, shape in shapes.items():
            if (got := getattr(self, name[0]).shape) != shape:
                remedy = "Each column of B and E, and each row of C_y, has one name."
                raise QPError.expected(name, f"shape {got}", f"{shape}", remedy)
        if self.drifts is None:
            object.__setattr__(self, "drifts", np.zeros((n + n_y, 0)))
        names = (*self.inputs, *self.outputs, *self.known)
        if wrong := [x for x in names if not isinstance(x, str) or names.count(x) > 1]:
            remedy = "Inputs, outputs and known signals are addressed by name."
            raise QPError.expected("names", f"{wrong[0]!r}", "different strings", remedy)

    @property
    def sizes(self) -> tuple[int, int, int, int]:
        """n, m, n_y and n_d."""
        return len(self.A), self.B.shape[1], len(self.C), self.E.shape[1]

    def after(self, x: Array, u: Array, d: Array) -> Array:
        """Return the next x."""
        if self.dynamics is None:
            return self.A @ x + self.B @ u + self.E @ d + self.offset
        with torch.no_grad():
            after = self.dynamics(*map(torch.from_numpy, (x, u, d)[: 2 + bool(len(d))]))
        if isinstance(after, tuple):
            raise QPError.expected("model", "a stage cost beside x+", "x+ alone", "Pass Q and R.")
        return after.numpy()

    def at(self, point: Array) -> StateSpace:
        """Return the model linearised at another point; raise `QPError` if it is not finite."""
        layout = Layout(len(self.A), len(self.inputs), 1, len(self.known))
        parts = linearised(self.dynamics, layout, torch.from_numpy(point))
        d, x, u = np.split(point, np.cumsum((len(self.known), len(self.A))))
        found = *parts.values(), torch.from_numpy(self.after(x, u, d))
        if not all(part.isfinite().all() for part in found):
            got = f"x+ or its slope with NaN or inf at [d; x; u] = {point.round(6).tolist()}"
            raise QPError.expected("model", got, "a smooth function near the points of the loop")
        return replace(self, point=point, **{name: x.numpy() for name, x in parts.items()})

    def check_linear(self, what: str) -> None:
        """Raise `QPError` if a nonlinear model is to have what needs A and B."""
        if self.dynamics is not None:
            raise QPError.expected("model", "a nonlinear model", f"A and B, for {what}")

    def label(self, name: str) -> str:
        """Return ``name`` with its unit, as ``T [degC]``."""
        return f"{name} [{self.units[name]}]" if name in self.units else name

    def quantity(self, name: str, x: float) -> str:
        """Return a signal's name and value with its unit, as ``T 21 degC``."""
        value = "missing" if np.isnan(x) else f"{x:.4g} {self.units.get(name, '')}"
        return f"{name} {value}".rstrip()


def read_model(
    model: Any,
    E: Any = None,
    dt: float | None = None,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    known: Sequence[str] = (),
    prices: Collection[Any] = (),
) -> StateSpace:
    """Return a plant's model from the forms that `LinearMPC` takes.

    Args:
        model: (A, B) or (A, B, C_y) in discrete time, all states measured without C_y; a system
            with matrices A, B, C and D, such as control.StateSpace; or an `Identified`, whose names
            and dt are its log's. Of a nonlinear plant, (f, x, u) or (f, x, u, C_y): a function of
            tensors x+ = f(x, u), or f(x, u, d) with known signals, and a state and an input that
            it is linearised at first; or what `identify_nonlinear` returns.
        E: the factor of known signals, ``(n, n_d)``, in the model's own time.
        dt: the sampling time of a system; a continuous one is sampled with it, by zero-order hold.
        inputs, outputs, known: names; by default the system's own, or u1, .. and y1, ... Inputs of
            a system that are named in ``known`` become known signals. Those of an identification
            are all in ``known``; others there, such as a price, do not act on the plant.
        prices: known signals that act on no plant: what an identification says of them is noise.

    Raises:
        QPError: the model is of another kind, has a direct feedthrough, needs another dt, or has
            an argument of its own; or a known signal of an identification is missing in ``known``.
    """
    if dt is not None:
        check_number("dt", dt, lambda x: 0 < x < np.inf, "a sampling time > 0")
    named = inputs, outputs, known
    inputs, outputs, known = ([] if x is None else np.atleast_1d(x).tolist() for x in named)
    if isinstance(model, StateSpace):
        own = {"inputs": inputs or None, "outputs": outputs or None, "known": known or None}
        _check_absent("a StateSpace has its own", E=E, dt=dt, **own)
        return model
    if isinstance(model, LearnedModel):
        if model.identified is None:
            raise QPError.expected("model", "a file's", "what qm.identify_nonlinear returns")
        _check_absent("the log has its own", known=known or None)
        linear = replace(model.identified, fit=model.identified.fit._replace(plant=None))
        plant = read_model(linear, E, dt, inputs, outputs)
        return replace(plant, dynamics=model, errors=None).at(model.middle.numpy())
    if isinstance(model, Sequence) and len(model) in (3, 4) and callable(model[0]):
        _check_absent("the function has known signals as its d", E=E)
        f, x, u, *C = model
        x, u = (np.atleast_1d(_numbers(f"model[{i}]", z)) for i, z in ((1, x), (2, u)))
        own = np.zeros((len(x),) * 2), np.zeros((len(x), len(u))), *(C or [np.eye(len(x))])
        plant = read_model(own, None, None, inputs, outputs, known)
        return replace(plant, dynamics=f, dt=dt).at(np.concatenate((np.zeros(len(known)), x, u)))
    offset, units, noise, states, means, errors, drifts = None, {}, None, None, {}, None, None
    if isinstance(model, Identified):
        _check_absent("the identification has its own", E=E)
        own, C_w = model.fit.plant or (model.fit.model, np.zeros((len(model.log.outputs), 0)))
        E, B_w = np.split(own.E, [len(model.log.known)], 1)
        A, B, _, offset, C, L, S, *_ = own  # a controller has its own disturbances
        noise, states = (L, S), visited(own._replace(E=E), model.log.trajectories)
        drifts = np.vstack((B_w, C_w))
        errors = model.errors.numpy()[:: len(model.errors) // MOST_ERRORS + 1].copy()
        log, dt = model.log, _own_dt(dt, model.log.dt)
        units, signals = dict(log.units), (*log.inputs, *log.known)
        rows = torch.cat([torch.hstack((x.u, x.d)) for x in log.trajectories])
        means = dict(zip(signals, rows.nanmean(0).tolist(), strict=True))
        inputs, outputs, known = inputs or log.inputs, outputs or log.outputs, known or log.known
        if not {*known} >= {*log.known}:
            want = f"all known signals of the log, {', '.join(log.known)}"
            remedy = f"Pass known={[*log.known, *(x for x in known if x in prices)]}."
            raise QPError.expected("known", f"{list(known)}", want, remedy)
        column = {x: E[:, i] for i, x in enumerate(log.known) if x not in prices}
        E = np.stack([column.get(x, np.zeros(len(A))) for x in known], -1) if known else E
    elif isinstance(model, Sequence) and len(model) in (2, 3):
        if dt is not None:
            remedy = "scipy.signal.lti(A, B, C, D) is sampled with dt; of sampled matrices pass "
            remedy += "scipy.signal.dlti(A, B, C, D, dt=dt), without dt."
            want = "None: they are those of one step, x+ = A x + B u"
            raise QPError.expected("dt", f"{dt:g} with matrices", want, remedy)
        A, B, *rest = (_matrix(f"model[{i}]", x) for i, x in enumerate(model))
        C = rest[0] if rest else np.eye(len(A))
    else:
        A, B, E, C, dt = _of_system(model, E, dt)
        inputs = inputs or _labels(model, "input_labels", B.shape[1])
        outputs = outputs or _labels(model, "output_labels", len(C))
        if inputs and E is None and known:
            if missing := sorted({*known} - {*inputs}):
                raise QPError.expected("known", repr(missing[0]), f"inputs among {inputs}")
            names, inputs = [*inputs], [name for name in inputs if name not in known]
            B, E = (B[:, [names.index(x) for x in part]] for part in (inputs, known))
    E = np.zeros((len(A), len(known))) if E is None else _matrix("E", E)
    if E.shape[1] > len(known) and not known:
        known = [f"d{i + 1}" for i in range(E.shape[1])]
    inputs = inputs or [f"u{i + 1}" for i in range(B.shape[1])]
    outputs = outputs or [f"y{i + 1}" for i in range(len(C))]
    offset = np.zeros(len(A)) if offset is None else offset
    names = tuple(inputs), tuple(outputs), tuple(known)
    return StateSpace(A, B, C, E, offset, dt, *names, units, noise, states, means, errors, drifts)


def _check_absent(why: str, **arguments: Any) -> None:
    """Raise `QPError` for an argument that a model leaves without a meaning."""
    for name, value in arguments.items():
        if value is not None:
            raise QPError.expected(name, repr(value), f"None, as {why}")


def by_name(value: Any) -> Any:
    """Return a pandas Series with names as a dictionary, and other values as they are."""
    is_series = hasattr(value, "to_dict") and not hasattr(value, "columns")
    named = is_series and all(isinstance(x, str) for x in value.index)
    return value.to_dict() if named else value


def read_table(
    name: str, value: Any, names: Sequence[str], rows: int, least: int = 1, finite: bool = True
) -> Array:
    """Return ``(rows, len(names))`` from a mapping or DataFrame of columns, or an array.

    One row stands for all; a table that ends early holds its last row, and a longer one is cut.
    None, as a value or as a number, is missing: NaN.

    Raises:
        QPError: a name is missing or unknown, a number is not finite (unless ``finite`` is False),
            the shape is wrong, or more than one row and fewer than ``least``.
    """
    value = [None] * len(names) if value is None else by_name(value)
    if hasattr(value, "columns"):  # a DataFrame
        value = {column: value[column].to_numpy() for column in value.columns if column in names}
    if isinstance(value, Mapping):
        if {*value} != {*names}:
            got, want = f"signals {sorted(value)}", f"the signals {sorted(names)}"
            raise QPError.expected(name, got, want, "None stands for a gap." * (name == "y"))
        columns = [np.atleast_1d(_numbers(name, value[x])) for x in names]
        try:
            table = np.stack(np.broadcast_arrays(*columns), axis=-1)
        except ValueError as error:
            lengths = [len(x) for x in columns]
            raise QPError.expected(name, f"lengths {lengths}", "columns of one length") from error
    else:
        table = np.atleast_1d(_numbers(name, value))
        table = table[None] if table.ndim == 1 else table
    if table.ndim != 2 or table.shape[1] != len(names) or not len(table):
        want = f"{len(names)} numbers ({', '.join(names)}), or rows of these" if names else "None"
        raise QPError.expected(name, f"shape {table.shape}", want)
    if finite and not np.isfinite(table).all():
        raise QPError.expected(name, "NaN or inf", "finite numbers")
    if 1 < len(table) < least:
        raise QPError.expected(name, f"{len(table)} rows", f"one row, or at least {least}")
    if len(table) == 1:
        return table.repeat(rows, 0)
    return table[np.minimum(np.arange(rows), len(table) - 1)]


def read_vector(name: str, value: Any, names: Sequence[str], missing: float) -> Array:
    """Read one number for each name, from a number, a vector or a mapping; None is missing."""
    value = by_name(value)
    if isinstance(value, Mapping):
        if unknown := sorted({*value} - {*names}):
            raise QPError.expected(name, repr(unknown[0]), f"names among {', '.join(names)}")
        value = [missing if value.get(x) is None else value[x] for x in names]
    vector = _numbers(name, value)
    vector = np.full(len(names), float(vector)) if vector.ndim == 0 else vector.copy()
    if vector.shape != (len(names),) or np.isnan(vector).any():
        got = "NaN" if vector.shape == (len(names),) else f"shape {vector.shape}"
        raise QPError.expected(name, got, f"a number, or one for each of {', '.join(names)}")
    return vector


def _numbers(name: str, value: Any) -> Array:
    """Return `read_numbers` as an array, NaN for None; floats and float64 are one at once."""
    value = np.nan if value is None else value
    if isinstance(value, list | tuple):
        value = [np.nan if x is None else x for x in value]
    of_floats = isinstance(value, list) and all(type(x) is float for x in value)
    if of_floats or isinstance(value, float) or getattr(value, "dtype", None) == np.float64:
        return np.asarray(value)
    return read_numbers(name, value).detach().numpy()


def _matrix(name: str, value: Any) -> Array:
    matrix = as_tensor(name, value).detach().numpy().copy()
    if matrix.ndim != 2:
        raise QPError.expected(name, f"shape {matrix.shape}", "a matrix")
    return matrix


def _labels(system: Any, name: str, size: int) -> list[str] | None:
    labels = getattr(system, name, None)
    return list(labels) if labels is not None and len(labels) == size else None


def _of_system(system: Any, E: Any, dt: float | None) -> tuple[Any, ...]:
    """Return A, B, E, C and dt of a system, sampled if it is continuous."""
    from scipy.signal import lti  # takes a second, which most controllers need not wait

    if not hasattr(system, "A") and hasattr(system, "to_ss"):
        system = system.to_ss()
    if not all(hasattr(system, name) for name in "ABCD"):
        remedy = "Convert a transfer function to state space first."
        raise QPError.expected("model", type(system).__name__, WANTED, remedy)
    A, B, C, D = (_matrix(f"model.{name}", getattr(system, name)) for name in "ABCD")
    if D.any():
        remedy = "Sample the output before the input changes, or add the input to the state."
        raise QPError.expected("model", "a direct feedthrough D", "D = 0", remedy)
    own = getattr(system, "dt", None)
    if isinstance(system, lti) or (own is not None and own is not True and own == 0):
        if dt is None:
            remedy = "It is sampled with that, by zero-order hold."
            raise QPError.expected("dt", "None for a continuous model", "a sampling time", remedy)
        n, m = B.shape
        driven = np.hstack((A, B) if E is None else (A, B, _matrix("E", E)))
        hold = scipy.linalg.expm(dt * np.pad(driven, ((0, driven.shape[1] - n), (0, 0))))[:n]
        return hold[:, :n], hold[:, n : n + m], None if E is None else hold[:, n + m :], C, dt
    if own is None:
        remedy = "Set model.dt: 0 if it is continuous, True or a number if it is discrete."
        raise QPError.expected("model", "no time base", "a continuous or discrete model", remedy)
    if own is True:
        return A, B, E, C, dt
    return A, B, E, C, _own_dt(dt, float(own))


def _own_dt(dt: float | None, own: float | None) -> float | None:
    """Return the sampling time of a discrete model, which an argument must equal."""
    if dt is None or own is None:
        return own if dt is None else dt
    if not np.isclose(dt, own):
        remedy = "Leave dt out, or sample the model again."
        raise QPError.expected("dt", repr(dt), f"the model's own {own:g}", remedy)
    return own
