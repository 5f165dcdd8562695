"""The bounds of a scheme: the rows of G with lb, ub and the slack weights w (eq:v1c4)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from numbers import Real
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.checks import check_flag, check_whole
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.mpc.levels import hull, read_levels
from torch_qpmpc.mpc.parametrizations import LinearRows
from torch_qpmpc.mpc.validation import as_tensor, read_numbers

PAIRS = ("state_bounds", "action_bounds")
ROWS = ("constraints", "terminal_constraints")
SLACKS = ("state_slack", "action_slack", "constraint_slack")


@dataclass(frozen=True, eq=False)
class Bounds:
    """Bounds of states, actions and linear rows, each hard or soft with its price.

    Args:
        state_bounds, action_bounds: pairs (lower, upper) of ``(n_x,)`` and of ``(n_u,)``; unbounded
            by default.
        constraints: mixed constraints of each stage, ``lower <= D [x_k; u_k] <= upper`` (eq:v1c4),
            as the triple (D, lower, upper) of ``(m, n_x + n_u)`` and ``(m,)`` twice. With a preview
            D multiplies [d_k; x_k; u_k]: bounds that change with time are entries of d_k.
        terminal_constraints: the same for x_N, with D^f ``(m_f, n_x)``, or for [d_N; x_N].
        state_slack, action_slack, constraint_slack: the slack weights w of the rows of states, of
            actions, and of mixed and terminal constraints; ``inf`` makes them hard. By default,
            actions are hard and the others soft. Pass one weight, or one per entry; for
            ``constraint_slack`` one per row of D, then of D^f.
        action_levels: for each action its levels, ascending, of which the lowest is *off*, or None
            for an action between its bounds. Levels outside action_bounds are not taken.
        min_on, min_off: the fewest steps that an action with levels stays on, at any level but the
            lowest, and off; one number, or one for each action.
        start_cost: the cost of going on from off, likewise, discounted by gamma^k.
        integer_horizon: the number of stages that are decided on levels, all by default; actions of
            later ones are between the lowest and the highest level.
        max_nodes: the most QPs that the search for a plan on levels solves.
        level_rows: for each action the row of D whose value is on the levels; its own by default.
        discount_slack: discount w by gamma^k, as the MPC form does (eq:v1c0), or not (eq:qp2c0).
        held: one bool per row of D: True where a row that holds in a block's first stage holds in
            the others. By default those of actions alone.

    Raises:
        QPError: bounds cross or are NaN, a weight is negative, or shapes do not match.

    Example:
        >>> import torch_qpmpc as qm
        >>> bounds = qm.Bounds(
        ...     state_bounds=([-5.0, -1.0], [5.0, 1.0]),
        ...     state_slack=[100.0, 10.0],
        ...     action_bounds=([-1.0], [1.0]),
        ... )
    """

    state_bounds: Any = None
    action_bounds: Any = None
    constraints: Any = None
    terminal_constraints: Any = None
    state_slack: Any = 100.0
    action_slack: Any = torch.inf
    constraint_slack: Any = 100.0
    discount_slack: bool = False
    held: Any = None
    action_levels: Any = None
    min_on: Any = 1
    min_off: Any = 1
    start_cost: Any = 0.0
    integer_horizon: int | None = None
    max_nodes: int = 10_000
    level_rows: Any = None

    def __post_init__(self) -> None:
        check_flag("discount_slack", self.discount_slack)
        readers = dict.fromkeys(PAIRS, _pair) | dict.fromkeys(ROWS, _linear_rows)
        for name, read in (readers | dict.fromkeys(SLACKS, _slack)).items():
            value = getattr(self, name)
            if value is not None or name in SLACKS:
                object.__setattr__(self, name, read(name, value))
        if self.held is not None:
            held = read_numbers("held", self.held).bool()
            n_mixed = 0 if self.constraints is None else len(self.constraints[0])
            if held.shape != (n_mixed,):
                want = f"({n_mixed},): one entry per row of constraints"
                raise QPError.expected("held", f"shape {tuple(held.shape)}", want)
            object.__setattr__(self, "held", held)
        check_whole("max_nodes", self.max_nodes, 1)
        if self.integer_horizon is not None:
            check_whole("integer_horizon", self.integer_horizon, 1)
        if self.action_levels is not None:
            object.__setattr__(self, "action_levels", read_levels(self.action_levels))

    def counted(self, layout: Layout) -> Layout:
        """Return ``layout`` with the numbers of these rows."""
        linear = (self.constraints, self.terminal_constraints)
        n_mixed, n_terminal = (0 if rows is None else len(rows[0]) for rows in linear)
        return replace(layout, n_mixed=n_mixed, n_terminal=n_terminal)

    def rows(self, layout: Layout) -> dict[str, Tensor]:
        """Return G, lb, ub and w, inf on hard rows, of the sizes ``layout``, as `counted`.

        Raises:
            QPError: a shape does not match the sizes.
        """
        n_x, n_u, n_d = layout.n_x, layout.n_u, layout.n_d
        D = _matching_rows("constraints", self.constraints, n_d + layout.n)
        D_f = _matching_rows("terminal_constraints", self.terminal_constraints, n_d + n_x)
        pairs, none = zip(PAIRS, (n_x, n_u), strict=True), (-torch.inf, torch.inf)
        x, u = ([_sized(k, side, n) for side in getattr(self, k) or none] for k, n in pairs)
        if (levels := self.action_levels) is not None and self.level_rows is None:
            if len(levels) != n_u:
                want = f"{n_u}, one for each action, or None"
                raise QPError.expected("action_levels", f"{len(levels)} entries", want)
            u = hull("action_bounds", u, levels, [f"action {i}" for i in range(n_u)])
        lower, upper = (layout.rows(*side) for side in zip(x, u, D[1:], D_f[1:], strict=True))
        sizes = zip(SLACKS, (n_x, n_u, layout.n_mixed + layout.n_terminal), strict=True)
        x, u, linear = (_sized(name, getattr(self, name), n) for name, n in sizes)
        w = layout.rows(x, u, *linear.split((layout.n_mixed, layout.n_terminal)))
        G = LinearRows(layout)(D[0], D_f[0])
        return {"G": G, "lb": lower, "ub": upper, "w": w}


def _pair(name: str, bounds: Any) -> tuple[Tensor, Tensor]:
    """Return both sides as vectors of one length."""
    try:
        lower, upper = bounds
    except (TypeError, ValueError) as error:
        raise QPError.expected(name, repr(bounds), "the pair (lower, upper)") from error
    lower, upper = _side(name, lower, 0), _side(name, upper, 1)
    if lower.shape != upper.shape:
        got = f"shapes {tuple(lower.shape)} and {tuple(upper.shape)}"
        raise QPError.expected(name, got, "one length on both sides")
    crossing = (lower > upper).nonzero()
    if len(crossing):
        i = int(crossing[0])
        got = f"lower {lower[i]:g} > upper {upper[i]:g} at entry {i}"
        raise QPError.expected(name, got, "lower <= upper", "The pair is (lower, upper).")
    return lower, upper


def _side(name: str, values: Any, side: int) -> Tensor:
    values = read_numbers(name, values)
    if values.isnan().any():
        raise QPError.expected(name, "NaN", "no NaN; inf for no bound")
    if values.ndim != 1:
        raise QPError.expected(name, f"shape {tuple(values.shape)}", "a vector on each side")
    if (values == (1 - 2 * side) * torch.inf).any():
        want = ("lower bounds below inf", "upper bounds above -inf")[side]
        raise QPError.expected(name, f"{values.tolist()}", want)
    return values.detach().clone()


def _linear_rows(name: str, rows: Any) -> tuple[Tensor, Tensor, Tensor]:
    """Return D and its bounds."""
    try:
        matrix, lower, upper = rows
    except (TypeError, ValueError) as error:
        raise QPError.expected(name, repr(rows), "the triple (D, lower, upper)") from error
    matrix = as_tensor(name, matrix).detach().clone()
    if matrix.ndim != 2:
        raise QPError.expected(name, f"D of shape {tuple(matrix.shape)}", "a matrix")
    pair = _pair(f"{name}, bounds", (lower, upper))
    lower, upper = (_sized(f"{name}, bounds", side, len(matrix)) for side in pair)
    return matrix, lower, upper


def _slack(name: str, weight: Any) -> float | Tensor:
    """Return one weight for all rows, or one for each."""
    if isinstance(weight, Real) and not isinstance(weight, bool) and float(weight) >= 0:
        return float(weight)
    if isinstance(weight, Sequence | np.ndarray | Tensor) and not isinstance(weight, str):
        weights = read_numbers(name, weight)
        if weights.ndim == 1 and (weights >= 0).all():
            return weights.detach().clone()
    want = "a non-negative weight, or inf for hard rows; or one for each of them"
    raise QPError.expected(name, repr(weight), want)


def _sized(name: str, value: float | Tensor, size: int) -> Tensor:
    """Return one number for each of ``size`` entries."""
    if not isinstance(value, Tensor):
        return torch.full((size,), value, dtype=torch.float64)
    if len(value) != size:
        raise QPError.expected(name, f"shape {tuple(value.shape)}", f"shape ({size},)")
    return value


def _matching_rows(
    name: str, rows: tuple[Tensor, Tensor, Tensor] | None, width: int
) -> tuple[Tensor, ...]:
    if rows is None:
        none = torch.zeros(0, dtype=torch.float64)
        return torch.zeros(0, width, dtype=torch.float64), none, none
    if rows[0].shape[1] != width:
        raise QPError.expected(name, f"D of shape {tuple(rows[0].shape)}", f"shape (m, {width})")
    return rows
