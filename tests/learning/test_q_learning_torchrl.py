"""TorchRL's contract of a loss module: estimators, target networks, copies, and resets."""

from typing import Any

import pytest
import torch
from torchrl.data import MultiStep
from torchrl.envs.utils import ExplorationType, exploration_type, set_exploration_type

from tests.transitions import (
    GAMMA,
    hand_prediction,
    learned_leaves,
    make_batch,
    make_loss,
    make_operator,
    perturb,
)
from torch_qpmpc import QPActorValueOperator


@pytest.mark.parametrize("n", [1, 2, 3])
def test_multi_step_returns(n):
    """r_t + gamma r_{t+1} + .., and gamma^k V(s_{t+k}) k steps on, cut at an episode's end.

    Episodes are only truncated, because `MultiStep` keeps the flags of the first step.
    """
    td = make_batch(3, 6)
    td["next", "terminated"] = torch.zeros(3, 6, 1, dtype=torch.bool)
    td["collector", "mask"] = torch.ones(3, 6, dtype=torch.bool)
    operator = make_operator()
    V = operator.module.value(td["next", "observation"]).detach()
    flags: Any = td["next"]
    expected = torch.zeros(3, 6, dtype=torch.float64)
    for i in range(3):
        for t in range(6):
            for k in range(n):
                j = t + k
                expected[i, t] += GAMMA**k * flags["reward"][i, j, 0]
                if flags["done"][i, j] or j == 5 or k == n - 1:
                    expected[i, t] -= GAMMA ** (k + 1) * V[i, j]
                    break
    batch = MultiStep(gamma=GAMMA, n_steps=n)(td.clone())
    out = make_loss(operator=operator, reduction="none")(batch)
    delta = expected - hand_prediction(operator.module, td)
    torch.testing.assert_close(out["loss_value"], 0.5 * delta**2, atol=1e-6, rtol=0)


class Spy(QPActorValueOperator):
    seen: ExplorationType | None = None

    def forward(self, tensordict: Any) -> Any:
        Spy.seen = exploration_type()
        return super().forward(tensordict)


def test_exploration_is_off_inside():
    loss = make_loss(operator=Spy(make_operator().module))
    with set_exploration_type(ExplorationType.RANDOM):
        loss(make_batch(2))
        assert Spy.seen == ExplorationType.DETERMINISTIC
        assert exploration_type() == ExplorationType.RANDOM


@pytest.mark.filterwarnings("ignore:No target network updater")
@pytest.mark.parametrize("delay_value", [False, True])
def test_reset_parameters_recursive(delay_value):
    loss = make_loss(delay_value=delay_value)
    start = loss.value_network_params.clone()
    perturb(loss)
    with torch.no_grad():
        loss.target_value_network_params.apply_(lambda x: x.add_(1) if x.is_floating_point() else x)
    loss.reset_parameters_recursive()
    for key, leaf in learned_leaves(loss).items():
        torch.testing.assert_close(leaf, start[key], atol=1e-12, rtol=0)
        torch.testing.assert_close(
            loss.target_value_network_params[key], start[key].data, atol=1e-12, rtol=0
        )
