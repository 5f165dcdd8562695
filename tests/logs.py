"""Logs of an ARX plant with two lags, and of a room as a table."""

from typing import Any

import numpy as np
import pandas as pd
import torch
from tensordict import TensorDict
from torch import Tensor

from torch_qpmpc.identification.log import Log

#: The signals of `room`.
NAMES: Any = {"outputs": ["T"], "inputs": ["q"], "known": ["T_out"]}
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


def room(steps: int = 60, seed: int = 0) -> pd.DataFrame:
    """Simulate T+ = 0.9 T + 0.5 q + 0.1 T_out, one row every 15 minutes."""
    rng = np.random.default_rng(seed)
    T, q, T_out = np.zeros(steps), rng.uniform(0, 1, steps), rng.normal(8, 2, steps)
    for k in range(steps - 1):
        T[k + 1] = 0.9 * T[k] + 0.5 * q[k] + 0.1 * T_out[k]
    return pd.DataFrame({"t": 0.25 * np.arange(steps), "T": T, "q": q, "T_out": T_out})


def lengths(log: Log) -> list[int]:
    return [part.steps for part in log.trajectories]
