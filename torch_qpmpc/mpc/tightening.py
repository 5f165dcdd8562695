"""Chance constraints: soft rows tightened by the covariance of the predictions' errors.

With the model x+ = A x + B u + v, v of covariance W, and the feedback u_k + K e_k on the error e_k
of the prediction x_k, the error's covariance is

    Sigma_{k+1} = (A + B K) Sigma_k (A + B K)' + W,

and a row g'z <= ub holds with a given probability for a Gaussian error if ub is replaced by ub less
the quantile times the standard deviation of g'z. K = 0 is the open loop. Colored noise is white
after its states have been added to x.

References:
    Farina, Giulioni and Scattolini, "Stochastic linear model predictive control with chance
    constraints - a review" (Journal of Process Control 44, 2016), section 3.
"""

import torch
from scipy.special import ndtri
from torch import Tensor

from torch_qpmpc.checks import check_kind, check_number, check_tensor
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.validation import without_gradients


def prediction_covariance(
    A: Tensor, W: Tensor, horizon: int, initial: Tensor | None = None
) -> Tensor:
    """Return the covariances of the errors of x_0, .., x_N, ``(N + 1, n_x, n_x)``.

    They grow from ``initial``, zero by default, by ``A``, or A + B K with a feedback, and the
    covariance ``W`` of the noise, over a ``horizon`` N.
    """
    covariances = [torch.zeros_like(W) if initial is None else initial]
    for _ in range(horizon):
        covariances.append(A @ covariances[-1] @ A.mT + W)
    return torch.stack(covariances)


@without_gradients
def tighten(
    mpc: QPMPC, covariances: Tensor, probability: float = 0.95, K: Tensor | None = None
) -> None:
    """Tighten each soft row so that it holds with a probability, and change ``mpc`` in place.

    Each row is a constraint by itself. Correlation between stages, which matters to rows of
    changes of the action alone, is neglected. Two bounds of a row that would cross meet halfway.

    Args:
        mpc: the QPMPC, whose bounds must not be learned.
        covariances: those of the errors of x_0, .., x_N, ``(N + 1, n_x, n_x)``.
        probability: that of each row, from 0.5 to less than 1.
        K: the feedback u_k + K e_k, ``(n_u, n_x)``; zero by default.

    Raises:
        QPError: an argument does not fit, or the bounds are learned.
    """
    check_kind("mpc", mpc, QPMPC)
    n_x, n_u, N = mpc.n_x, mpc.n_u, mpc.horizon
    check_tensor("covariances", covariances, N + 1, n_x, n_x, batched=False)
    if not covariances.isfinite().all():
        raise QPError.expected("covariances", "NaN or inf", "finite entries")
    check_number("probability", probability, lambda x: 0.5 <= x < 1, "a probability in [0.5, 1)")
    if learned := {"lb", "ub"} & {*mpc.learned}:
        got = f"one that learns {' and '.join(sorted(learned))}"
        raise QPError.expected("mpc", got, "fixed bounds", "Leave lb and ub out of learn.")
    K = covariances.new_zeros(n_u, n_x) if K is None else K
    check_tensor("K", K, n_u, n_x, batched=False)
    errors, S = torch.cat((torch.eye(n_x).to(K), K)).to(mpc.lb), mpc.lb.new_zeros(mpc.n_z, mpc.n_z)
    for k, covariance in enumerate(covariances.to(mpc.lb)):
        first = mpc.n_p + (k - 1) * n_x + k * n_u  # of x_k in z
        stage = slice(first, min(first + n_x + n_u, mpc.n_z))
        part = errors[: stage.stop - first]  # without an action for x_N
        S[stage, stage] = part @ covariance @ part.mT
    variance = ((mpc.G @ S) * mpc.G).sum(-1).clamp(min=0)  # of each row's g'z
    margin = float(ndtri(probability)) * variance.sqrt()
    lb, ub = mpc.lb + margin, mpc.ub - margin
    halfway, crossed = (mpc.lb + mpc.ub) / 2, lb > ub
    mpc.lb.copy_(torch.where(mpc.soft, torch.where(crossed, halfway, lb), mpc.lb))
    mpc.ub.copy_(torch.where(mpc.soft, torch.where(crossed, halfway, ub), mpc.ub))
