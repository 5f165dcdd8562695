"""The paper's step with H >= 0 (eq:sdp1), and the step rules that keep H positive semidefinite.

The program, with 1/2 |dtheta|^2 for the printed dtheta^2 (whose minimum is half a step),

    min over dtheta:  1/2 |dtheta|^2 - alpha g'dtheta   subject to   H(theta + dtheta) >= 0

has as its solution the point with H >= 0 nearest to the optimiser's proposal theta + alpha g: the
proposal without its negative eigenvalues, for each block of H. So ``"projection"`` and ``"sdp"``
make the same step, and ``"cholesky"`` another, in the factor of H, which needs neither.
"""

from collections.abc import Callable
from types import ModuleType

import numpy as np
import scipy
import torch
from torch import Tensor

from torch_qpmpc.checks import check_choice
from torch_qpmpc.errors import QPError, SolverError
from torch_qpmpc.mpc.validation import without_gradients

CHOLESKY = "cholesky"
#: Clarabel's full and reduced tolerances, for a program with entries of at most one.
TOLERANCE, LOOSE = 1e-10, 1e-7


def nearest_psd(H: Tensor) -> Tensor:
    """Return the positive semidefinite matrices nearest to H ``(*batch, n, n)``, Frobenius norm.

    An asymmetric H is replaced by its symmetric part; semidefinite matrices stay to the last bit,
    and those with NaN or inf, which the solve of the QP rejects.
    """
    return _replaced(H, _without_negative_eigenvalues)


@without_gradients
def nearest_psd_by_sdp(H: Tensor) -> Tensor:
    """Return `nearest_psd`, computed as a semidefinite program by Clarabel (eq:sdp1).

    The cost grows with the sixth power of n: a block of six takes milliseconds, a full H of 64
    (ten stages of six) half a minute.

    Raises:
        QPError: Clarabel is not installed, or H is invalid, as in `nearest_psd`.
        SolverError: Clarabel has not solved the program.
    """
    return _replaced(H, _solve_sdp)


def _without_negative_eigenvalues(H: Tensor) -> Tensor:
    eigenvalues, vectors = torch.linalg.eigh(H)
    return (vectors * eigenvalues.clamp(min=0).unsqueeze(-2)) @ vectors.mT


def _solve_sdp(H: Tensor) -> Tensor:
    """Solve min 1/2 |X - H|^2 subject to X >= 0, for all blocks ``(K, n, n)`` at once."""
    clarabel = _clarabel()
    scale = H.abs().amax((-2, -1), keepdim=True)
    count, n = len(H), H.shape[-1]
    # Clarabel's cone has the columns of the upper triangle, with sqrt(2) off the diagonal.
    rows, columns = np.tril_indices(n)
    weight = torch.from_numpy(np.where(rows == columns, 1.0, 2**0.5))
    proposal = (weight * (H / scale)[:, rows, columns].double().cpu()).flatten().numpy()
    unit, zero = scipy.sparse.identity(len(proposal), format="csc"), np.zeros(len(proposal))
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    for name in ("tol_gap_abs", "tol_gap_rel", "tol_feas"):
        setattr(settings, name, TOLERANCE)
        setattr(settings, f"reduced_{name}", LOOSE)
    cones = [clarabel.PSDTriangleConeT(n)] * count
    solution = clarabel.DefaultSolver(unit, -proposal, -unit, zero, cones, settings).solve()
    if str(solution.status) not in ("Solved", "AlmostSolved"):
        raise SolverError(f"Clarabel has not solved the program of eq:sdp1: {solution.status}.")
    # The slack, unlike x, is inside the cone at any tolerance.
    entries = (torch.tensor(solution.s, dtype=torch.float64).reshape(count, -1) / weight).to(H)
    if n == 1:
        # A curvature of 1e-11 would make the QP unsolvable.
        entries = torch.where(entries > LOOSE, entries, 0)
    nearest = torch.empty_like(H)
    nearest[:, rows, columns] = nearest[:, columns, rows] = entries
    return scale * nearest


#: The projections by step rule; ``"cholesky"`` needs none.
NEAREST: dict[str, Callable[[Tensor], Tensor]] = {
    "projection": nearest_psd,
    "sdp": nearest_psd_by_sdp,
}
STEPS = (CHOLESKY, *NEAREST)


def check_step(step: str) -> None:
    """Raise `QPError` unless ``step`` is a rule whose dependencies are installed."""
    check_choice("step", step, STEPS)
    if step == "sdp":
        _clarabel()


def _clarabel() -> ModuleType:
    try:
        import clarabel
    except ImportError as error:
        remedy = "Run pip install 'torch-qpmpc[sdp]', or use 'projection': the step is the same."
        raise QPError.expected("step", "'sdp' without Clarabel", "Clarabel", remedy) from error
    return clarabel


def _replaced(H: Tensor, nearest: Callable[[Tensor], Tensor]) -> Tensor:
    """Return the symmetric part of H, with ``nearest`` where an eigenvalue is negative."""
    H = (H + H.mT) / 2
    blocks = H.reshape(-1, *H.shape[-2:])
    finite = blocks.isfinite().all(-1).all(-1)
    eigenvalues = torch.linalg.eigvalsh(torch.where(finite[:, None, None], blocks, 0))
    rounding = H.shape[-1] * torch.finfo(H.dtype).eps * eigenvalues.abs().amax(-1)
    outside = eigenvalues[:, 0] < -rounding
    if not outside.any():
        return H
    replacement = nearest(blocks[outside])
    return blocks.index_put((outside,), (replacement + replacement.mT) / 2).view_as(H)
