"""The cost of a scheme from the rewards of a log."""

from __future__ import annotations

import warnings
from typing import Any

import torch
from torch import Tensor

from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.cost import Cost
from torch_qpmpc.mpc.innovations import Innovations
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.mpc.log import NEXT, logs, valid_steps
from torch_qpmpc.mpc.stage_cost import StageCost, fit_stage_cost
from torch_qpmpc.mpc.validation import ungraded

REMEDY = (
    "Pass stage_weight (in train.py task.stage_weight), the weight W of the cost "
    "1/2 [x; u]' W [x; u], such as [1.0, 1.0, 0.1] for two states and an action."
)
#: The least R2 without a warning, and the gain in R2 that is worth a cost of the next state.
GOOD, GAIN = 0.9, 1e-3


def fit_rewards(
    log: Any, layout: Layout, diagonal: bool = False, model: Innovations | None = None
) -> StageCost:
    """Fit the stage cost of (d_k, x_k, u_k) to the rewards of a log, as `fit_stage_cost`.

    Many plants reward the next state. With a ``model`` a cost of (x_{k+1}, u_k) is fitted, too: if
    it explains more, it is returned as the cost of (x_k, u_k) that the model makes of it, but not
    for a ``diagonal`` W or with known signals. An R2 below 0.9 is warned of.

    Raises:
        QPError: rewards ``("next", "reward")`` are missing or not finite.
    """
    parts = zip(*(_observed(steps, layout) for steps in logs(log)), strict=True)
    x, u, following, cost = map(torch.cat, parts)
    fitted = fit_stage_cost(torch.cat((x, u), -1), cost, layout.n_d, diagonal)
    if model is not None and not diagonal and not layout.n_d:
        after = fit_stage_cost(torch.cat((following, u), -1), cost)
        if after.R2 > fitted.R2 + GAIN:
            fitted = _before(after, model)
    if not fitted.R2 >= GOOD:
        warnings.warn(poor(fitted.R2), UserWarning, stacklevel=2)
    return fitted


def _before(after: StageCost, model: Innovations) -> StageCost:
    """Return the cost of (x_k, u_k) whose (x_{k+1}, u_k) has the cost ``after``, in the mean."""
    (n, n_u), W = model.B.shape, after.W
    A, B, _, offset, _, L, S = (torch.tensor(part) for part in model[:7])
    M = torch.cat((torch.cat((A, B), -1), torch.eye(n + n_u).to(W)[n:]))
    m = torch.nn.functional.pad(offset, (0, n_u))
    noise = (W[:n, :n] * (L @ S @ L.mT)).sum() / 2
    c = after.c + m @ W @ m / 2 + after.q @ m + noise
    return StageCost(M.mT @ W @ M, M.mT @ (after.q + W @ m), c, after.R2)


def scheme_cost(fitted: StageCost, layout: Layout, gamma: float, hessian: str) -> Cost:
    """Return the cost of a scheme from a stage's, which x_N has, too."""
    n_d, n_x, n_u, N = layout.n_d, layout.n_x, layout.n_u, layout.horizon
    diagonal = hessian == "diagonal"
    W = fitted.W[n_d:, n_d:].diagonal() if diagonal else fitted.W
    terminal = W[:n_x] if diagonal else W[: n_d + n_x, : n_d + n_x]
    d, x, u = fitted.q.split((n_d, n_x, n_u))
    q = torch.cat((d.repeat(N + 1), layout.stages(x.expand(N + 1, -1), u)))
    ahead = gamma ** torch.arange(N + 1, dtype=torch.float64)
    return Cost(W, terminal, hessian, q=q, c=fitted.c * ahead.sum())


def _observed(steps: Any, layout: Layout) -> tuple[Tensor, ...]:
    """Return [d; x], u, the next x and the costs of the steps that are not padding."""
    reward = steps.get(("next", "reward"), None) if hasattr(steps, "batch_size") else None
    if reward is None:
        raise _unfitted("a log without rewards")
    kept = valid_steps(steps)
    reward = ungraded("reward", reward).detach().cpu().reshape(steps.shape)[kept].double()
    if not reward.isfinite().all():
        raise _unfitted("a log with rewards of NaN or inf")
    u = steps["action"]
    d = steps["preview"][..., : layout.n_d] if layout.n_d else u[..., :0]
    x, following = (steps[key][..., -layout.n_x :] for key in ("observation", NEXT))
    d, x, u, following = (part.detach().cpu().double()[kept] for part in (d, x, u, following))
    return torch.cat((d, x), -1), u, following, -reward


def poor(R2: float) -> str:
    """Say that a fitted cost explains the rewards poorly."""
    return (
        f"The fitted stage cost explains {R2:.1%} of the rewards' variance: the controller "
        "minimises another cost than the plant's. Pass the plant's own cost as stage_weight (a "
        "matrix with hessian='block'), in train.py task.stage_weight, or a log about the states "
        "where the controller is to work."
    )


def _unfitted(got: str) -> QPError:
    expected = "a weight, or finite rewards to fit a cost to"
    return QPError.expected("stage_weight", f"none, and {got}", expected, REMEDY)
