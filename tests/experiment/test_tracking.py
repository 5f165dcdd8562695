"""The tanks' schemes: their costs, and models for windows of outputs."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

import torch_qpmpc as qm
from tests.benchmarks.offset import Reachable, controllers, steady_error
from torch_qpmpc.envs import FourTanks, TankReferences
from torch_qpmpc.experiment.rivals.linear_mpc import Tracking
from torch_qpmpc.experiment.tracking import (
    INPUT_WEIGHT,
    TERMINAL_FACTOR,
    offset_free,
    reference_scheme,
    set_point_scheme,
    window_model,
)


def lagged(A: Tensor, B: Tensor, y: Tensor, u: Tensor) -> Tensor:
    """Return the predictions of y_L, y_{L+1}, .. for y ``(T + 1, n_y)`` and u ``(T, n_u)``."""
    past = A.shape[-1] // len(A)
    rows = range(past - 1, len(u))
    newest_first = [
        (y[k + 1 - past : k + 1].flip(0).flatten(), u[k + 1 - past : k + 1].flip(0).flatten())
        for k in rows
    ]
    return torch.stack([A @ outputs + B @ actions for outputs, actions in newest_first])


def trajectory(plant: FourTanks, steps: int) -> tuple[Tensor, Tensor]:
    rng = np.random.default_rng(0)
    w, u = plant.signals(rng, 1, steps + 1)[0], torch.as_tensor(rng.uniform(-2, 2, (steps, 2)))
    x, y = torch.as_tensor(rng.uniform(size=4)), []
    for k in range(steps):
        y.append(plant.output(x, w[k]))
        x = plant.step(x, u[k], w[k])
    return torch.stack([*y, plant.output(x, w[steps])]), u


@pytest.mark.parametrize("past", [2, 5])
def test_a_window_of_two_outputs_is_enough_without_noise(past):
    p = FourTanks(state_std=0, output_std=0)
    y, u = trajectory(p, 20)
    C, V, E = FourTanks().measurement()
    A, B = window_model(p.A, p.B, C, V, E, past)
    torch.testing.assert_close(lagged(A, B, y, u), y[past:], atol=1e-5, rtol=0)


def test_a_longer_window_predicts_better_from_noisy_outputs():
    p = FourTanks()
    y, u = trajectory(p, 2000)
    errors = []
    for past in (2, 5, 10, 20):
        A, B = window_model(p.A, p.B, *p.measurement(), past)
        errors.append((lagged(A, B, y, u)[20 - past :] - y[20:]).square().mean().item())
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 1.5 * p.output_std**2  # of which the noise of y alone is two thirds


@pytest.mark.parametrize("memory", [1, 3])
def test_an_offset_free_model_predicts_that_nothing_changes(memory):
    torch.manual_seed(0)
    A, B = torch.randn(2, 4).double(), torch.randn(2, 2).double()  # two outputs, one action, L = 2
    lags, inputs = offset_free(A, B, memory)
    assert lags.shape == (2, 4 + 2 * memory)
    assert inputs.shape == (2, 2 + memory)
    constant = torch.randn(2).double()
    prediction = (
        lags @ constant.repeat(2 + memory) + inputs @ torch.full((2 + memory,), 3.0).double()
    )
    torch.testing.assert_close(prediction, constant)


def test_an_offset_free_model_adds_the_mean_of_the_last_errors():
    torch.manual_seed(0)
    A, B = torch.randn(2, 4).double(), torch.randn(2, 2).double()
    y, u = torch.randn(12, 2).double(), torch.randn(11, 1).double()
    errors = y[2:] - lagged(A, B, y, u)  # of y_2, y_3, ..
    mean = errors.unfold(0, 3, 1).mean(-1)[:-1]  # of y_2 to y_4, ..
    expected = lagged(A, B, y, u)[3:] + mean
    torch.testing.assert_close(lagged(*offset_free(A, B, memory=3), y, u), expected)


def test_the_value_at_the_set_point_is_the_discounted_cost_of_the_plan():
    p = FourTanks(horizon=6, past=3)
    A, B = window_model(p.A, p.B, *p.measurement(), p.past)
    mpc = qm.QPMPC(set_point_scheme(p, qm.Model(A, B), gamma=0.9), solver="daqp")
    window = torch.randn(p.n_p, generator=torch.Generator().manual_seed(1)).double() / 3
    solution = mpc.solve(window)
    y, u = mpc.predicted(solution.z.detach())
    stages = (y - p.r).square() @ p.weights()[0]
    stages[:-1] += INPUT_WEIGHT * (u - p.set_point()[1]).square().sum(-1)
    by_hand = (0.9 ** torch.arange(7)).double() @ stages
    torch.testing.assert_close(solution.value.detach(), by_hand)


def test_the_references_make_the_policy_of_an_mpc_that_is_written_by_hand():
    p = TankReferences(horizon=5, hold=3, price=50.0)
    rng = np.random.default_rng(0)
    w, x = p.signals(rng, 20, 6), p.starts(rng, 20)
    x[0] = 21.0  # beyond the bounds
    mpc = qm.QPMPC(reference_scheme(p, qm.Model(p.A, p.B), 1.0), solver="daqp")
    solution = mpc.solve(torch.cat((p.target(w).flatten(1), x), -1))
    cost = Tracking.of(p, TERMINAL_FACTOR)
    by_hand = qm.solve_qp(
        cost.program(p.A, p.B, 5, p.target(w), x.new_zeros(20, 5, 4)), x, solver="daqp"
    )
    plan = solution.z[:, -by_hand.z.shape[1] :]
    torch.testing.assert_close(plan.detach(), by_hand.z, atol=1e-5, rtol=0)
    # The scheme counts the violation of x_0, too, which no action changes.
    now = p.price * p.violation(x, w[:, 0])
    torch.testing.assert_close(solution.value.detach(), by_hand.value + now, rtol=1e-6, atol=0)


@pytest.mark.parametrize(("memory", "largest"), [(0, None), (1, 1e-3), (4, 1e-3)])
def test_only_an_offset_free_model_tracks_references_without_an_error(memory, largest):
    """The plant's leaks and gains differ three times as much from the model as learning-qp's."""
    p = Reachable(horizon=8, past=1 + memory, mismatch=3.0)
    A, B = offset_free(p.A, p.B, memory) if memory else (p.A, p.B)
    mpc = qm.QPMPC(reference_scheme(p, qm.Model(A, B), 1.0), solver="daqp")
    error = steady_error(mpc, p)
    if largest is None:
        assert error > 0.02
    else:
        assert error < largest


def test_a_learned_model_tracks_without_an_error_once_it_is_offset_free():
    short = ("updates=3", "warmup_steps=10", "gate=false", "batch_size=64", "task.eval_steps=5")
    found = controllers(1, *short)

    def error(name: str) -> float:
        mpc, cfg = found[name]
        return steady_error(mpc, Reachable(horizon=16, past=1 + cfg.task.memory), steps=120)

    assert error("learned") > 0.02
    assert error("learned model, offset-free") < 1e-3
    assert error("true model") < 1e-3
