"""Solutions of the highest accuracy, with which an exported policy is compared.

A certified solution gives the active set; for a fixed one, the KKT conditions of the whole plan are
linear equations. Their solution, with iterative refinement, is exact up to rounding if it confirms
the active set, and else corrects it. Where this does not settle, the interior point is the most
accurate solver.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy
import torch

from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.qp.program import QuadraticProgram, Status
from torch_qpmpc.qp.solution import row_states
from torch_qpmpc.qp.solve import solve_qp

MAX_STEPS = 20
#: QPs of more rows are solved by the interior point alone.
LARGE = 200
#: A correction is kept if the value changes by no more than this fraction.
CERTIFIED = 1e-5

Array = np.ndarray


@dataclass(frozen=True, eq=False)
class Reference:
    """Solutions of V at B states.

    Attributes:
        status: `Status` of each, ``(B,)``.
        u, value: the actions ``(B, n_u)`` and costs to go ``(B,)``, NaN where unsolved.
        active: the active sets, as in `QPSolution`, ``(B, n_g)``.
    """

    status: Array
    u: Array
    value: Array
    active: Array

    def parts(self) -> tuple[Array, ...]:
        """Return all four arrays."""
        return self.status, self.u, self.value, self.active


@torch.no_grad()
def reference(mpc: QPMPC, p: Array, solver: str | None = None) -> Reference:
    """Return the certified solutions of V at p ``(B, n_p)`` by a solver of the package."""
    qp = mpc.quadratic_program()
    solver = solver or ("torch" if _is_large(qp) else "daqp")
    fixed = torch.as_tensor(p, dtype=qp.q.dtype, device=qp.q.device)
    solution = solve_qp(qp, fixed, solver=solver, on_failure="mask")
    solved = (solution.status == Status.SOLVED).cpu().numpy()
    u = solution.z[:, mpc.n_p : mpc.n_p + mpc.n_u].double().cpu().numpy()
    value = solution.value.double().cpu().numpy()
    return Reference(
        solution.status.cpu().numpy().copy(),
        np.where(solved[:, None], u, np.nan),
        np.where(solved, value, np.nan),
        solution.active.cpu().numpy().copy(),
    )


def _is_large(qp: QuadraticProgram) -> bool:
    """Return True for more than `LARGE` rows with a bound."""
    return int((qp.lb.isfinite() | qp.ub.isfinite()).sum()) > LARGE


def sharpen(mpc: QPMPC, p: Array, coarse: Reference, which: Array) -> Reference:
    """Replace solutions of ``coarse`` at the indices ``which`` by exact ones."""
    qp = mpc.quadratic_program()
    if _is_large(qp):
        return coarse
    data = [x.detach().double().cpu().numpy() for x in qp.tensors()]
    u, value = coarse.u.copy(), coarse.value.copy()
    for i in which:
        z = _exact(data, np.asarray(p[i], dtype=np.float64), coarse.active[i])
        if z is None:
            other = reference(mpc, p[i : i + 1], "torch")
            if other.status[0] == Status.SOLVED:
                u[i], value[i] = other.u[0], other.value[0]
            continue
        cost = _cost(data, z)
        if abs(cost - value[i]) <= CERTIFIED * (1 + abs(value[i])):
            u[i], value[i] = z[mpc.n_p : mpc.n_p + mpc.n_u], cost
    return Reference(coarse.status, u, value, coarse.active)


def _exact(data: list[Array], p: Array, active: Array) -> Array | None:
    """Return the z that the KKT conditions of an active set give, None if it does not settle."""
    H, q, _, C, b, G, lb, ub, w = data
    n_p, n_c = len(p), len(C)
    n = H.shape[0] - n_p
    held = (np.abs(active) == 1) | ((lb == ub) & (np.abs(active) < 2))
    level = np.where(active > 0, ub, lb)
    fixed = np.where(np.abs(active) == 2, np.sign(active) * np.where(np.isinf(w), 0, w), 0.0)
    held &= np.abs(G[:, n_p:]).max(-1) > 0
    previous = None
    for _ in range(MAX_STEPS):
        A = G[held, n_p:]
        B = np.concatenate((C[:, n_p:], A))
        kkt = np.block([[H[n_p:, n_p:], B.T], [B, np.zeros((len(B), len(B)))]])
        right = np.concatenate(
            (
                -q[n_p:] - H[n_p:, :n_p] @ p - G[:, n_p:].T @ fixed,
                b - C[:, :n_p] @ p,
                level[held] - G[held, :n_p] @ p,
            )
        )
        x = _solve(kkt, right)
        z = np.concatenate((p, x[:n]))
        lam = fixed.copy()
        lam[held] = x[n + n_c :]
        level, held, fixed = row_states(G @ z + lam, lb, ub, w)
        held &= np.abs(G[:, n_p:]).max(-1) > 0
        fixed = np.where(held, 0.0, fixed)
        fixed[~(np.abs(G[:, n_p:]).max(-1) > 0)] = 0.0
        states = held, np.where(held, level, 0), fixed
        if previous is not None and all(map(np.array_equal, states, previous)):
            return z
        previous = states
    return None


def _solve(matrix: Array, right: Array) -> Array:
    """Solve a linear system with two refinements, by least squares if it is singular."""
    lu, pivots, _ = scipy.linalg.lapack.dgetrf(matrix)

    def regular(right: Array) -> Array:
        return scipy.linalg.lapack.dgetrs(lu, pivots, right)[0]

    x, solve = regular(right), regular
    with np.errstate(all="ignore"):  # of a singular matrix
        error = np.abs(matrix @ x - right).max()
    if not error <= 1e-8 * (1 + np.abs(right).max()):
        inverse = np.linalg.pinv(matrix, rcond=1e-13, hermitian=True)
        x, solve = inverse @ right, partial(np.matmul, inverse)
    wide = matrix.astype(np.longdouble)
    for _ in range(2):
        x = x + solve((right - wide @ x).astype(np.float64))
    return x


def _cost(data: list[Array], z: Array) -> float:
    H, q, c, _, _, G, lb, ub, w = data
    z, y = z.astype(np.longdouble), G @ z
    off = np.maximum(np.maximum(lb - y, y - ub), 0)
    return float(z @ (H @ z) / 2 + q @ z + c + np.where(np.isinf(w), 0, w) @ off)
