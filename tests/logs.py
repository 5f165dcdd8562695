"""Logs of an ARX plant with two lags, of a room as a table, and overrides of train.py."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import torch
from tensordict import TensorDict
from torch import Tensor

A = torch.tensor([[1.5, 0.1, -0.56, 0.0], [0.0, 1.2, 0.05, -0.35]]).double()
B = torch.tensor([[0.5, 0.2], [0.1, 0.4]]).double()
E = torch.tensor([[0.3], [-0.2]]).double()
OFFSET = torch.tensor([0.1, -0.3]).double()
#: Overrides of train.py: a double integrator whose position is measured.
LINEAR = (
    "task=linear",
    "task.A=[[1, 0.2], [0, 0.9]]",
    "task.B=[[0], [0.2]]",
    "task.C_y=[[1, 0]]",
    "task.outputs=[s]",
    "task.inputs=[F]",
    "task.Q={s: 1}",
    "task.R={F: 0.1}",
    "task.dR={F: 0.2}",
    "task.r={s: 1}",
    "task.noise={s: 0.01, F: 0.02}",
    "task.y_bounds={s: [-2, 2]}",
    "task.u_bounds={F: [-1, 1]}",
)


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


def log_overrides(folder: Path, steps: int = 200) -> tuple[str, ...]:
    """Write a room's log to ``folder``, and return the overrides of train.py that learn from it."""
    file = folder / "room.csv"
    rows = room(steps).assign(
        price=0.1 * np.sin(np.arange(steps)), target=8.0 + np.arange(steps) // 50 % 2
    )
    rows.loc[steps // 2 :, "target"] = 9.0
    noise = 0.05 * np.random.default_rng(1).normal(size=steps)
    rows.assign(T=rows["T"] + noise).rename(columns={"T": "T [degC]"}).to_csv(file, index=False)
    names = ("task.outputs=[T]", "task.inputs=[q]", "task.known=[T_out,price,target]")
    cost = ("task.Q={T: 1}", "task.r={T: target}", "task.R={q: 0.1}", "task.linear={q: price}")
    bounds = ("task.y_bounds={T: [5, 12]}", "task.u_bounds={q: [-1, 3]}")
    return ("task=log", f"task.file={file}", *names, "task.time=t", *cost, *bounds)
