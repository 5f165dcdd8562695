"""Logged trajectories of an ARX plant with two lags, two outputs, an action and a known signal."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor

A = torch.tensor([[1.5, 0.1, -0.56, 0.0], [0.0, 1.2, 0.05, -0.35]]).double()
B = torch.tensor([[0.5, 0.2], [0.1, 0.4]]).double()
E = torch.tensor([[0.3], [-0.2]]).double()
OFFSET = torch.tensor([0.1, -0.3]).double()


def arx_log(
    seed: int = 0, episodes: int = 3, steps: int = 40, noise: float = 0.0, preview: int = 3
) -> TensorDict:
    """Simulate trajectories side by side, with d_k, .., d_{k+preview-1} as their preview."""
    random = torch.Generator().manual_seed(seed)

    def normal(*size: int) -> Tensor:
        return torch.randn(episodes, *size, generator=random, dtype=torch.float64)

    u, d = normal(steps, 1).clamp(-1, 1), normal(steps + preview, 1)
    y = list(normal(2, 2).unbind(1))
    past = normal(1)  # the action before the first step
    for t in range(steps):
        e = OFFSET + noise * normal(2)
        outputs, actions = torch.cat((y[-1], y[-2]), -1), torch.cat((u[:, t], past), -1)
        y.append(outputs @ A.mT + actions @ B.mT + d[:, t] @ E.mT + e)
        past = u[:, t]
    y = torch.stack(y[1:], dim=1)
    done = torch.zeros(episodes, steps, 1, dtype=torch.bool)
    done[:, -1] = True
    entries = {
        "observation": y[:, :-1].clone(),
        "action": u,
        "preview": d.unfold(1, preview, 1)[:, :steps].flatten(2),
        "next": {"observation": y[:, 1:].clone(), "done": done},
    }
    return TensorDict(entries, [episodes, steps])
