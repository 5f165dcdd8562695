"""The solution of a batch of QPs, and its active set."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torch_qpmpc.qp.program import QuadraticProgram, Status
from torch_qpmpc.qp.tracing import full_precision, has_values

#: A multiplier this close to w, relatively, is saturated.
SATURATED = 1e-8


def saturated_rows(lam: Tensor, w: Tensor) -> Tensor:
    """Return the mask of rows with |lam| = w, ``(*batch, n_g)``."""
    return w.isfinite() & (lam.abs() >= (1 - SATURATED) * w)


def upper_share(z: Tensor, lam: Tensor, G: Tensor, lb: Tensor, ub: Tensor) -> Tensor:
    """Return the derivative of eta in lam, ``(*batch, n_g)``: 1 at ub, 0 at lb.

    The sign of lam decides, for lam = 0 the nearer bound; 1/2 if both are equally near.
    """
    y = _rows(z, G)
    side = torch.where(lam == 0, (y - lb) - (ub - y), lam).detach()
    return (1 + side.nan_to_num().sign()) / 2  # NaN where both bounds are infinite


@dataclass(frozen=True, repr=False)
class QPSolution:
    """Primal-dual solution of a batch of QPs.

    value, z, chi, lam and xi are differentiable in the tensors of the QP and in the fixed entries.
    An unsolved element (``status != 0``; only with ``on_failure`` "warn" or "mask") has
    ``value = inf``, the fixed entries in ``z``, zeros elsewhere, and no gradient.

    Attributes:
        qp: the solved QPs.
        value: optimal cost, ``(*batch,)``.
        z: minimiser, ``(*batch, n_z)``.
        chi: multipliers of C z = b, ``(*batch, n_c)``.
        lam: signed multipliers eta - upsilon of the rows, ``(*batch, n_g)``.
        xi: multipliers of the fixed entries, ``(*batch, n_f)``: the paper's xi, then zeta.
        status: `Status` as integers, ``(*batch,)``.
        residual: relative KKT residual, from the certificate, ``(*batch,)``.
        value_error: bound of the error of ``value``, relative to the largest of 1/2 z'Hz, q'z,
            w'sigma and their sum (but to no more than 1e3 times the sum), or, if larger, to 1e-6 of
            |Hz + q|'(ub - lb), of entries with hard bounds, or 1e-8 of all terms, ``(*batch,)``.
        iterations: the solver's iterations, ``(*batch,)``.
        active: the active set as int8 ``(*batch, n_g)``, a warm start for a nearly equal QP. Rows
            are 0 without a multiplier, 1 if held at ub, -1 if held at lb, 2 and -2 if saturated
            there (eta = w, upsilon = w), and 127 in unsolved elements.

    Example:
        >>> import torch, torch_qpmpc as qm
        >>> options = {"stage_weight": [1.0, 0.1], "action_bounds": ([-1.0], [1.0])}
        >>> mpc = qm.QPMPC.from_model([[1.0]], [[1.0]], 1, **options)
        >>> solution = mpc.solve(torch.tensor([3.0]))  # z = (x_0, u_0, x_1)
        >>> solution.z.detach().round(decimals=3).tolist(), solution.active.tolist()
        ([3.0, -1.0, 2.0], [0, -1, 0])
    """

    qp: QuadraticProgram
    value: Tensor
    z: Tensor
    chi: Tensor
    lam: Tensor
    xi: Tensor
    status: Tensor
    residual: Tensor
    value_error: Tensor
    iterations: Tensor
    active: Tensor

    def __repr__(self) -> str:
        """Show sizes, the count of each status, and the range of the values."""
        lines = [
            f"batch_shape={tuple(self.status.shape)}, n_f={self.xi.shape[-1]}",
            f"qp={self.qp!r}",
        ]
        if has_values(self.status):
            solved = self.solved
            outcome = [f"solved {int(solved.sum())} of {solved.numel()}"]
            for status in list(Status)[1:]:
                if count := int((self.status == status).sum()):
                    outcome.append(f"{count} {status.name}")
            lines.append(", ".join(outcome))
            if solved.any():
                value, residual = self.value.detach()[solved], self.residual[solved].max()
                of_values = f"value from {value.min():.4g} to {value.max():.4g}"
                lines.append(f"{of_values}, residual up to {residual:.2g}")
        body = ",\n".join(f"    {line}" for line in lines)
        return f"QPSolution(\n{body},\n)"

    @property
    def solved(self) -> Tensor:
        """Mask of elements with a certified solution, ``(*batch,)``."""
        return self.status == Status.SOLVED

    @property
    def sigma(self) -> Tensor:
        """Slacks, ``(*batch, n_g)``, zero on hard rows."""
        qp = self.qp
        return self._where_solved(slacks(self.z, qp.G, qp.lb, qp.ub, qp.w))

    @property
    def upsilon(self) -> Tensor:
        """Multipliers of the lower bounds, ``(*batch, n_g)``, non-negative."""
        return (-self.lam).clamp(min=0)

    @property
    def eta(self) -> Tensor:
        """Multipliers of the upper bounds, ``(*batch, n_g)``, non-negative."""
        return self.lam.clamp(min=0)

    @property
    def mu(self) -> Tensor:
        """Multipliers of sigma >= 0, ``w - upsilon - eta``, ``(*batch, n_g)``; inf on hard rows."""
        return self._where_solved(self.qp.w - self.upsilon - self.eta)

    def _where_solved(self, rows: Tensor) -> Tensor:
        return torch.where(self.solved.unsqueeze(-1), rows, 0)


def slacks(z: Tensor, G: Tensor, lb: Tensor, ub: Tensor, w: Tensor) -> Tensor:
    """Return sigma, the violation of soft rows by z, ``(*batch, n_g)``; zero on hard rows."""
    y = _rows(z, G)
    return torch.where(w.isinf(), 0, torch.maximum(lb - y, y - ub).relu())


def _rows(z: Tensor, G: Tensor) -> Tensor:
    with full_precision(z):
        return z @ G.mT if G.ndim == 2 else (z.unsqueeze(-2) @ G.mT).squeeze(-2)
