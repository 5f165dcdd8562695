"""Problems of the benchmarks: the paper's QP at any size, and random transitions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from torch_qpmpc import QPMPC
from torch_qpmpc.envs import PointMass

LEARN = ("H", "H_f", "q", "c", "C", "b", "G", "lb", "ub", "w")
GAMMA, SLACK = 0.9, 100.0
#: A dense C is the banded one plus normal entries, whose spectral norm is about twice this.
PERTURBATION = 0.3
#: States and actions are drawn within plus or minus these. The bounds of positions, 2, are soft;
#: those of the actions, 1, are hard, and stay out of reach when theta moves.
STATE_RANGE, ACTION_RANGE = 2.2, 0.9


@dataclass(frozen=True)
class Size:
    """Horizon N and numbers of states and actions."""

    horizon: int
    n_x: int
    n_u: int

    def __str__(self) -> str:
        return f"N{self.horizon}-x{self.n_x}-u{self.n_u}"


PAPER = Size(10, 4, 2)


@dataclass(frozen=True)
class Transitions:
    """A replayed batch: s, following ``(B, n_x)``, a ``(B, n_u)``, cost ``(B,)``; float64."""

    s: Tensor
    a: Tensor
    following: Tensor
    cost: Tensor

    def first(self, count: int) -> Transitions:
        return Transitions(
            self.s[:count], self.a[:count], self.following[:count], self.cost[:count]
        )


@cache
def model(n_x: int, n_u: int) -> tuple[Tensor, Tensor]:
    """Return A and B: the corrupted point mass for (4, 2), else a random stable system."""
    if (n_x, n_u) == (4, 2):
        A, B, _ = PointMass().corrupted(1)
        return A, B
    generator = torch.Generator().manual_seed(0)
    A = torch.randn(n_x, n_x, generator=generator, dtype=torch.float64)
    A = 0.95 * A / torch.linalg.eigvals(A).abs().max()
    return A, 0.1 * torch.randn(n_x, n_u, generator=generator, dtype=torch.float64)


def make_mpc(size: Size, *, dense: bool, solver: str = "daqp") -> QPMPC:
    """Make the QP with all of theta learned, soft states, hard actions and unweighted actions."""
    generator = torch.Generator().manual_seed(1)
    A, B = model(size.n_x, size.n_u)
    if (size.n_x, size.n_u) == (4, 2):
        physics = PointMass()
        state_bounds, weight = (physics.lb_s, physics.ub_s), physics.corrupted(1)[2]
    else:
        state_bounds = ([-2.0] * size.n_x, [2.0] * size.n_x)
        weight = 0.5 + 4.5 * torch.rand(size.n_x, generator=generator, dtype=torch.float64)
    mpc = QPMPC.from_model(
        A,
        B,
        size.horizon,
        gamma=GAMMA,
        state_bounds=state_bounds,
        action_bounds=([-1.0] * size.n_u, [1.0] * size.n_u),
        stage_weight=torch.cat((weight, weight.new_zeros(size.n_u))),
        terminal_weight=torch.ones_like(weight),
        state_slack=SLACK,
        learn=LEARN,
        solver=solver,
    )
    if dense:
        shift = torch.randn(mpc.C.shape, generator=generator, dtype=torch.float64)
        with torch.no_grad():
            mpc.C += PERTURBATION / len(mpc.C) ** 0.5 * shift
    return mpc


@cache
def transitions(n_x: int, n_u: int, count: int) -> Transitions:
    """Draw uniform states and actions, noisy next states of the model, and a quadratic cost."""
    generator = torch.Generator().manual_seed(2)

    def uniform(n: int, size: float) -> Tensor:
        return size * (2 * torch.rand(count, n, generator=generator, dtype=torch.float64) - 1)

    A, B = model(n_x, n_u)
    s, a = uniform(n_x, STATE_RANGE), uniform(n_u, ACTION_RANGE)
    noise = 0.01 * torch.randn(count, n_x, generator=generator, dtype=torch.float64)
    return Transitions(s, a, s @ A.mT + a @ B.mT + noise, s.square().sum(-1))


@torch.no_grad()
def nudge(mpc: QPMPC) -> None:
    """Change theta in its last digits, so that nothing computed from it can be reused."""
    for parameter in mpc.parameters():
        parameter *= 1 + 1e-13


@torch.no_grad()
def move(mpc: QPMPC, size: float) -> None:
    """Multiply every entry of theta by 1 plus a normal number of this standard deviation."""
    generator = torch.Generator().manual_seed(3)
    for parameter in mpc.parameters():
        shift = torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
        parameter *= 1 + size * shift
