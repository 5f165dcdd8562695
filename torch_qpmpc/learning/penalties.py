"""The penalties that pull C towards an MPC scheme's: deviation and system identification (SI).

Both are differentiable terms of a Q-learning loss; the deviation penalty also has an exact proximal
step.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from torch_qpmpc.checks import NONNEGATIVE, check_kind, check_number, check_tensor
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.layout import band_distance
from torch_qpmpc.mpc.module import QPMPC

WINDOWS_REMEDY = "Sample N consecutive transitions: s_j, a_j, .., s_{j+N}."


class DeviationPenalty(nn.Module):
    """The deviation penalty ``sum |C_mask * (C - C_0)|`` (eq:sdp2).

    With c_3 = 0 everything below the band is free: the prediction stays causal, but need not be
    Markovian.

    Args:
        mpc: the QPMPC, which has C_0 ``(N n_x, n_z)``.
        c_1: weight above the band, where the future would act on the past.
        c_2: weight on the band.
        c_3: weight below the band.

    Raises:
        QPError: if ``mpc`` is no QPMPC, or a weight is negative or not finite.

    Example:
        >>> import torch, torch_qpmpc as qm
        >>> mpc = qm.QPMPC.from_model(torch.eye(1), torch.eye(1), 3, stage_weight=[1.0, 0.1])
        >>> penalty = qm.DeviationPenalty(mpc)
        >>> penalty(mpc.C).item()
        0.0
    """

    C_0: Tensor
    C_mask: Tensor

    def __init__(
        self, mpc: QPMPC, *, c_1: float = 1.0, c_2: float = 1e-4, c_3: float = 0.0
    ) -> None:
        super().__init__()
        check_kind("mpc", mpc, QPMPC)
        for name, weight in {"c_1": c_1, "c_2": c_2, "c_3": c_3}.items():
            check_number(name, weight, *NONNEGATIVE)
        distance, mask = band_distance(mpc.layout).to(mpc.C_0), torch.full_like(mpc.C_0, c_2)
        mask[distance > 0], mask[distance < 0] = float(c_1), float(c_3)
        self.register_buffer("C_0", mpc.C_0.detach().clone())
        self.register_buffer("C_mask", mask)

    def forward(self, C: Tensor) -> Tensor:
        """Return the penalty of C ``(N n_x, n_z)``, a scalar."""
        check_tensor("C", C, *self.C_0.shape, batched=False, remedy="Pass mpc.C.")
        return (self.C_mask * (C - self.C_0)).abs().sum()

    @torch.no_grad()
    def proximal_step_(self, C: Tensor, scale: float = 1.0) -> None:
        """Soft-threshold C towards C_0, in place: the minimiser of eq:sdp2 in Delta theta.

        It solves ``min_X 1/2 |X - C|^2 + scale |C_mask * (X - C_0)|`` and, after a step of SGD, the
        paper's program; it ignores the metrics of Adam and Gauss-Newton.

        Args:
            C: the parameter, ``(N n_x, n_z)``.
            scale: weight of the penalty against the step; 1 is the paper's program.

        Raises:
            QPError: if C is computed from parameters or does not fit, or ``scale`` is negative.
        """
        check_tensor("C", C, *self.C_0.shape, batched=False, remedy="Pass mpc.C.")
        if C.grad_fn is not None:
            remedy = (
                "If only some entries of C are learned, pass mpc.leaves('C')[0]; a tied C is "
                "computed from A and B: call release() first."
            )
            raise QPError.expected("C", "a computed tensor", "a parameter", remedy)
        check_number("scale", scale, *NONNEGATIVE)
        excess = C - self.C_0
        C.copy_(self.C_0 + excess.sign() * (excess.abs() - scale * self.C_mask).clamp(min=0))


class SystemIdentificationPenalty(nn.Module):
    """The system-identification (SI) penalty ``beta sum_i ||C tau_i - b||^2`` (eq:sdp3).

    C and b have a gauge: T C and T b are the same QP for any invertible T, so that shrinking them
    lowers the penalty. For pairs of windows it takes the difference of their errors, which is white
    if the noise is a random walk.

    Args:
        beta: weight of the penalty.

    Raises:
        QPError: if beta is negative or not finite.

    Example:
        >>> import torch, torch_qpmpc as qm
        >>> mpc = qm.QPMPC.from_model(torch.eye(1), torch.eye(1), 1, stage_weight=[1.0, 0.1])
        >>> penalty = qm.SystemIdentificationPenalty(beta=0.5)
        >>> windows = torch.tensor([[1.0, 2.0, 3.0], [1.0, 2.0, 5.0]])  # [s_0, a_0, s_1]
        >>> penalty(mpc.C, windows).item()  # the second is 2 off the model s_1 = s_0 + a_0
        2.0
    """

    def __init__(self, beta: float = 1e-6) -> None:
        super().__init__()
        check_number("beta", beta, *NONNEGATIVE)
        self.beta = beta

    def curvature(self, windows: Tensor) -> Tensor:
        """Return S ``(n_z + 1, n_z + 1)``: the penalty as a quadratic ``1/2 tr(D S D')``.

        D is [C, b], for windows ``(M, n_z)``, or pairs ``(M, 2, n_z)``.
        """
        _check_windows(windows, "n_z")
        tau = _single(F.pad(windows.to(torch.float64), (0, 1), value=-1.0))
        return 2 * self.beta * tau.mT @ tau

    def forward(self, C: Tensor, windows: Tensor, b: Tensor | None = None) -> Tensor:
        """Return the penalty of C ``(n_c, n_z)`` and b on windows, a scalar.

        Args:
            C: ``(n_c, n_z)``.
            windows: tau_i = [s_j, a_j, s_{j+1}, .., s_{j+N}], ``(M, n_z)``, or pairs of neighbours
                tau_i, tau_{i+1}, ``(M, 2, n_z)``. With a preview, s_j is p at step j.
            b: ``(n_c,)``; None for zero.
        """
        check_tensor("C", C, "n_c", "n_z", batched=False, remedy="Pass mpc.C.")
        _check_windows(windows, C.shape[-1])
        b = C.new_zeros(len(C)) if b is None else b
        check_tensor("b", b, len(C), batched=False, remedy="Pass mpc.b.")
        return self.beta * _single(windows.to(C.dtype) @ C.mT - b).square().sum()


class Penalties(NamedTuple):
    """The penalties of an update; None for each that is off."""

    deviation: DeviationPenalty | None = None
    si: SystemIdentificationPenalty | None = None


def _check_windows(windows: Tensor, n_z: int | str) -> None:
    pairs = (2,) if isinstance(windows, Tensor) and windows.ndim == 3 else ()
    check_tensor("windows", windows, "M", *pairs, n_z, batched=False, remedy=WINDOWS_REMEDY)


def _single(rows: Tensor) -> Tensor:
    """Return rows ``(M, n)``, and the differences of pairs of rows ``(M, 2, n)``."""
    return rows if rows.ndim == 2 else rows[:, 1] - rows[:, 0]
