"""The paper's programs written for independent solvers: cvxpy and quadprog."""

import cvxpy as cp
import numpy as np
import quadprog
import torch
from torch import Tensor

from torch_qpmpc import QuadraticProgram


def arrays(qp: QuadraticProgram) -> tuple[np.ndarray, ...]:
    return tuple(tensor.detach().numpy().astype(float) for tensor in qp.tensors())


def by_cvxpy(qp: QuadraticProgram, fixed: Tensor) -> tuple[float, Tensor]:
    """Solve one QP as printed in eq:qp2 and eq:qp3, with explicit sigma; return value and z."""
    H, q, c, C, b, G, lb, ub, w = arrays(qp)
    z, sigma = cp.Variable(len(q)), cp.Variable(len(w))
    hard, lower, upper = np.isinf(w), np.isfinite(lb), np.isfinite(ub)
    constraints = [sigma >= 0, C @ z == b]
    pairs = [
        (G[lower] @ z, ">=", lb[lower] - sigma[lower]),
        (G[upper] @ z, "<=", ub[upper] + sigma[upper]),
        (sigma[hard], "==", np.zeros(hard.sum())),
        (z[: fixed.shape[-1]], "==", fixed.numpy()),
    ]
    for left, relation, right in pairs:
        if left.size:
            constraints.append(
                {">=": left >= right, "<=": left <= right, "==": left == right}[relation]
            )
    cost = 0.5 * cp.quad_form(z, cp.psd_wrap(H)) + q @ z + c + np.where(hard, 0, w) @ sigma
    problem = cp.Problem(cp.Minimize(cost), constraints)
    problem.solve(
        solver=cp.CLARABEL, tol_gap_abs=1e-10, tol_gap_rel=1e-10, tol_feas=1e-10, tol_ktratio=1e-8
    )
    assert isinstance(problem.value, float)
    return problem.value, torch.tensor(z.value)


def by_quadprog(qp: QuadraticProgram, fixed: Tensor) -> tuple[float, Tensor]:
    """Solve one QP with positive definite H by Goldfarb and Idnani's method; return value and z."""
    H, q, c, C, b, G, lb, ub, w = arrays(qp)
    n_z, n_g, n_f = len(q), len(w), fixed.shape[-1]
    hard, lower, upper = np.isinf(w), np.isfinite(lb), np.isfinite(ub)
    weight = np.where(hard, 0.0, w)
    curvature = 1e-8 * np.eye(n_g)  # quadprog needs curvature on sigma, too
    unit = np.eye(n_z + n_g)
    equalities = np.vstack([np.hstack([C, np.zeros((len(b), n_g))]), unit[:n_f], unit[n_z:][hard]])
    rows = np.vstack(
        [np.hstack([G, np.eye(n_g)])[lower], np.hstack([-G, np.eye(n_g)])[upper], unit[n_z:][~hard]]
    )
    at_least = np.concatenate([lb[lower], -ub[upper], np.zeros((~hard).sum())])
    solution = quadprog.solve_qp(
        np.block([[H, np.zeros((n_z, n_g))], [np.zeros((n_g, n_z)), curvature]]),
        -np.concatenate([q, weight]),
        np.vstack([equalities, rows]).T,
        np.concatenate([b, fixed.numpy(), np.zeros(hard.sum()), at_least]),
        meq=len(equalities),
    )[0]
    z, sigma = solution[:n_z], solution[n_z:]
    return float(0.5 * z @ H @ z + q @ z + c + weight @ sigma), torch.tensor(z)
