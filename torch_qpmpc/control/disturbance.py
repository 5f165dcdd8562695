"""Constant disturbances that an observer estimates, so that they leave no offset.

    x+ = A x + B u + E d + B_w w + offset,   y = C x + C_w w,   w+ = w

With as many entries of w as outputs, a stable observer and a target that respects its estimate, the
outputs settle at the target whatever constant disturbance acts (Pannocchia and Rawlings,
"Disturbance models for offset-free MPC", AIChE J. 49, 2003). The pair is detectable if and only if
the model is, and the matrix [A - I, B_w; C, C_w] has full column rank.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg

from torch_qpmpc.control.state_space import Array, StateSpace
from torch_qpmpc.errors import QPError

#: A singular value below this fraction of the largest is zero.
RANK = 1e-9
#: A length that is no divisor.
TINY = 1e-300
#: Modes this near to one integrate: an output disturbance is hard to tell from their drift.
INTEGRATES = 1e-2
OUTPUT = "output"


class Disturbances(NamedTuple):
    """B_w ``(n, n_w)`` and C_w ``(n_y, n_w)``, and a name for each entry of w."""

    B: Array
    C: Array
    names: tuple[str, ...]


def choose(plant: StateSpace, wanted: Any = "auto") -> Disturbances:
    """Return the disturbances that an observer estimates, one for each output.

    Args:
        plant: the model.
        wanted: ``"auto"``: one at an input for each integrating mode, and at the outputs for the
            others. A mapping from outputs to ``"output"`` or the name of an input;
            outputs that are left out have none. None: no disturbances.

    Raises:
        QPError: a name is unknown, or the disturbances or the model are not detectable.
    """
    n, _, n_y, _ = plant.sizes
    if wanted is None:
        return Disturbances(np.zeros((n, 0)), np.zeros((n_y, 0)), ())
    check_observable(plant)
    if isinstance(wanted, str) and wanted == "auto":
        placed = _placed(plant, _automatic(plant, INTEGRATES))
        if _hidden(plant, placed) is None:
            return placed
        wanted = _automatic(plant, RANK)
    elif not isinstance(wanted, Mapping):
        raise QPError.expected("disturbances", repr(wanted), "'auto', None or a mapping")
    placed = _placed(plant, wanted)
    if (hidden := _hidden(plant, placed)) is not None:
        got = f"{dict(wanted)}, of which the {hidden} cannot be told from a mode at 1"
        remedy = (
            "At an integrating mode take a disturbance of its input, and at others one of the "
            "output; 'auto' chooses so. There can be no more disturbances than outputs."
        )
        raise QPError.expected("disturbances", got, "detectable disturbances", remedy)
    return placed


def _placed(plant: StateSpace, wanted: Mapping[str, str]) -> Disturbances:
    """Return the disturbances of a mapping from outputs to "output" or inputs."""
    n, _, n_y, _ = plant.sizes
    B, C, names = [], [], []
    for output, kind in wanted.items():
        if output not in plant.outputs or kind not in (OUTPUT, *plant.inputs):
            want = f"an output among {plant.outputs}, 'output' or an input among {plant.inputs}"
            raise QPError.expected("disturbances", f"{output!r}: {kind!r}", want)
        at_output = kind == OUTPUT
        B.append(np.zeros(n) if at_output else plant.B[:, plant.inputs.index(kind)])
        C.append(np.eye(n_y)[plant.outputs.index(output)] if at_output else np.zeros(n_y))
        names.append(f"disturbance of {output if at_output else kind}")
    return Disturbances(np.array(B).reshape(-1, n).T, np.array(C).reshape(-1, n_y).T, (*names,))


def check_observable(plant: StateSpace) -> None:
    """Raise `QPError` if a mode of the model that does not decay leaves no trace in the outputs."""
    for eigenvalue, mode in unseen_modes(plant.A, plant.C):
        state = int(np.abs(mode).argmax())
        remedy = "Measure a signal that shows it, or remove it from the model."
        got = f"a mode at {_number(eigenvalue)}, mostly in state {state}, that no output shows"
        raise QPError.expected("model", got, "a detectable model", remedy)


def unseen_modes(A: Array, C: Array) -> list[tuple[complex, Array]]:
    """Return eigenvalues of A that do not decay, with their modes, that y = C x does not show."""
    modes = []
    for eigenvalue in np.linalg.eigvals(A):
        if abs(eigenvalue) < 1 - 1e-9:
            continue
        mode = null_direction(A - eigenvalue * np.eye(len(A)), C)
        if mode is not None:
            modes.append((complex(eigenvalue), mode))
    return modes


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


def _automatic(plant: StateSpace, tolerance: float) -> dict[str, str]:
    """Choose inputs for the modes at one, and outputs for the rest, one for each output."""
    n, _, n_y, _ = plant.sizes
    U, sizes, _ = np.linalg.svd(plant.A - np.eye(n))
    modes = U[:, sizes <= tolerance * max(sizes[0], 1.0)].T  # of A', near one
    taken = [plant.inputs[i] for i in _independent(modes @ plant.B)[:n_y]]
    columns = [plant.B[:, plant.inputs.index(name)] for name in taken]
    columns = np.column_stack((plant.A - np.eye(n), *columns))
    columns = np.vstack((columns, np.pad(plant.C, ((0, 0), (0, len(taken))))))
    # Output disturbances fill what the other columns leave.
    rest = scipy.linalg.null_space(columns.T, rcond=RANK)[n:].T
    at_outputs, inputs = _independent(rest)[: n_y - len(taken)], iter(taken)
    return {
        name: OUTPUT if i in at_outputs else next(inputs) for i, name in enumerate(plant.outputs)
    }


def _independent(matrix: Array) -> list[int]:
    """Return columns that are independent of each other, the largest first."""
    _, R, order = map(np.asarray, scipy.linalg.qr(matrix, mode="economic", pivoting=True))
    sizes = np.abs(np.diag(R))
    return [int(i) for i, x in zip(order, sizes, strict=False) if x > RANK * sizes[0]]


def _hidden(plant: StateSpace, placed: Disturbances) -> str | None:
    """Return the name of a disturbance that cannot be told from a mode at one, if there is one."""
    n = len(plant.A)
    shown = np.hstack((plant.C, placed.C))
    direction = null_direction(np.hstack((plant.A - np.eye(n), placed.B)), shown)
    return None if direction is None else placed.names[int(np.abs(direction[n:]).argmax())]


def _number(eigenvalue: complex) -> str:
    return f"{eigenvalue.real:.3g}" + (f"{eigenvalue.imag:+.3g}j" if eigenvalue.imag else "")
