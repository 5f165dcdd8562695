"""The initial theta: arguments as the tensors of a QP (eq:qp5), before discounts (eq:qpH)."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from numbers import Real
from typing import Any

import scipy
import torch
import torch.nn.functional as F
from torch import Tensor

from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.banded import banded_matrix
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.mpc.parametrizations import LinearRows
from torch_qpmpc.mpc.validation import (
    as_tensor,
    bound_pair,
    check_weight,
    cost_weights,
    slack_weight,
)

RICCATI = "riccati"
#: The parts of theta that may start at any finite values.
STARTED = ("q", "c", "C", "b")


def theta(
    n_x: int,
    n_u: int,
    horizon: int,
    past: int,
    n_d: int,
    *,
    gamma: float,
    A: Any,
    B: Any,
    E: Any,
    offset: Any,
    state_bounds: tuple[Any, Any] | None,
    action_bounds: tuple[Any, Any] | None,
    constraints: tuple[Any, Any, Any] | None,
    terminal_constraints: tuple[Any, Any, Any] | None,
    rate_bounds: tuple[Any, Any] | None,
    structure: str,
    hessian: str,
    learn: Collection[str],
    stage_weight: Any,
    terminal_weight: Any,
    state_slack: Any,
    action_slack: Any,
    constraint_slack: float,
    rate_slack: Any,
    start: Any,
    seed: int,
    **_: Any,
) -> tuple[Layout, dict[str, Tensor]]:
    """Return the layout and theta by part, from the arguments of `QPMPC`; w is inf on hard rows."""
    if rate_bounds is None and not (isinstance(rate_slack, Real) and rate_slack == torch.inf):
        remedy = "It is the price of violating them: pass rate_bounds, too."
        raise QPError.expected("rate_slack", repr(rate_slack), "inf without rate_bounds", remedy)
    D = _linear_rows("constraints", constraints, n_d + n_x + n_u)
    D_f = _linear_rows("terminal_constraints", terminal_constraints, n_d + n_x)
    rates = _rates(rate_bounds, n_u, past)
    layout = Layout(n_x, n_u, horizon, past, n_d, len(D[0]), len(D_f[0]), len(rates[0]))
    if "G" in learn and structure != "free" and not layout.n_linear:
        remedy = "Pass constraints, or structure='free'."
        raise QPError.expected("learn", "'G' without constraints", "other parts", remedy)
    random = torch.Generator().manual_seed(seed)
    A, B, E = _model(A, B, E, layout, random)
    C = banded_matrix(A, B, horizon, E)
    offset = torch.zeros(n_x) if offset is None else as_tensor("offset", offset)
    if tuple(offset.shape) != (n_x,):
        raise QPError.expected("offset", f"shape {tuple(offset.shape)}", f"shape ({n_x},)")
    is_random = stage_weight is None
    if is_random:
        states = 0.5 + 4.5 * torch.rand(n_x, generator=random, dtype=torch.float32)
        stage_weight = torch.cat((states, torch.zeros(n_u)))
    if terminal_weight is None and is_random:
        terminal_weight = torch.ones(n_x)
    elif terminal_weight is None:
        terminal_weight = _default_weight(A, B, stage_weight, gamma, hessian, start, layout)
    elif isinstance(terminal_weight, str):
        if terminal_weight != RICCATI or hessian == "diagonal":
            got = f"{terminal_weight!r} with hessian={hessian!r}"
            want = f"a tensor, or {RICCATI!r} with hessian='block' or 'full'"
            raise QPError.expected("terminal_weight", got, want)
        terminal_weight = _riccati_weight(A, B, stage_weight, gamma, layout)
    return layout, {
        **cost_weights(stage_weight, terminal_weight, hessian, layout),
        "q": torch.zeros(layout.n_z),
        "c": torch.zeros(()),
        "C": C,
        "b": -offset.repeat(horizon),
        "G": LinearRows(layout, tied=True)(D[0], D_f[0]),
        **_bounds(layout, state_bounds, action_bounds, D, D_f, rates),
        "w": _slack_weights(layout, state_slack, action_slack, constraint_slack, rate_slack),
    }


def started(theta: Mapping[str, Tensor], start: Any, **_: Any) -> dict[str, Tensor]:
    """Return the initial values in the argument ``start`` of `QPMPC`, by part of ``theta``."""
    if start is None:
        return {}
    wanted = f"a mapping of values by name, of {', '.join(STARTED)}"
    if not isinstance(start, Mapping) or not all(name in STARTED for name in start):
        got = list(start) if isinstance(start, Mapping) else repr(start)
        raise QPError.expected("start", got, wanted)
    values = {name: as_tensor(f"start[{name!r}]", value) for name, value in start.items()}
    for name, value in values.items():
        if value.shape != theta[name].shape:
            got, want = tuple(value.shape), tuple(theta[name].shape)
            raise QPError.expected(f"start[{name!r}]", f"shape {got}", f"shape {want}")
    return values


def linear_mpc(*, hessian: str = "block", **options: Any) -> dict[str, Any]:
    """Return the defaults of `QPMPC.linear_mpc` for ``options``."""
    learn = ["H", "H_f", "q", "c", "C", "b", "lb", "ub", "w"]
    if hessian == "full":
        learn.remove("H_f")
    if {"constraints", "terminal_constraints"} & options.keys():
        learn.append("G")
    return {
        "structure": "tied",
        "hessian": hessian,
        "discount_slack": True,
        "learn": learn,
    }


def check_cost(stage_weight: Any, n_x: int, n_u: int) -> None:
    """Raise `QPError` if nobody has chosen a stage cost.

    A controller of a model must not start from a random one.
    """
    if stage_weight is None:
        example = ", ".join(["1.0"] * min(n_x, 4) + [".."] * (n_x > 4) + ["0.1"] * min(n_u, 4))
        remedy = (
            f"Pass the cost that the plant has, such as stage_weight=[{example}] for states "
            "weighted 1 and actions 0.1, twice the plant's own weights."
        )
        expected = "the weight of [x; u] in the stage cost 1/2 [x; u]' W [x; u]"
        raise QPError.expected("stage_weight", "none", expected, remedy)


def model_sizes(A: Tensor, B: Tensor) -> tuple[int, int, int]:
    """Return n_x, n_u and past of a model [A_1, .., A_L], [B_1, .., B_L]."""
    n_x = A.shape[-2]
    past = max(A.shape[-1] // max(n_x, 1), 1)
    return n_x, max(B.shape[-1] // past, 1), past


def _model(
    A: Any, B: Any, E: Any, layout: Layout, random: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Return A, B and E as tensors; for None, random A_1 and B_1 and zeros."""
    n_x, n_u, past, n_d = layout.n_x, layout.n_u, layout.past, layout.n_d
    if A is None:
        A = torch.eye(n_x, dtype=torch.float32) + 0.1 * torch.randn(
            n_x, n_x, generator=random, dtype=torch.float32
        )
        A = F.pad(A, (0, (past - 1) * n_x))
    if B is None:
        B = 0.1 * torch.randn(n_x, n_u, generator=random, dtype=torch.float32)
        B = F.pad(B, (0, (past - 1) * n_u))
    A, B = as_tensor("A", A), as_tensor("B", B)
    E = A.new_zeros(n_x, n_d) if E is None else as_tensor("E", E)
    if A.shape[-1:] != (past * n_x,) or B.shape[-1:] != (past * n_u,):
        got = f"shapes {tuple(A.shape)} and {tuple(B.shape)}"
        want = f"({n_x}, {past * n_x}) and ({n_x}, {past * n_u})"
        remedy = None if past == 1 else f"[A_1, .., A_L] and [B_1, .., B_L] for past={past}."
        raise QPError.expected("A, B", got, want, *([remedy] if remedy else []))
    if E.shape[-2:] != (n_x, n_d):
        remedy = "It multiplies the preview d_k, of n_d entries."
        raise QPError.expected("E", f"shape {tuple(E.shape)}", f"({n_x}, {n_d})", remedy)
    return A, B, E


def _default_weight(
    A: Tensor,
    B: Tensor,
    stage_weight: Any,
    gamma: float,
    hessian: str,
    start: Any,
    layout: Layout,
) -> Tensor:
    """Return the Riccati weight about the target if it exists, else the last stage's weight.

    A linear cost in ``start`` has a target of its own, which only the stage's weight respects.
    """
    W, n_x, n_d = as_tensor("stage_weight", stage_weight), layout.n_x, layout.n_d
    shapes = ((layout.n,), (layout.n,) * 2, (n_d + layout.n,) * 2)
    if hessian == "diagonal" or tuple(W.shape) not in shapes:
        W = W[-1] if W.ndim > 1 else W
    elif not (isinstance(start, Mapping) and "q" in start):
        try:
            P = _riccati_weight(A, B, W, gamma, layout)
            check_weight("terminal_weight", P, diagonal=False, n_d=len(P) - n_x)
            return P
        except QPError:
            pass  # the stage's weight is always one
    if W.ndim == 2:
        size = len(W) - layout.n_u
        return W[:size, :size]
    return W[:n_x] if W.ndim else W


def _riccati_weight(
    A: Tensor, B: Tensor, stage_weight: Any, gamma: float, layout: Layout
) -> Tensor:
    if layout.past > 1:
        remedy = "Pass a matrix: its cost to go is one of the whole window."
        raise QPError.expected("terminal_weight", f"{RICCATI!r} with past > 1", "past=1", remedy)
    W = as_tensor("stage_weight", stage_weight)
    W, n_d = torch.diag(W) if W.shape == (layout.n,) else W, layout.n_d
    cross = W.new_zeros(layout.n_x, 0)
    if W.shape == (n_d + layout.n,) * 2:
        cross, W = W[n_d : n_d + layout.n_x, :n_d], W[n_d:, n_d:]
    sizes = {"A": (A, layout.n_x, layout.n_x), "B": (B, layout.n_x, layout.n_u)}
    for name, (matrix, *shape) in (sizes | {"stage_weight": (W, layout.n, layout.n)}).items():
        if list(matrix.shape) != shape:
            got, remedy = f"shape {tuple(matrix.shape)}", "The Riccati equation has one stage only."
            raise QPError.expected(name, got, f"shape {tuple(shape)}", remedy)
    P = riccati_weight(A, B, W, gamma)
    if not cross.any():
        return P
    # x - target, where the stage's cost of x is least for d.
    Q = W[: layout.n_x, : layout.n_x]
    error = torch.cat((torch.linalg.pinv(Q, hermitian=True) @ cross, torch.eye(len(P)).to(P)), -1)
    return error.mT @ P @ error


def riccati_weight(A: Tensor, B: Tensor, W: Tensor, gamma: float = 1.0) -> Tensor:
    """Return P ``(n_x, n_x)`` of the discounted linear quadratic regulator's cost to go 1/2 x'Px.

    Without active bounds, an MPC scheme with H_f = P is that regulator, for any horizon.

    Args:
        A, B: the model, ``(n_x, n_x)`` and ``(n_x, n_u)``.
        W: weight of the stage cost ``1/2 [x; u]' W [x; u]``, ``(n_x + n_u, n_x + n_u)``.
        gamma: discount of the stage costs.

    Raises:
        QPError: the discrete Riccati equation has no stabilising solution.
    """
    n_x, root = A.shape[-1], gamma**0.5
    Q, S, R = W[:n_x, :n_x], W[:n_x, n_x:], W[n_x:, n_x:]
    try:
        P = scipy.linalg.solve_discrete_are(
            *(x.detach().numpy() for x in (root * A, root * B, Q, R)), s=S.detach().numpy()
        )
    except (ValueError, scipy.linalg.LinAlgError) as error:
        raise QPError.expected(
            "terminal_weight",
            f"a Riccati equation without a solution ({error})",
            "a stabilisable model and a positive definite weight of the actions",
            "Give the actions some weight, or pass a matrix.",
        ) from error
    return torch.as_tensor((P + P.T) / 2).to(A)


def _linear_rows(name: str, rows: tuple[Any, Any, Any] | None, width: int) -> tuple[Tensor, ...]:
    if rows is None:
        return torch.zeros(0, width), torch.zeros(0), torch.zeros(0)
    try:
        matrix, lower, upper = rows
    except (TypeError, ValueError) as error:
        raise QPError.expected(name, repr(rows), "the triple (D, lower, upper)") from error
    matrix = as_tensor(name, matrix)
    if matrix.ndim != 2 or matrix.shape[1] != width:
        raise QPError.expected(name, f"D of shape {tuple(matrix.shape)}", f"shape (m, {width})")
    return matrix, *bound_pair(f"{name}, bounds", (lower, upper), len(matrix))


def _rates(bounds: tuple[Any, Any] | None, n_u: int, past: int) -> tuple[Tensor, Tensor]:
    """Return the bounds of u_k - u_{k-1}; empty for None."""
    if bounds is None:
        return torch.zeros(0), torch.zeros(0)
    if past == 1:
        remedy = "The window then holds u_{-1}; torch_qpmpc.envs.PastWindow makes it."
        raise QPError.expected("rate_bounds", "bounds with past=1", "past >= 2", remedy)
    return bound_pair("rate_bounds", bounds, n_u)


def _bounds(
    layout: Layout,
    state_bounds: tuple[Any, Any] | None,
    action_bounds: tuple[Any, Any] | None,
    D: tuple[Tensor, ...],
    D_f: tuple[Tensor, ...],
    rates: tuple[Tensor, Tensor],
) -> dict[str, Tensor]:
    """Return lb and ub ``(n_g,)`` by name."""
    x = bound_pair("state_bounds", state_bounds, layout.n_x)
    u = bound_pair("action_bounds", action_bounds, layout.n_u)
    lower, upper = (layout.rows(*side) for side in zip(x, u, D[1:], D_f[1:], rates, strict=True))
    return {"lb": lower, "ub": upper}


def _slack_weights(layout: Layout, state: Any, action: Any, constraint: Any, rate: Any) -> Tensor:
    """Return w ``(n_g,)``, inf on hard rows."""
    return layout.rows(
        slack_weight("state_slack", state, layout.n_x),
        slack_weight("action_slack", action, layout.n_u),
        slack_weight("constraint_slack", constraint).expand(layout.n_mixed),
        slack_weight("constraint_slack", constraint).expand(layout.n_terminal),
        slack_weight("rate_slack", rate, layout.n_u)[: layout.n_rates],
    )
