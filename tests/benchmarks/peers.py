"""Other packages' differentiable QPs, each as a function from a QP and fixed entries to values."""

from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np
import qpsolvers
import scipy.sparse as sp
import torch
from torch import Tensor

from tests.benchmarks.full_space import INFINITE, FullSpace
from torch_qpmpc import QuadraticProgram

#: Maps a QP and fixed entries to optimal values ``(B,)``, differentiable in the QP's tensors.
Values = Callable[[QuadraticProgram, Tensor], Tensor]
#: Curvature of sigma for qpth, which refuses a singular Q.
CURVATURE = 1e-8


def proxsuite() -> Values:
    layer = import_module("proxsuite.torch.qplayer").QPFunction()

    def values(qp: QuadraticProgram, fixed: Tensor) -> Tensor:
        full = FullSpace.of(qp, fixed)
        return full.value(layer(full.Q, full.p, full.A, full.b, full.G, full.l, full.u)[0])

    return values


def qpth() -> Values:
    layer = import_module("qpth.qp").QPFunction(verbose=-1, check_Q_spd=False)

    def values(qp: QuadraticProgram, fixed: Tensor) -> Tensor:
        full = FullSpace.of(qp, fixed)
        G, h = full.one_sided()
        Q = full.Q + CURVATURE * torch.eye(len(full.Q)).to(full.Q)
        # ProxSuite would return the mean of the batch's gradients for shared matrices.
        Q, G, A = (matrix.expand(len(fixed), -1, -1) for matrix in (Q, G, full.A))
        return full.value(layer(Q, full.p, G, h, A, full.b))

    return values


def cvxpylayers() -> Values:
    """Compile the QP as printed in eq:qp2 once for V and once for Q; the solver is Clarabel."""
    CvxpyLayer = import_module("cvxpylayers.torch").CvxpyLayer
    layers: dict[int, Any] = {}

    def values(qp: QuadraticProgram, fixed: Tensor) -> Tensor:
        soft = qp.w.isfinite()
        n_f = fixed.shape[-1]
        if n_f not in layers:
            layers[n_f] = _cvxpy_layer(CvxpyLayer, qp, n_f)
        # H is diagonal; a square root has no derivative at zero.
        root = (qp.H.diagonal() + 1e-12).sqrt()
        operands = root, qp.q, qp.C, qp.b, qp.G, qp.lb, qp.ub, qp.w[soft], fixed
        z, sigma = layers[n_f](*operands)
        return 0.5 * (z @ qp.H * z).sum(-1) + z @ qp.q + qp.c + sigma @ qp.w[soft]

    return values


def _cvxpy_layer(CvxpyLayer: Any, qp: QuadraticProgram, n_f: int) -> Any:
    import cvxpy as cp

    soft = qp.w.isfinite().numpy()
    n_s = int(soft.sum())
    z, sigma = cp.Variable(qp.n_z), cp.Variable(n_s)
    shapes = (qp.n_z, qp.n_z, qp.C.shape, qp.b.shape, qp.G.shape, qp.lb.shape, qp.ub.shape)
    root, q, C, b, G, lb, ub = (cp.Parameter(shape) for shape in shapes)
    w, fixed = cp.Parameter(n_s, nonneg=True), cp.Parameter(n_f)
    slack = np.eye(len(soft))[:, soft] @ sigma
    cost = 0.5 * cp.sum_squares(cp.multiply(root, z)) + q @ z + w @ sigma
    constraints = [C @ z == b, lb - slack <= G @ z, G @ z <= ub + slack, sigma >= 0]
    # Hard rows of fixed entries are left out: they would leave no interior.
    free = np.arange(len(soft)) >= n_f
    keep = (soft | free).nonzero()[0]
    constraints[1] = lb[keep] - slack[keep] <= (G @ z)[keep]
    constraints[2] = (G @ z)[keep] <= ub[keep] + slack[keep]
    problem = cp.Problem(cp.Minimize(cost), [*constraints, z[:n_f] == fixed])
    parameters = [root, q, C, b, G, lb, ub, w, fixed]
    return CvxpyLayer(problem, parameters, [z, sigma], solver_args={"solve_method": "CLARABEL"})


def clarabel() -> Values:
    """Solve with Clarabel through qpsolvers, one QP at a time, with this package's gradient.

    The Lagrangian with x and the multipliers held has the value's gradient.
    """
    import_module("clarabel")

    def values(qp: QuadraticProgram, fixed: Tensor) -> Tensor:
        full = FullSpace.of(qp, fixed)
        G, h = full.one_sided()
        P, A, rows = (sp.csc_matrix(m.detach().numpy()) for m in (full.Q, full.A, G))
        p, b, right = (v.detach().numpy() for v in (full.p, full.b, h))
        found = [
            qpsolvers.solve_problem(qpsolvers.Problem(P, p[i], rows, right[i], A, b[i]), "clarabel")
            for i in range(len(fixed))
        ]
        x, y, z = (torch.from_numpy(np.array([getattr(f, n) for f in found])) for n in "xyz")
        cost = full.value(x) + (y * (x @ full.A.mT - full.b)).sum(-1)
        return cost + (z * (x @ G.mT - h)).sum(-1)

    return values


def moreau(device: str, solver: str) -> Values:
    """Make Moreau's torch layer, at its default tolerances, for each size of a batch."""
    package, Solver = import_module("moreau"), import_module("moreau.torch").Solver
    layers: dict[torch.Size, Any] = {}

    def values(qp: QuadraticProgram, fixed: Tensor) -> Tensor:
        full = FullSpace.of(qp, fixed)
        G, h = full.one_sided()
        matrices = full.Q, torch.cat((full.A, G))
        if fixed.shape not in layers:
            # Entries that are zero today, of G and of the diagonal of H, are learned, too.
            masks = [(full.Q != 0) | torch.eye(len(full.Q)).to(full.Q).bool()]
            masks.append(torch.ones_like(matrices[1], dtype=torch.bool))
            patterns = [sp.csr_matrix(mask.cpu().numpy()) for mask in masks]
            places = [torch.from_numpy(x) for P in patterns for x in (P.indptr, P.indices)]
            cones = package.Cones(num_zero_cones=len(full.A), num_nonneg_cones=len(G))
            settings = package.Settings(device=device, solver=solver, batch_size=len(fixed))
            layers[fixed.shape] = masks, Solver(*reversed(masks[1].shape), *places, cones, settings)
        masks, layer = layers[fixed.shape]
        P, A = (x[mask] for x, mask in zip(matrices, masks, strict=True))
        return full.value(layer.solve(P, A, full.p, torch.cat((full.b, h), dim=1)).x)

    return values


PEERS: dict[str, Callable[[], Values]] = {
    "ProxSuite's QPFunction": proxsuite,
    "qpth": qpth,
    "cvxpylayers": cvxpylayers,
    "Clarabel through qpsolvers": clarabel,
}


#: Solves QP k of a batch in full space, and returns x.
Step = Callable[[int], np.ndarray]


def values_of(full: FullSpace, step: Step) -> Callable[[], Tensor]:
    """Make a function that solves all QPs, one at a time, and returns values ``(B,)``."""
    every = range(len(full.p))
    return lambda: full.value(torch.from_numpy(np.array([step(k) for k in every]))).detach()


def piqp_step(full: FullSpace) -> Step:
    """Make PIQP's sparse solver: one setup. Rows of sigma >= 0, and hard rows, are bounds on x."""
    piqp = import_module("piqp")
    Q, A, G = (sp.csc_matrix(matrix.detach().numpy()) for matrix in (full.Q, full.A, full.G))
    p, b, lower, upper = (v.detach().numpy() for v in (full.p, full.b, full.l, full.u))
    lower, upper = (np.where(abs(v) < INFINITE, v, np.copysign(np.inf, v)) for v in (lower, upper))
    single = np.diff(G.tocsr().indptr) == 1
    rows, columns = G[single].nonzero()
    columns = columns[np.argsort(rows)]
    if not (G[single].data == 1).all():
        raise ValueError("G: single entries other than 1, expected the identity's")
    x_l, x_u = np.full_like(p, -np.inf), np.full_like(p, np.inf)
    x_l[:, columns], x_u[:, columns] = lower[:, single], upper[:, single]
    G, lower, upper = sp.csc_matrix(G[~single]), lower[:, ~single], upper[:, ~single]
    solver = piqp.SparseSolver()

    def arguments(k: int) -> dict[str, Any]:
        vectors = {"c": p[k], "b": b[k], "h_l": lower[k], "h_u": upper[k]}
        return vectors | {"x_l": x_l[k], "x_u": x_u[k]}

    def step(k: int) -> np.ndarray:
        solver.update(**arguments(k))
        solver.solve()
        return np.array(solver.result.x)

    solver.setup(P=Q, A=A, G=G, **arguments(0))
    return step


def clarabel_step(full: FullSpace, tolerance: float = 1e-8) -> Step:
    """Make Clarabel, set up again for each QP; its default tolerances are 1e-8."""
    clarabel = import_module("clarabel")
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
    G, h = full.one_sided()
    rows = sp.csc_matrix(torch.cat((full.A, G)).detach().numpy())
    Q, p = sp.csc_matrix(full.Q.detach().triu().numpy()), full.p.detach().numpy()
    right = torch.cat((full.b, h), dim=1).detach().numpy()
    cones = [clarabel.ZeroConeT(len(full.A)), clarabel.NonnegativeConeT(len(G))]

    def step(k: int) -> np.ndarray:
        solution = clarabel.DefaultSolver(Q, p[k], rows, right[k], cones, settings).solve()
        if "Solved" not in str(solution.status):
            raise RuntimeError(f"Clarabel: {solution.status}")
        return np.array(solution.x)

    return step


def osqp_step(full: FullSpace, **options: Any) -> Step:
    """Make OSQP at tolerances of 1e-6, warm-started unless ``options`` say otherwise."""
    solver = import_module("osqp").OSQP()
    p, b, lower, upper = (v.detach().numpy() for v in (full.p, full.b, full.l, full.u))
    lower, upper = np.hstack((b, lower)), np.hstack((b, upper))
    rows = sp.csc_matrix(torch.cat((full.A, full.G)).detach().numpy())
    Q = sp.triu(sp.csc_matrix(full.Q.detach().numpy()), format="csc")
    options = {"verbose": False, "eps_abs": 1e-6, "eps_rel": 1e-6, **options}
    solver.setup(Q, p[0], rows, lower[0], upper[0], **options)

    def step(k: int) -> np.ndarray:
        solver.update(q=p[k], l=lower[k], u=upper[k])
        return solver.solve().x

    return step
