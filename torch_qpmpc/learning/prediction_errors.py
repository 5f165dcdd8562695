"""One-step prediction errors: what a stream of transitions says of the model of a tied C.

With zeta = [p, a, x+, 1], the rows [C_1, -b_1] of the first stage predict with the errors
e = [C_1, -b_1] zeta. Of all transitions their second moments, for any C and b, are
[C_1, -b_1] M [C_1, -b_1]' with M = E[zeta zeta'], in which older transitions count less. M thus
holds a stream in a few numbers, as recursive least squares does: the errors' likelihood is a term
of Gauss-Newton's steps, and their covariance is that of the noise, by which bounds are tightened.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from torch_qpmpc.checks import check_kind, check_number, check_tensor, check_whole
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.validation import check_one_model
from torch_qpmpc.qp.program import QuadraticProgram

#: The smallest error variance, as a fraction of the output's mean square.
FLOOR = 1e-6


class PredictionErrors(nn.Module):
    """The prediction errors of the latest transitions, for any values of a tied C and b.

    Args:
        mpc: the QPMPC, with ``structure="tied"``.
        weight: beta, that of the errors' likelihood beside the TD errors'.
        memory: the number of transitions after which one counts 1 / e.

    Attributes:
        M: mean of zeta zeta', ``(n_zeta, n_zeta)``.
        count: the sum of the transitions' weights, at most ``memory``.

    Raises:
        QPError: C is not tied, there is a schedule, or a number is out of range.

    Example:
        >>> import torch, torch_qpmpc as qm
        >>> mpc = qm.QPMPC.linear_mpc([[1.0]], [[1.0]], horizon=3, stage_weight=[1.0, 1.0])
        >>> errors = PredictionErrors(mpc)
        >>> s, a = torch.rand(2, 100, 1, generator=torch.Generator().manual_seed(0))
        >>> following = 0.5 * s + a + torch.tensor([[0.1], [-0.1]]).repeat(50, 1)
        >>> errors.add(s, a, following)
        >>> optimizer = qm.GaussNewton(mpc, residuals=errors.residuals)
        >>> for _ in range(5):
        ...     target = (s.square() + a.square()).squeeze(-1) + 0.9 * mpc.value(following)
        ...     report = optimizer.step(s, a, target.detach())
        >>> [round(x.item(), 1) for x in mpc.model()]
        [0.5, 1.0]
    """

    M: Tensor
    count: Tensor

    def __init__(self, mpc: QPMPC, weight: float = 1.0, memory: int = 1000) -> None:
        super().__init__()
        check_kind("mpc", mpc, QPMPC)
        check_one_model(mpc)
        if mpc.structure != "tied":
            remedy = "A free C has SystemIdentificationPenalty.curvature."
            raise QPError.expected("mpc", f"structure={mpc.structure!r}", "'tied'", remedy)
        check_number("weight", weight, lambda x: 0 < x < math.inf, "a finite number > 0")
        check_whole("memory", memory, 1)
        self.weight, self.memory = weight, memory
        self._sizes = mpc.n_p, mpc.n_u, mpc.n_x
        n_zeta = sum(self._sizes) + 1
        self.register_buffer("M", mpc.lb.new_zeros(n_zeta, n_zeta))
        self.register_buffer("count", mpc.lb.new_zeros(()))

    @torch.no_grad()
    def add(self, p: Tensor, a: Tensor, following: Tensor) -> None:
        """Add transitions in the order of time; those with an entry that is not finite are omitted.

        Args:
            p, a: visited pairs, ``(B, n_p)`` and ``(B, n_u)``.
            following: the measured x+, ``(B, n_x)``.

        Raises:
            QPError: a shape does not fit.
        """
        n_p, n_u, n_x = self._sizes
        check_tensor("p", p, "B", n_p, batched=False)
        check_tensor("a", a, len(p), n_u, batched=False)
        check_tensor("following", following, len(p), n_x, batched=False)
        zeta = torch.cat((p, a, following, torch.ones_like(p[:, :1])), dim=-1).to(self.M)
        zeta = zeta[zeta.isfinite().all(-1)]
        ages = torch.arange(len(zeta) - 1, -1, -1).to(self.M)
        weights = math.exp(-1 / self.memory) ** ages
        before = math.exp(-1 / self.memory) ** len(zeta) * self.count
        self.count.copy_(before + weights.sum())
        total = before * self.M + (weights * zeta.mT) @ zeta
        self.M.copy_(total / self.count.clamp(min=1))

    def residuals(self, qp: QuadraticProgram) -> Tensor:
        """Return r ``(n_x n_zeta,)``, differentiable in C and b: r'r is beta times the errors'.

        1/2 r'r = beta / 2 sum_t sum_i e_ti^2 / v_i, with v_i the mean square of e_i at this C and
        b, which counts as constant: beta = 1 is the likelihood of all transitions.
        """
        n_zeta = len(self.M)
        eigenvalues, vectors = torch.linalg.eigh(self.M)
        root = vectors * eigenvalues.clamp(min=0).sqrt()
        errors = self._rows(qp) @ root
        variance = errors.detach().square().sum(-1)
        outputs = self.M.diagonal()[n_zeta - 1 - len(errors) : n_zeta - 1]
        variance = variance.maximum(FLOOR * outputs).clamp(min=torch.finfo(self.M.dtype).tiny)
        scale = (self.weight * self.count / variance).sqrt()
        return (scale.unsqueeze(-1) * errors).flatten()

    @torch.no_grad()
    def covariance(self, qp: QuadraticProgram) -> Tensor:
        """Return the covariance of the errors ``(n_x, n_x)``, zero before the first transition."""
        rows = self._rows(qp)
        mean = rows @ self.M[:, -1]
        return rows @ self.M @ rows.mT - mean.outer(mean)

    def _rows(self, qp: QuadraticProgram) -> Tensor:
        """Return [C_1, -b_1] ``(n_x, n_zeta)``."""
        n_x = self._sizes[-1]
        C = qp.C[:n_x, : len(self.M) - 1]
        return torch.cat((C, -qp.b[:n_x].unsqueeze(-1)), dim=-1).to(self.M)
