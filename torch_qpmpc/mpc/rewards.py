"""The cost of a scheme from the rewards of a log."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.cost import Cost
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.mpc.stage_cost import StageCost, fit_stage_cost
from torch_qpmpc.mpc.trajectories import logs, valid_steps

REMEDY = (
    "Pass stage_weight (in train.py task.stage_weight), the weight W of the cost "
    "1/2 [x; u]' W [x; u], such as [1.0, 1.0, 0.1] for two states and an action."
)


def fit_rewards(log: Any, layout: Layout, diagonal: bool = False) -> StageCost:
    """Fit a stage cost of (d_k, y_k, u_k) to the rewards of a log, as `fit_stage_cost`.

    Args:
        log: logged steps, as in `read_trajectories`, with ``("next", "reward")``.
        layout: the sizes.
        diagonal: fit a diagonal W.

    Raises:
        QPError: rewards are missing or not finite.
    """
    v, cost = zip(*(_observed(steps, layout) for steps in logs(log)), strict=True)
    return fit_stage_cost(torch.cat(v), torch.cat(cost), layout.n_d, diagonal)


def scheme_cost(fitted: StageCost, layout: Layout, gamma: float, hessian: str) -> Cost:
    """Return the cost of a scheme for that of a stage, which is that of x_N, too."""
    n_d, n_x, n_u, N = layout.n_d, layout.n_x, layout.n_u, layout.horizon
    diagonal = hessian == "diagonal"
    W = fitted.W[n_d:, n_d:].diagonal() if diagonal else fitted.W
    terminal = W[:n_x] if diagonal else W[: n_d + n_x, : n_d + n_x]
    d, x, u = fitted.q.split((n_d, n_x, n_u))
    past = fitted.q.new_zeros(layout.n_before - layout.n_preview)
    stages = layout.stages(x.expand(N + 1, -1), u)
    ahead = gamma ** torch.arange(N + 1, dtype=torch.float64)
    q = torch.cat((d.repeat(N + 1), past, stages))
    return Cost(W, terminal, hessian, q=q, c=fitted.c * ahead.sum())


def _observed(steps: Any, layout: Layout) -> tuple[Tensor, Tensor]:
    """Return [d; y; u] and the costs of the steps that are not padding."""
    reward = steps.get(("next", "reward"), None) if hasattr(steps, "batch_size") else None
    if reward is None:
        raise _unfitted("a log without rewards")
    kept = valid_steps(steps)
    reward = reward.detach().cpu().reshape(steps.shape)[kept].double()
    if not reward.isfinite().all():
        raise _unfitted("a log with rewards of NaN or inf")
    parts = [steps["observation"][..., -layout.n_x :], steps["action"]]
    if layout.n_d:
        parts.insert(0, steps["preview"][..., : layout.n_d])
    v = torch.cat([part.detach().cpu().double() for part in parts], dim=-1)
    return v[kept], -reward


def _unfitted(got: str) -> QPError:
    expected = "a weight, or finite rewards to fit a cost to"
    return QPError.expected("stage_weight", f"none, and {got}", expected, REMEDY)
