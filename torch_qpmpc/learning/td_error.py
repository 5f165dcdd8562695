"""TD errors of a batch: the usable pairs, their losses, weights and scalars that describe them."""

import warnings

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_qpmpc.mpc.validation import without_gradients
from torch_qpmpc.qp.tracing import has_values

#: The scalars that describe a batch.
TD_SCALARS = ("td_error", "pred_value", "target_value", "pred_value_max", "target_value_max")
TD_SCALARS += ("unsolved", "invalid_reward")
#: Added to each regressor of the variance before its logarithm, as a fraction of its mean.
OFFSET = 0.05
#: Added to delta^2, and smallest variance, as a fraction of the batch's median.
FLOOR = 0.01
#: Smallest batch to which the variance is fitted.
LEAST = 16
#: Deviations below this fraction of an input are rounding; keeps collinear inputs apart, too.
TINY, SMALLEST = 1e-9, torch.finfo(torch.float64).tiny


def usable(value: Tensor, target: Tensor) -> Tensor:
    """Return True for pairs with a finite Q, as of a solved QP, and a finite target, ``(*batch,)``.

    If none is left, a `RuntimeWarning` says so.
    """
    solved = value.isfinite()
    use = solved & target.isfinite()
    if has_values(use) and not use.any():
        count, found = use.numel(), int(solved.sum())
        message = f"None of the {count} pairs is usable: {count - found} without a QP solution, "
        message += f"{found} without a finite target. Theta stays unchanged."
        warnings.warn(message, RuntimeWarning, stacklevel=3)
    return use


def td_loss(prediction: Tensor, target: Tensor, clip: float | None = None) -> Tensor:
    """Return the loss of each TD error delta = target - prediction, ``(*batch,)``.

    It is ``1/2 delta^2``, whose gradient step with rate alpha is the paper's update alpha delta
    grad Q (eq:thup). With ``clip`` it is Huber's loss, which clips that delta to plus or minus it.
    """
    if clip is None:
        return 0.5 * (target - prediction).square()
    return F.huber_loss(prediction, target, reduction="none", delta=clip)


def td_metadata(prediction: Tensor, target: Tensor, use: Tensor) -> dict[str, Tensor]:
    """Return detached scalars that describe a batch of values and their targets, ``(*batch,)``.

    Of pairs not to ``use``, those with NaN targets count as invalid rewards, others as unsolved.
    """
    invalid = target.isnan()
    prediction, target = torch.where(use, prediction, 0), torch.where(use, target, 0)

    def mean(x: Tensor) -> Tensor:
        return x.sum() / use.sum().clamp(min=1)

    def largest(x: Tensor) -> Tensor:
        return x.masked_fill(~use, -torch.inf).max().nan_to_num(neginf=0.0)

    means = mean((target - prediction).abs()), mean(prediction), mean(target)
    counts = (~use & ~invalid).sum(), invalid.sum()
    scalars = *means, largest(prediction), largest(target), *counts
    return dict(zip(TD_SCALARS, scalars, strict=True))


def invalid_rewards(reward: Tensor, key: object) -> Tensor:
    """Return True where a reward ``(*batch, 1)`` is NaN or infinite; warn, with their ``key``."""
    invalid = ~reward.isfinite()
    if has_values(invalid) and (count := int(invalid.sum())):
        message = f"{key}: {count} of {invalid.numel()} rewards are NaN or infinite. Those "
        message += "transitions are left out of the loss and its gradient."
        warnings.warn(message, RuntimeWarning, stacklevel=3)
    return invalid


@without_gradients
def inverse_variance(p: Tensor, a: Tensor, value: Tensor, error: Tensor, use: Tensor) -> Tensor:
    """Return one over the variance of each TD error, relative to its mean, ``(B,)``.

    The estimate of least variance weights each squared error by one over its error's variance
    (Aitken, "On least squares and linear combinations of observations", 1935). The log of the
    variance is linear in the logs of the squares of p and a, as deviations from their means, and of
    |Q(p, a)| (Harvey, "Estimating regression models with multiplicative heteroscedasticity",
    Econometrica 1976). Its coefficients are the least-squares fit to the batch's log delta^2. Pairs
    that are not to ``use`` ``(B,)``, and all if they are few or without an error, have the weight
    one. p is ``(B, n_p)``, a ``(B, n_u)``, and ``value`` Q(p, a) and ``error`` are ``(B,)``.
    """
    weight = torch.ones_like(error)
    p, a, value, square = (x[use].double() for x in (p, a, value, error.square()))
    if len(square) < LEAST or not square.any():
        return weight
    inputs = _square(p), _square(a), value.abs()
    logs = [torch.log(OFFSET + x / x.mean().clamp(min=SMALLEST)) for x in inputs]
    features = F.pad(torch.stack(logs, -1), (1, 0), value=1.0)
    offset = FLOOR * square.median() + TINY * square.mean()
    gram = features.mT @ features + TINY * len(square) * torch.eye(4).to(square)
    beta = torch.linalg.solve(gram, features.mT @ torch.log(square + offset))
    log_variance = features @ beta
    inverse = 1 / torch.exp(log_variance - log_variance.median()).clamp(min=FLOOR)
    weight[use] = (inverse / inverse.mean()).to(weight)
    return weight


def _square(x: Tensor) -> Tensor:
    """Return the mean square of each row's standardised entries, ``(B,)``."""
    deviation = x - x.mean(0)
    least = (TINY * x).square().amax(0).clamp(min=SMALLEST)
    return (deviation.square() / deviation.square().mean(0).maximum(least)).mean(-1)
