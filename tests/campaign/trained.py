"""Matrices from training with an absurd learning rate."""

import functools

import torch
from torch import Tensor

from tests.problems import random_mpc, random_states

UPDATES, SNAPSHOTS, RATE = 2000, 8, 1.0


@functools.cache
def trained(updates: int = UPDATES) -> list[tuple[Tensor, Tensor, Tensor, int]]:
    """Record H, C, G and n_f of V and Q at equal intervals of semi-gradient Q-learning."""
    mpc = random_mpc(0, learn=("H", "H_f", "q", "c", "C"), on_failure="mask")
    optimizer = torch.optim.Adam(mpc.parameters(), lr=RATE)
    found = []
    for update in range(updates):
        s, after = random_states(8, seed=update), random_states(8, seed=-1 - update)
        a = random_states(8, 1, size=0.5, seed=update)
        with torch.no_grad():
            target = s.square().sum(-1) + 0.9 * mpc.value(after)
        error = mpc.action_value(s, a) - target
        error = torch.where(error.isfinite(), error, 0.0)
        optimizer.zero_grad()
        error.clamp(-50, 50).square().mean().backward()
        optimizer.step()
        if (update + 1) % (updates // SNAPSHOTS) == 0:
            qp = mpc.quadratic_program()
            H, C, G = (x.detach().clone() for x in (qp.H, qp.C, qp.G))
            found += [(H, C, G, n_f) for n_f in (mpc.n_x, mpc.n_x + mpc.n_u)]
    return found
