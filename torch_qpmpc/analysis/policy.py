"""The policy in terms of control engineering: its gain, and its regions of one active set each.

With a preview, the state s is all that V fixes, p ``(n_p,)``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torch_qpmpc.checks import check_kind, check_tensor
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.validation import as_tensor, without_gradients
from torch_qpmpc.qp.solution import QPSolution

GRID_REMEDY = "Pass torch.linspace(lower, upper, n)."


@without_gradients
def local_gain(mpc: QPMPC, s: Tensor) -> Tensor:
    """Return K = ``-d pi / d s`` for the active set at s: near s, u_0 = pi(s) - K ds.

    It is ``(*batch, n_u, n_p)`` for s ``(*batch, n_p)``, and zero where the QP is not solved.

    Raises:
        QPError: if the shape of s does not fit.
        SolverError: if a QP has no solution, and ``mpc.on_failure`` is ``"raise"``.
    """
    check_kind("mpc", mpc, QPMPC)
    return _solve_with_gain(mpc, check_tensor("s", s, mpc.n_p))[1]


def spectral_radius(A: Tensor, B: Tensor, K: Tensor) -> Tensor:
    """Return the largest eigenvalue modulus of A - B K, ``(*batch,)``; below 1 it is stable."""
    check_tensor("A", A, "n_x", "n_x")
    n_x = A.shape[-1]
    check_tensor("B", B, n_x, "n_u")
    check_tensor("K", K, B.shape[-1], n_x)
    closed = A - B.to(A) @ K.to(A)
    if not closed.isfinite().all():
        raise QPError.expected("A, B, K", "NaN or inf", "finite entries")
    return torch.linalg.eigvals(closed).abs().amax(-1)


@dataclass(frozen=True, eq=False)
class PolicyMap:
    """V and the policy on a grid over two states; index ``[i, j]`` is at ``x[i]``, ``y[j]``.

    Attributes:
        axes: the indices of the two states, in p.
        names: their symbols, such as ``s_{1}``, or ``x_{0,1}`` for the first entry of x_0.
        x, y: their values, ``(n,)`` and ``(m,)``.
        states: the grid points, ``(n, m, n_p)``.
        values: V, ``(n, m)``; nan where the QP is not solved.
        actions: pi(s), ``(n, m, n_u)``; likewise.
        gains: ``-d u_0 / d s``, ``(n, m, n_u, n_p)``; likewise.
        regions: the index in ``active_sets``, ``(n, m)``; -1 where the QP is not solved.
        active_sets: the distinct active sets, the most frequent first, ``(count, n_g)``, coded as
            in `QPSolution.active`.
    """

    axes: tuple[int, int]
    names: tuple[str, str]
    x: Tensor
    y: Tensor
    states: Tensor
    values: Tensor
    actions: Tensor
    gains: Tensor
    regions: Tensor
    active_sets: Tensor


def policy_map(
    mpc: QPMPC,
    x: Any,
    y: Any,
    *,
    axes: tuple[int, int] | None = None,
    at: Any = None,
) -> PolicyMap:
    """Evaluate the policy, its gain and its active sets on a slice of the states, in one batch.

    Args:
        mpc: the QP.
        x, y: the values of two states, ``(n,)`` and ``(m,)``.
        axes: the indices of these states, in p; by default, those of the first two of x_0.
        at: a state with the values of the others, ``(n_p,)``; zero by default.

    Raises:
        QPError: if ``axes`` are not two different states, or ``x`` or ``y`` is not a vector.
        SolverError: if a QP has no solution, and ``mpc.on_failure`` is ``"raise"``.

    Example:
        >>> import torch, torch_qpmpc as qm
        >>> mpc = qm.QPMPC.from_model(
        ...     [[1.0, 0.1], [0.0, 1.0]],
        ...     [[0.0], [0.1]],
        ...     5,
        ...     stage_weight=[1.0, 1.0, 0.1],
        ...     action_bounds=([-1.0], [1.0]),
        ... )
        >>> drawn = policy_map(mpc, torch.linspace(-1, 1, 9), torch.linspace(-1, 1, 5))
        >>> drawn.actions.shape, drawn.gains.shape, bool((drawn.regions >= 0).all())
        (torch.Size([9, 5, 1]), torch.Size([9, 5, 1, 2]), True)
    """
    check_kind("mpc", mpc, QPMPC)
    if axes is None:
        axes = (mpc.n_p - mpc.n_x, mpc.n_p - mpc.n_x + 1)
    if len({*axes} & {*range(mpc.n_p)}) != 2 or len(axes) != 2:
        raise QPError.expected("axes", axes, f"two different states among 0 to {mpc.n_p - 1}")
    first, second = axes
    x, y = as_tensor("x", x), as_tensor("y", y)
    if x.ndim != 1 or y.ndim != 1 or not len(x) or not len(y):
        got = f"shapes {tuple(x.shape)} and {tuple(y.shape)}"
        raise QPError.expected("x, y", got, "non-empty vectors", GRID_REMEDY)
    states = torch.zeros(mpc.n_p) if at is None else as_tensor("at", at)
    if tuple(states.shape) != (mpc.n_p,):
        raise QPError.expected("at", f"shape {tuple(states.shape)}", f"shape ({mpc.n_p},)")
    states = states.double().repeat(len(x), len(y), 1)
    states[..., first], states[..., second] = x.unsqueeze(-1), y
    solution, gains = _solve_with_gain(mpc, states)
    solved = solution.solved
    sets, regions, counts = solution.active.flatten(0, 1).unique(
        dim=0, return_inverse=True, return_counts=True
    )
    # The placeholder active set of unsolved QPs is sorted last and becomes region -1.
    failed = regions.new_zeros(len(sets), dtype=torch.bool)
    failed[regions[~solved.flatten()]] = True
    order = counts.masked_fill(failed, 0).argsort(descending=True, stable=True)
    regions = order.argsort()[regions].view(solved.shape).masked_fill(~solved, -1)
    u = solution.z.detach()[..., mpc.n_p : mpc.n_p + mpc.n_u]
    return PolicyMap(
        axes,
        (_symbol(mpc, first), _symbol(mpc, second)),
        x,
        y,
        states,
        solution.value.detach().masked_fill(~solved, torch.nan),
        u.masked_fill(~solved.unsqueeze(-1), torch.nan),
        gains.masked_fill(~solved[..., None, None], torch.nan),
        regions,
        sets[order][: len(sets) - int(failed.sum())],
    )


def _symbol(mpc: QPMPC, i: int) -> str:
    """Return the symbol of entry i of p: s_1, or one of d_k and x_0 with its stage."""
    if mpc.n_p == mpc.n_x:
        return f"s_{{{i + 1}}}"
    if i < mpc.layout.n_preview:
        stage, entry = divmod(i, mpc.n_d)
        return f"d_{{{stage},{entry + 1}}}"
    return f"x_{{0,{i - mpc.layout.n_preview + 1}}}"


def _solve_with_gain(mpc: QPMPC, s: Tensor) -> tuple[QPSolution, Tensor]:
    """Return V's solution at s, and -du_0/ds ``(*batch, n_u, n_p)``."""
    with torch.enable_grad():
        s = s.detach().clone().requires_grad_()
        solution = mpc.solve(s)
        u = solution.z[..., mpc.n_p : mpc.n_p + mpc.n_u]
        # Each action depends on its own state alone, so the sum's gradient is each one's.
        slopes = [
            torch.autograd.grad(u[..., i].sum(), s, retain_graph=True)[0] for i in range(mpc.n_u)
        ]
    return solution, -torch.stack(slopes, dim=-2)
