"""TD errors of a batch: the usable pairs, their loss, and the scalars that describe them."""

from __future__ import annotations

import warnings

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_qpmpc.qp.tracing import has_values


def usable(solved: Tensor, target: Tensor) -> tuple[Tensor, tuple[int, int]]:
    """Return True for pairs with a solution and a finite target, and how many lack each.

    A pair that lacks both counts as unsolved. If none is left, a `RuntimeWarning` says so.

    Args:
        solved: True for a pair with a solution, ``(B,)``.
        target: ``(B,)``.
    """
    use = solved & target.isfinite()
    unsolved = int((~solved).sum())
    left_out = unsolved, len(use) - unsolved - int(use.sum())
    if sum(left_out) == len(use):
        message = (
            f"None of the {len(use)} pairs is usable: {unsolved} without a QP solution, "
            f"{left_out[1]} without a finite target. Theta stays unchanged."
        )
        warnings.warn(message, RuntimeWarning, stacklevel=3)
    return use, left_out


def td_loss(prediction: Tensor, target: Tensor, clip: float | None = None) -> Tensor:
    """Return the loss of each TD error delta = target - prediction, ``(*batch,)``.

    It is ``1/2 delta^2``, whose gradient step with rate alpha is the paper's update alpha delta
    grad Q (eq:thup). With ``clip`` it is Huber's loss, which clips that delta to plus or minus it.
    """
    if clip is None:
        return 0.5 * (target - prediction).square()
    return F.huber_loss(prediction, target, reduction="none", delta=clip)


def td_metadata(prediction: Tensor, target: Tensor) -> dict[str, Tensor]:
    """Return detached scalars that describe a batch of values and their targets, ``(*batch,)``.

    Entries that are not finite are left out and counted: NaN targets as invalid rewards, the others
    as QPs without a solution.
    """
    use = prediction.isfinite() & target.isfinite()
    invalid = target.isnan()
    prediction, target = torch.where(use, prediction, 0), torch.where(use, target, 0)

    def mean(x: Tensor) -> Tensor:
        return x.sum() / use.sum().clamp(min=1)

    def largest(x: Tensor) -> Tensor:
        return x.masked_fill(~use, -torch.inf).max().nan_to_num(neginf=0.0)

    return {
        "td_error": mean((target - prediction).abs()),
        "pred_value": mean(prediction),
        "target_value": mean(target),
        "pred_value_max": largest(prediction),
        "target_value_max": largest(target),
        "unsolved": (~use & ~invalid).sum(),
        "invalid_reward": invalid.sum(),
    }


def invalid_rewards(reward: Tensor, key: object, effect: str) -> Tensor:
    """Return True where a reward ``(*batch, 1)`` is NaN or infinite, and warn if any is.

    Args:
        reward: the rewards.
        key: their name in the `RuntimeWarning`.
        effect: the consequence, a sentence for it.
    """
    invalid = ~reward.isfinite()
    if has_values(invalid) and (count := int(invalid.sum())):
        message = f"{key}: {count} of {invalid.numel()} rewards are NaN or infinite. {effect}"
        warnings.warn(message, RuntimeWarning, stacklevel=3)
    return invalid
