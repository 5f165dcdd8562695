"""Learned dynamics: networks where they predict better than a linear model, and what uses them."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torch_qpmpc as qm
from tests.refused import refused
from torch_qpmpc import QPMPC
from torch_qpmpc.identification import learned
from torch_qpmpc.identification.learned import LearnedModel, fit_learned, identify_nonlinear


@pytest.fixture(autouse=True, scope="module")
def short_training():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(learned, "STEPS", 400)
        yield


def pendulum_log(noise: float = 0.0, episodes: int = 60, steps: int = 20) -> Any:
    rng, log = np.random.default_rng(0), []
    for _ in range(episodes):
        u, y = rng.uniform(-2, 2, (steps, 1)), rng.uniform(-2, 2, (steps + 1, 2))
        for t in range(steps):
            angle, rate = y[t]
            y[t + 1] = angle + 0.2 * rate, 0.9 * rate - 0.6 * np.sin(angle) + 0.6 * u[t, 0]
        log.append({"y": y + noise * rng.normal(size=y.shape), "u": u})
    return log


@pytest.fixture(scope="module")
def model() -> LearnedModel:
    log = pendulum_log()
    cost = [1 - np.cos(x["y"][:-1, 0]) + 0.01 * x["u"][:, 0] ** 2 for x in log]
    return identify_nonlinear(log, np.concatenate(cost))


def linear_log(noise: float) -> tuple[dict[str, np.ndarray], Tensor, Tensor]:
    A = torch.tensor([[0.9, 0.2], [-0.1, 0.8]]).double()
    B = torch.tensor([[0.1], [0.5]]).double()
    rng = np.random.default_rng(1)
    u, y = rng.uniform(-1, 1, (600, 1)), np.zeros((601, 2))
    for t in range(600):
        y[t + 1] = A.numpy() @ y[t] + B.numpy() @ u[t] + noise * rng.normal(size=2)
    return {"y": y, "u": u}, A, B


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_a_linear_plant_has_no_networks(noise):
    log, A, B = linear_log(noise)
    v = np.concatenate((log["y"][:-1], log["u"]), 1)
    model = identify_nonlinear(log, (v**2).sum(1) / 2)
    assert model.depth == 0
    x, u = torch.randn(5, 2, generator=torch.Generator().manual_seed(0)).double(), torch.ones(5, 1)
    after, cost = model(x, u)
    assert_close(after, x @ A.T + u.double() @ B.T, rtol=0, atol=1e-6 + noise / 2)
    assert_close(cost, (x.square().sum(1) + 1) / 2, rtol=0, atol=1e-6)


def test_a_nonlinear_plant_has_networks(model):
    assert model.depth == 6
    assert model.left[1] < 0.2
    assert model.left[2] < 0.2
    angle = torch.linspace(-2, 2, 9).double()
    x = torch.stack((angle, torch.zeros(9).double()), -1)
    after, cost = model(x, torch.zeros(9, 1))
    assert_close(after[:, 0], angle, rtol=0, atol=1e-2)  # linear: of the ridge
    assert_close(after[:, 1], -0.6 * angle.sin(), rtol=0, atol=0.1)
    assert_close(cost, 1 - angle.cos(), rtol=0, atol=0.15)
    assert model(x[0], torch.zeros(1))[0].shape == (2,)
    nested, of_cost = model(x.view(3, 3, 2), torch.zeros(3, 3, 1))
    assert_close(nested.flatten(0, 1), after)
    assert of_cost.shape == (3, 3)


def test_a_quadratic_cost_has_no_network_on_a_nonlinear_plant():
    log = pendulum_log()
    v = np.concatenate([np.concatenate((x["y"][:-1], x["u"]), 1) for x in log])
    model = identify_nonlinear(log, (v**2).sum(1) / 2)
    assert model.depth == 6
    x = torch.linspace(-2, 2, 9).double().unsqueeze(1).expand(9, 2)
    assert_close(model(x, torch.zeros(9, 1))[1], x[:, 0] ** 2, rtol=0, atol=1e-6)


def test_safety_stock_is_held_where_the_cost_has_a_kink():
    """The best stock to order up to is 8.35, where one day in ten has more demand, and costs 5.2.

    Networks that are as smooth as others at the scale of the log's stocks predict twice this.
    """
    rng, log, cost = np.random.default_rng(3), [], []
    for _ in range(30):
        u, demand, y = rng.uniform(0, 12, 40), rng.gamma(4, 5 / 4, 40), np.full(41, 5.0)
        for t in range(40):
            y[t + 1] = y[t] + u[t] - demand[t]
        log.append({"y": y, "u": u})
        cost.append(np.maximum(y[1:], -9 * y[1:]))
    model = identify_nonlinear(log, np.concatenate(cost))
    stock = torch.linspace(0, 20, 81).double().unsqueeze(1)
    expected = model(torch.zeros_like(stock), stock)[1]
    assert expected.min() < 9
    assert_close(stock[expected.argmin(), 0].item(), 8.35, rtol=0, atol=4)


def test_noise_does_not_hide_the_curvature():
    model = identify_nonlinear(pendulum_log(noise=0.05))
    assert model.depth == 6
    x = torch.tensor([[1.5, 0.0]]).double()
    assert_close(model(x, torch.zeros(1, 1))[0, 1], -0.6 * x[0, 0].sin(), rtol=0, atol=0.15)


def test_known_signals_are_inputs_of_the_model():
    v = torch.randn(300, 4, generator=torch.Generator().manual_seed(0)).double()
    d, x, u = v.split((1, 2, 1), -1)
    model = fit_learned(v, x, x + 0.1 * u + torch.cat((d, 2 * d), -1))
    assert_close(model(x, u, d), x + 0.1 * u + torch.cat((d, 2 * d), -1))


def test_a_set_point_in_the_outputs_is_held_and_a_quantised_output_is_not():
    """The mean of jumps that nothing predicts would draw a plan's set-point to the middle."""
    rng = np.random.default_rng(1)
    u, r = rng.uniform(-1, 1, (900, 1)), rng.choice([-1.0, 0.0, 1.0], 46).repeat(20)[:901, None]
    y = np.zeros((901, 1))
    for t in range(900):
        y[t + 1] = 0.98 * y[t] + 0.05 * u[t]
    rough = np.round(20 * y) / 20
    model = identify_nonlinear({"y": np.hstack((y, r, rough)), "u": u})
    x = torch.tensor([[0.3, 1.0, 0.3], [-0.2, -1.0, -0.2]], dtype=torch.float64)
    after = model(x, torch.zeros(2, 1, dtype=torch.float64))
    assert_close(after[:, 1], x[:, 1], rtol=0, atol=1e-9)
    assert (after[:, 2] - x[:, 2]).abs().max() > 1e-3


def test_a_qpmpc_plans_with_the_model_and_is_saved_with_it(model, tmp_path):
    options: Any = {"stage_weight": [1e-3] * 3, "action_bounds": ([-2.0], [2.0])}
    mpc = QPMPC.of(2, 1, 8, dynamics=model, iterations=40, solver="daqp", gamma=1.0, **options)
    s = torch.tensor([[0.5, 0.0], [1.5, -0.5]]).double()
    solution: Any = mpc.solve(s)
    assert solution.converged.all()
    x = s
    with torch.no_grad():
        for k in range(8):
            x = model(x, solution.plan[:, k])[0]
    assert (x[:, 0].abs() < 0.1).all()
    mpc.save(tmp_path / "mine.qpmpc")
    twin = QPMPC.load(tmp_path / "mine.qpmpc")
    assert_close(twin.value(s), mpc.value(s))
    assert_close(LearnedModel(**model.arguments)(s, s[:, :1]), model(s, s[:, :1]))


@refused(
    ((pendulum_log(episodes=1, steps=6),), "trajectories: got 6 steps"),
    ((pendulum_log(episodes=1, steps=50), np.ones(3)), "cost: got 3 numbers, expected 50"),
)
def test_invalid_arguments_are_errors(arguments):
    qm.identify_nonlinear(*arguments)
