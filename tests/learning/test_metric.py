"""The metric of Gauss-Newton's steps: no units, and sizes that fall slowly."""

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests.problems import random_mpc, random_states
from torch_qpmpc import QPMPC, GaussNewton

COUNT = 7


def in_units(x: Tensor, u: float, d: float, cost: float, learn: tuple[str, ...]) -> QPMPC:
    """Make one QP with a preview in units x ``(2,)`` of the states, u, d, and of the cost."""
    A = torch.tensor([[0.8, 0.2], [-0.1, 0.7]]).double()
    B = torch.tensor([[0.1], [0.3]]).double()
    of_row, bound = x.unsqueeze(-1), torch.ones(2)
    return QPMPC.of(
        2,
        1,
        4,
        n_d=1,
        A=of_row * A / x,
        B=of_row * B / u,
        E=of_row * torch.tensor([[0.3], [0.1]]) / d,
        state_bounds=(-x * bound, x * bound),
        action_bounds=([-0.5 * u], [0.5 * u]),
        stage_weight=cost * torch.tensor([1.0, 0.5, 0.1]) / torch.cat((x, torch.tensor([u]))) ** 2,
        terminal_weight=cost / x**2,
        state_slack=10 * cost / x,
        learn=learn,
        solver="daqp",
    )


#: Units of the states, the action, the preview and the cost, and the parts that learn alike.
UNITS = {
    "unlike states": ((1e-2, 1e2), 1.0, 1.0, 1.0, ("q", "c", "C", "b")),
    "temperatures and prices": ((20.0, 5.0), 3.0, 0.15, 1.0, ("q", "c", "C", "b")),
    "cost": ((1.0, 1.0), 1.0, 1.0, 1e-3, ("H", "q", "c", "C", "b", "lb", "ub")),
}


@pytest.mark.parametrize("options", [{}, {"lr": 0.5}])
@pytest.mark.parametrize("name", UNITS)
def test_a_qp_learns_alike_in_any_units(name, options):
    states, u, d, cost, learn = UNITS[name]
    x = torch.tensor(states, dtype=torch.float64)
    plain = in_units(torch.ones(2).double(), 1.0, 1.0, 1.0, learn)
    other = in_units(x, u, d, cost, learn)
    column, row = torch.cat((x, torch.tensor([u, d])))[plain.layout.signals()], x.repeat(4)
    optimizers = [GaussNewton(mpc, **options) for mpc in (plain, other)]
    errors = []
    for update in range(8):
        p = random_states(COUNT, plain.n_p, size=0.9, seed=update % 2)
        a, s = random_states(COUNT, 1, size=0.45, seed=update % 2 + 9), p[:, -2:]
        target = (s @ torch.tensor([[1.5, 0.4], [0.4, 1.0]]).double() * s).sum(-1) + p[:, 0] + 1.0
        one = optimizers[0].step(p, a, target)
        same = optimizers[1].step(column[: plain.n_p] * p, u * a, cost * target)
        assert same.accepted == one.accepted
        assert same.ratio == pytest.approx(one.ratio, rel=1e-4, nan_ok=True)
        assert_close(same.solution.value / cost, one.solution.value, rtol=1e-5, atol=1e-5)
        errors.append((one.solution.value - target).square().mean().item())
    assert_close(other.C / row.unsqueeze(-1) * column, plain.C, rtol=1e-4, atol=1e-5)
    assert_close(other.b / row, plain.b, rtol=1e-4, atol=1e-5)
    assert_close(other.q / cost * column, plain.q, rtol=1e-4, atol=1e-5)
    assert_close(other.c / cost, plain.c, rtol=1e-4, atol=1e-5)
    assert errors[-1] < 0.7 * errors[0]


def test_a_part_moves_no_more_freely_as_its_gradients_vanish():
    """A single pair near the origin has hardly any gradient in C, but one in c."""
    s, a = random_states(COUNT, 2, size=0.9), random_states(COUNT, 1, size=0.45, seed=1)
    for steps in (0, 3):
        mpc = random_mpc(2, free=0.0, learn=("c", "C"))
        optimizer = GaussNewton(mpc)
        for _ in range(steps):
            optimizer.step(s, a, mpc.action_value(s, a).detach())
        C = mpc.C.detach().clone()
        optimizer.step(1e-3 * s[:1], 1e-3 * a[:1], torch.ones(1).double())
        moved = (mpc.C.detach() - C).abs().max()
        assert (moved < 1e-5) == (steps > 0)
    assert mpc.c > 0.9


def test_signals_that_are_always_zero_do_no_harm():
    """From the origin nothing has a gradient but c; then one state is zero, and then none."""
    options = {"stage_weight": [1.0, 1.0, 0.0], "learn": ("c", "C"), "solver": "daqp"}
    mpc = QPMPC.from_model(0.9 * torch.eye(2), [[0.0], [1.0]], 3, **options)
    optimizer = GaussNewton(mpc)
    for s in ([0.0, 0.0], [0.0, 1.0], [1.0, 1.0]):
        s, a = torch.tensor([s]).double(), torch.zeros(1, 1).double()
        target = mpc.action_value(s, a).detach() + 0.1
        C = mpc.C.detach().clone()
        assert optimizer.step(s, a, target).accepted
        assert (mpc.action_value(s, a) - target).abs() < 0.05
        assert (mpc.C - C).abs().max() < 0.1
