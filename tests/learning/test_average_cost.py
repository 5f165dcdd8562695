"""Differential TD errors, on a scalar linear system whose noise is +-STD."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch.testing import assert_close

from tests.learning.test_warm_start import transitions
from tests.problems import random_mpc
from torch_qpmpc import QPMPC, GaussNewton, QPActorValueOperator, QPError, QPQLearningLoss
from torch_qpmpc.learning.updates import first_order, second_order

A, B, R, STD = 0.9, 0.5, 0.5, 0.3


def riccati(gamma: float) -> tuple[float, float]:
    """Return P and the gain K of V = P s^2 and a = -K s for the stage cost s^2 + R a^2."""
    P = K = 0.0
    for _ in range(1000):
        K = gamma * A * B * P / (R + gamma * B * B * P)
        P = 1 + R * K * K + gamma * P * (A - B * K) ** 2
    return P, K


def grid() -> TensorDict:
    """Make transitions from a grid of s and a, with both values of the noise for each."""
    x = torch.linspace(-2, 2, 5).double()
    noise = STD * torch.tensor([-1.0, 1.0]).double()
    s, a, w = (part.reshape(-1, 1) for part in torch.meshgrid(x, x, noise, indexing="ij"))
    done = torch.zeros(len(s), 1, dtype=torch.bool)
    reward = -(s.square() + R * a.square())
    following = {"observation": A * s + B * a + w, "reward": reward}
    following |= {"done": done, "terminated": done.clone()}
    return TensorDict(observation=s, action=a, next=following, batch_size=len(s))


def learned(average_cost: bool, gamma: float, updates: int) -> tuple[QPMPC, Any]:
    """Learn a QP of two stages from a wrong terminal cost."""
    cost = {"stage_weight": [2.0, 2 * R], "terminal_weight": [0.1], "learn": ("H", "H_f", "c")}
    mpc = QPMPC.from_model([[A]], [[B]], 2, gamma=gamma, solver="daqp", seed=0, **cost)
    loss = QPQLearningLoss(QPActorValueOperator(mpc), average_cost=average_cost)
    loss.make_value_estimator(gamma=gamma)
    update = second_order(mpc, loss, GaussNewton(mpc), None, None)
    for _ in range(updates):
        update(grid(), None)
    return mpc, loss


def gain(mpc: QPMPC) -> float:
    return -mpc.policy(torch.ones(1, 1).double()).item()


def test_rho_is_the_average_cost_and_q_the_differential_value():
    mpc, loss = learned(True, 1.0, 10)
    P, K = riccati(1.0)
    assert loss.average_cost.item() == pytest.approx(P * STD**2, rel=1e-5)
    assert gain(mpc) == pytest.approx(K, rel=1e-5)
    assert mpc.c == 0
    batch = grid()
    s, a = batch["observation"], batch["action"]
    ahead = s * A + a * B
    expected = (s.square() + R * a.square() + P * ahead.square()).squeeze(-1)
    offset = mpc.action_value(s, a).detach() - expected
    assert_close(offset, offset.mean().expand_as(offset), rtol=0, atol=1e-4)


def test_a_discounted_target_has_the_discounted_gain():
    mpc, _ = learned(False, 0.95, 10)
    assert gain(mpc) == pytest.approx(riccati(0.95)[1], rel=1e-3)
    assert gain(mpc) < 0.97 * riccati(1.0)[1]


def make_loss(**options: Any) -> Any:
    loss = QPQLearningLoss(QPActorValueOperator(random_mpc(3, **options)), average_cost=True)
    loss.make_value_estimator()
    return loss


def test_a_gradient_step_moves_rho_by_the_mean_td_error():
    """As Wan, Naik and Sutton (2021) do, with eta = 1; twice, so that rho enters the target."""
    loss, rate = make_loss(), 0.1
    mpc, batch = loss.operator.module, transitions()
    optimizer = torch.optim.SGD(mpc.parameters(), lr=rate)
    update, rho, c = first_order(mpc, loss, optimizer, None, None), 0.0, mpc.c.item()
    for _ in range(2):
        with torch.no_grad():
            after = mpc.value(batch["next", "observation"])
            cost = -batch["next", "reward"].squeeze(-1)
            delta = cost - rho + after - mpc.action_value(batch["observation"], batch["action"])
        rho += rate * delta.mean().item()
        terms, _ = update(batch.copy(), None)
        assert loss.average_cost.item() == pytest.approx(rho)
        assert terms["train/average_cost"] == loss.average_cost
        assert mpc.c.item() == c


def test_the_average_cost_is_part_of_the_state():
    loss = make_loss()
    loss.average_cost.fill_(2.0)
    twin = make_loss()
    twin.load_state_dict(copy.deepcopy(loss.state_dict()))
    assert twin.average_cost == 2.0
    plain = QPQLearningLoss(QPActorValueOperator(random_mpc(3)))
    assert not {"average_cost", "fixed_c"} & plain.state_dict().keys()


def test_bad_arguments():
    with pytest.raises(QPError, match="average_cost: got True, expected a QPMPC that learns c"):
        make_loss(learn=("H",))
    operator = QPActorValueOperator(random_mpc(3))
    with pytest.raises(QPError, match="average_cost: got 'no', expected True or False"):
        QPQLearningLoss(operator, average_cost="no")  # pyright: ignore[reportArgumentType] - wrong on purpose
    with pytest.raises(QPError, match=r"gamma: got 0\.9, expected 1 with average_cost"):
        make_loss().make_value_estimator(gamma=0.9)
