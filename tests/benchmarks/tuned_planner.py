"""The tuning of leap-c's planner of the house: ``python -m tests.benchmarks.tuned_planner``.

It prints the knobs that are `tuned_planner.TUNED`. As in leap-c's tutorial (notebook 08), Adam
minimises the cost of closed loops of 12 hours from four times of a day, by gradients that pass
through each QP's solution and each step of the true house, whose gain is recorded.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.envs.heated_house import DAY
from torch_qpmpc.envs.house import House
from torch_qpmpc.experiment.rivals.tuned_planner import GAMMA, START, Knobs, planner
from torch_qpmpc.qp.program import QuadraticProgram
from torch_qpmpc.qp.solve import solve_qp

#: The tutorial's closed loops: their first steps, and their length.
FIRST, STEPS = (0, 24, 48, 72), 48


def tune(house: House, updates: int = 25, seed: int = 0, lr: float = 2e-2) -> Knobs:
    """Return the knobs after ``updates`` of Adam on the two days that ``seed`` draws."""
    w = house.signals(np.random.default_rng(seed), 1, 2 * DAY + house.horizon + 1)[0]
    theta = torch.tensor(START, dtype=torch.float64, requires_grad=True)
    program = differentiable_program(house)
    optimizer = torch.optim.Adam([theta], lr=lr)
    for _ in range(updates):
        optimizer.zero_grad()
        rollout(house, program(theta), w).backward()
        optimizer.step()
        with torch.no_grad():
            theta.clamp_(min=theta.new_tensor([0.5, 0.0, -torch.inf]))
    return Knobs(*theta.tolist())


def differentiable_program(house: House) -> Callable[[Tensor], QuadraticProgram]:
    """Return the planner's QP as a function of its knobs ``(3,)``: C is linear in 1 / R."""
    base = planner(house, Knobs(1.0, 0.0, 0.0)).quadratic_program()
    other = planner(house, Knobs(2.0, 1.0, 1.0)).quadratic_program()
    rise = (other.lb - base.lb).nan_to_num()

    def program(theta: Tensor) -> QuadraticProgram:
        R, price_weight, margin = theta
        return QuadraticProgram(
            H=torch.lerp(base.H, other.H, price_weight),
            q=base.q,
            c=base.c,
            C=torch.lerp(base.C, other.C, 2 - 2 / R),
            b=base.b,
            G=base.G,
            lb=base.lb + margin * rise,
            ub=base.ub,
            w=base.w,
            check_values=False,
        )

    return program


def rollout(house: House, qp: QuadraticProgram, w: Tensor) -> Tensor:
    """Return the mean discounted cost of the closed loops with the signals ``w (length, n_w)``."""
    first = torch.tensor(FIRST)
    x, J = house.starts(np.random.default_rng(), len(first)), w.new_zeros(())
    for k in range(STEPS):
        steps = first + k
        known = w[steps.unsqueeze(-1) + torch.arange(house.horizon + 1), : house.n_d]
        z = solve_qp(qp, torch.cat((known.flatten(1), x), -1), solver="daqp").z
        u = z[:, house.n_p : house.n_p + 1]
        J = J + GAMMA**k * house.cost(x, u, w[steps]).mean()
        x = house.step(x, u, w[steps])
    return J


if __name__ == "__main__":
    print(tune(House()))
