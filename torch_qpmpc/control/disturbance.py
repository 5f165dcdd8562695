"""Constant disturbances that an observer estimates, and a plant's steady states with them.

    x+ = A x + B u + E d + B_w w + offset,   y = C x + C_w w,   w+ = w

With as many entries of w as outputs, a stable observer and a target that respects its estimate, the
outputs settle at the target whatever constant disturbance acts (Pannocchia and Rawlings,
"Disturbance models for offset-free MPC", AIChE J. 49, 2003). The pair is detectable if and only if
the model is, and the matrix [A - I, B_w; C, C_w] has full column rank.

The steady states (x_s, u_s) for w and known signals d are the affine set

    [x_s; u_s] = Z v + M [w; d; 1],   Z a basis of the null space of [A - I, B].

The target is the nearest to the set-point, and of several the one with the least
(u_s - u_0)'R(u_s - u_0), where u_0 is what free inputs rest near. Where several have the same
outputs with a weight, v = [a; f]: a determines these, and f is the distance from the least one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import scipy  # imports its parts at their first use

from torch_qpmpc.control.scaling import Scaling, but_rounding
from torch_qpmpc.control.state_space import Array, StateSpace
from torch_qpmpc.errors import QPError

#: A singular value below this fraction of the largest is zero.
RANK = 1e-9
#: Weighted outputs whose responses differ by a smaller part of them are one.
FLAT = RANK**0.5
#: Sizes that differ by a smaller part of them are equal.
TIE = 1e-6
#: A length that is no divisor.
TINY = 1e-300
#: Modes this near to one integrate: an output disturbance is hard to tell from their drift.
INTEGRATES = 1e-2
#: A singular value below tells disturbances from the state too badly.
HIDDEN = 1e-3
#: The least weight of a direction of f, relative to the largest.
REGULARISATION = 1e-3
OUTPUT, PREFIX = "output", "disturbance of "


class Disturbances(NamedTuple):
    """B_w ``(n, n_w)`` and C_w ``(n_y, n_w)``, and a name for each entry of w.

    ``changes`` are the standard deviations of w+ - w that a log shows, zero where it shows none,
    and ``wanted`` is what `choose` was asked for.
    """

    B: Array
    C: Array
    names: tuple[str, ...]
    changes: Array | float = 0.0
    wanted: Any = "auto"


def choose(plant: StateSpace, wanted: Any = "auto", scaling: Scaling | None = None) -> Disturbances:
    """Return the disturbances that an observer estimates, one for each output.

    Args:
        plant: the model.
        scaling: the sizes of its signals, by default of a plant without bounds.
        wanted: ``"auto"``: those that the log shows, one at an input for each integrating mode, and
            at the outputs for the others. A mapping from outputs to ``"output"`` or the name of an
            input; outputs that are left out have none. None: no disturbances.

    Raises:
        QPError: a name is unknown, or the disturbances or the model are not detectable.
    """
    n, _, n_y, _ = plant.sizes
    if wanted is None:
        return Disturbances(np.zeros((n, 0)), np.zeros((n_y, 0)), (), wanted=None)
    normal = (scaling or Scaling.of(plant)).plant(plant)
    check_observable(normal)
    kinds: Mapping[str, Any] = wanted if isinstance(wanted, Mapping) else {}
    if isinstance(wanted, str) and wanted == "auto":
        logged = normal.drifts
        for drifts, near in product((logged, logged[:, :0]), (INTEGRATES, RANK)):
            kinds = _automatic(normal, near, drifts)
            w, least = _placed(normal, kinds), HIDDEN * bool(drifts.size)
            if _hidden(normal, w) is None and told_apart(normal, w)[0] > least:
                break
    elif not isinstance(wanted, Mapping):
        raise QPError.expected("disturbances", repr(wanted), "'auto', None or a mapping")
    if (hidden := _hidden(normal, _placed(normal, kinds))) is not None:
        got = f"{dict(kinds)}, whose {hidden} cannot be told from a mode at 1"
        remedy = "At an integrating mode take a disturbance of its input, and at others one of the "
        remedy += "output; 'auto' chooses so. There can be no more disturbances than outputs."
        raise QPError.expected("disturbances", got, "detectable disturbances", remedy)
    return _placed(plant, kinds)._replace(wanted=wanted)


def _placed(plant: StateSpace, kinds: Mapping[str, Any]) -> Disturbances:
    """Return the disturbances of a mapping from outputs to "output", an input or a drift's number.

    A drift has the unit of its output, which it moves by one in the end.
    """
    (n, _, n_y, _), n_w = plant.sizes, plant.drifts.shape[1]
    columns, names, changes = [], [], []
    for output, kind in kinds.items():
        if output not in plant.outputs or kind not in (OUTPUT, *plant.inputs, *range(n_w)):
            want = f"an output among {plant.outputs}, 'output' or an input among {plant.inputs}"
            raise QPError.expected("disturbances", f"{output!r}: {kind!r}", want)
        row, name, change = plant.outputs.index(output), output, 0.0
        if kind == OUTPUT:
            column = np.eye(n + n_y)[n + row]
        elif kind in plant.inputs:
            column, name = np.pad(plant.B[:, plant.inputs.index(kind)], (0, n_y)), kind
        else:
            size = _effect(plant, plant.drifts)[row, kind] or 1.0
            column, change = plant.drifts[:, kind] / size, abs(size)
        columns.append(column)
        names.append(f"{PREFIX}{name}")
        changes.append(change)
    B, C = np.split(np.array(columns).reshape(-1, n + n_y).T, [n])
    return Disturbances(B, C, (*names,), np.array(changes))


def told_apart(plant: StateSpace, w: Disturbances) -> tuple[float, Array]:
    """Return the least singular value of [A - I, B_w; C, C_w], and its direction."""
    matrix = np.block([[plant.A - np.eye(len(plant.A)), w.B], [plant.C, w.C]])
    _, sizes, V = np.linalg.svd(matrix / np.maximum(np.linalg.norm(matrix, axis=0), TINY))
    return float(sizes[-1]), V[-1]


def _effect(plant: StateSpace, drifts: Array) -> Array:
    """Return what drifts move outputs by in the end, or nearly so, ``(n_y, n_w)``."""
    B, C = np.split(drifts, [len(plant.A)])
    return plant.C @ np.linalg.solve((1 + INTEGRATES) * np.eye(len(B)) - plant.A, B) + C


def check_observable(plant: StateSpace) -> None:
    """Raise `QPError` unless (A, C) is detectable."""
    for eigenvalue, mode in unseen_modes(plant.A, plant.C):
        state = int(np.abs(mode).argmax())
        remedy = "Measure a signal that shows it, or remove it from the model."
        at = f"{eigenvalue if eigenvalue.imag else eigenvalue.real:.3g}"
        got = f"a mode at {at}, mostly in state {state}, that no output shows"
        raise QPError.expected("model", got, "a detectable model", remedy)


def unseen_modes(A: Array, C: Array) -> list[tuple[complex, Array]]:
    """Return eigenvalues of A that do not decay, with their modes, that y = C x does not show."""
    values = [x for x in np.linalg.eigvals(A) if abs(x) >= 1 - 1e-9]
    pairs = [(complex(x), null_direction(A - x * np.eye(len(A)), C)) for x in values]
    return [(x, mode) for x, mode in pairs if mode is not None]


def null_direction(balance: Array, *shown: Array) -> Array | None:
    """Return x with balance x = 0 and S x = 0 for each S of ``shown``, None if only zero has it.

    The rows of each S, then all columns are scaled to length one: no unit decides the rank.
    """
    rows = [S / np.maximum(np.linalg.norm(S, axis=1, keepdims=True), TINY) for S in shown]
    matrix = np.vstack((balance, *rows))
    columns = np.maximum(np.linalg.norm(matrix, axis=0), TINY)
    _, sizes, V = np.linalg.svd(matrix / columns)
    full = len(sizes) == len(V) and sizes[-1] > RANK * sizes[0]
    return None if full else V[-1].conj() / columns


def _automatic(plant: StateSpace, tolerance: float, drifts: Array) -> dict[str, Any]:
    """Choose drifts, inputs for the modes at one, and outputs for the rest, one for each output."""
    (n, _, n_y, _), n_w = plant.sizes, drifts.shape[1]
    U, sizes, _ = np.linalg.svd(plant.A - np.eye(n))
    modes = U[:, sizes <= tolerance * max(sizes[0], 1.0)].T  # of A', near one
    taken = _independent(modes @ plant.B)[: n_y - n_w]
    moved = np.pad(plant.B[:, taken], ((0, n_y), (0, 0)))
    columns = np.hstack((np.vstack((plant.A - np.eye(n), plant.C)), moved, drifts))
    # Output disturbances fill what the other columns leave.
    rest = scipy.linalg.null_space(columns.T, rcond=RANK)[n:].T
    kinds = {plant.outputs[i]: OUTPUT for i in _independent(rest)[: n_y - len(taken) - n_w]}
    if n_w:
        free = [i for i, name in enumerate(plant.outputs) if name not in kinds]
        pairs = scipy.optimize.linear_sum_assignment(-np.abs(_effect(plant, drifts)[free]))
        kinds |= {plant.outputs[free[i]]: int(k) for i, k in zip(*pairs, strict=True)}
    others = (name for name in plant.outputs if name not in kinds)
    kinds |= zip(others, (plant.inputs[i] for i in taken), strict=False)
    return {name: kinds[name] for name in plant.outputs if name in kinds}


def _independent(matrix: Array) -> list[int]:
    """Return columns that are independent of each other, the largest first, and ties in order."""
    matrix = matrix * (1 - TIE * np.arange(matrix.shape[1]))
    _, R, order = map(np.asarray, scipy.linalg.qr(matrix, mode="economic", pivoting=True))
    sizes = np.abs(np.diag(R))
    return [int(i) for i, x in zip(order, sizes, strict=False) if x > RANK * max(sizes[0], 1.0)]


def _hidden(plant: StateSpace, placed: Disturbances) -> str | None:
    """Return the name of a disturbance that cannot be told from an integrator, if any."""
    n, shown = len(plant.A), np.hstack((plant.C, placed.C))
    direction = null_direction(np.hstack((plant.A - np.eye(n), placed.B)), shown)
    return None if direction is None else placed.names[int(np.abs(direction[n:]).argmax())]


def _split(Q: Array, Y: Array) -> tuple[Array, Array]:
    """Return orthonormal bases of the v for which Y v has a weight in Q, and of those without.

    The sizes of the weights decide nothing.
    """
    root = np.sqrt(np.diag(Q))
    sizes, V = np.linalg.eigh(Q / np.maximum(np.outer(root, root), TINY))
    rows = (V[:, sizes > RANK].T * root) @ Y
    rows = rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), FLAT)
    _, sizes, V = np.linalg.svd(rows)
    rank = int((sizes > FLAT).sum())
    return V[:rank].T, V[rank:].T


@dataclass(frozen=True, eq=False)
class Steady:
    """The steady states of a plant, as linear maps of [w; d; 1]."""

    #: The maps of v, without a unit, to x_s, u_s and y_s, with n_v columns.
    X: Array
    U: Array
    Y: Array
    #: The maps of [w; d; 1] to them, with n_w + n_d + 1 columns.
    x: Array
    u: Array
    y: Array
    W: Array  # the weight of f, ``(n_f, n_f)``: the inputs', in place of zero that of their sizes

    @cached_property
    def maps(self) -> tuple[Array, Array]:
        """The maps of v and of [w; d; 1] to [x_s; u_s; y_s]."""
        return np.vstack((self.X, self.U, self.Y)), np.vstack((self.x, self.u, self.y))

    @classmethod
    def of(
        cls, plant: StateSpace, w: Disturbances, Q: Array, R: Array, u_0: Array, sizes: Scaling
    ) -> Steady:
        """Return the steady states of ``plant`` with disturbances ``w`` and the weights Q and R.

        Free inputs rest near u_0 ``(m,)``, and ``sizes`` are those of the plant's signals.

        Raises:
            QPError: no input moves a mode at one.
        """
        n, m, _, n_d = plant.sizes
        normal = sizes.plant(plant)
        balance = np.hstack((normal.A - np.eye(n), normal.B))
        if (still := null_direction(normal.A.T - np.eye(n), normal.B.T)) is not None:
            name = plant.outputs[int(np.abs(normal.C @ still).argmax())]
            remedy = f"Read {name} of a log as known or not at all; pass a model's constant by E."
            got = f"a mode at 1 that no input moves, as {name} shows"
            raise QPError.expected("model", got, "a model with a steady state", remedy)
        Z = scipy.linalg.null_space(balance, rcond=RANK)
        Z = np.where(np.abs(Z) < RANK, 0.0, Z)  # rounding would let a bound hold by a huge v
        loads = np.hstack((w.B, plant.E, plant.offset[:, None])) / sizes.x[:, None]
        M = -np.linalg.pinv(balance, rcond=RANK) @ loads
        X, U, Y, x, u = Z[:n], Z[n:], normal.C @ Z[:n], M[:n], M[n:]
        y = normal.C @ x
        R = R * np.outer(sizes.u, sizes.u) if R.any() else np.eye(m)
        V, F = _split(Q * np.outer(sizes.y, sizes.y), Y)
        W = F.T @ U.T @ R @ U @ F
        if F.size:
            costs, V_f = np.linalg.eigh(W)
            least = REGULARISATION * max(costs[-1], RANK * np.linalg.norm(R, 2))
            W = V_f * np.maximum(costs, least) @ V_f.T
            least = -np.linalg.solve(W, F.T @ U.T @ R)  # f of the least u'R u, for u without it
            T, off = np.hstack((V + F @ least @ U @ V, F)), u.copy()
            off[:, -1] -= u_0 / sizes.u
            x, y, u = (of + basis @ F @ least @ off for of, basis in ((x, X), (y, Y), (u, U)))
            X, U, Y = X @ T, U @ T, Y @ T
            Y[:, -len(W) :][np.abs(Y[:, -len(W) :]) < RANK] = 0.0
            U[np.abs(U) < RANK] = 0.0
        size = np.concatenate((sizes.x, sizes.u, sizes.y))[:, None]
        parts = np.vstack((X, U, Y)), np.vstack((x, u, y))
        maps = (but_rounding(part, np.abs(part).max(0)) for part in parts)  # it would set lengths
        (X, U, Y), (x, u, y) = (np.split(size * part, (n, n + m)) for part in maps)
        return cls(X, U, Y, x, u, y + np.hstack((w.C, np.zeros((len(w.C), n_d + 1)))), W)

    @property
    def n_a(self) -> int:
        """The number of entries of a, which determine the outputs with a weight."""
        return self.Y.shape[1] - len(self.W)

    @property
    def anchors(self) -> int:
        """The length of f_0, see `torch_qpmpc.control.lowering`: f's if outputs have a weight."""
        return len(self.W) if self.n_a else 0
