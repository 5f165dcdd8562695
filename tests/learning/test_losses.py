"""The QP in TorchRL's losses: as critic, actor, mean and state value, and in ensembles."""

import io
from typing import Any

import pytest
import torch
from torch import Tensor
from torchrl.objectives import CQLLoss

from tests.losses import LOSSES, critic, make_batch, make_loss, network_gaussian, total
from torch_qpmpc import SolverError

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")
#: One loss for each role of the QP and each way in which TorchRL holds it.
ROLES = (
    *("critic of DDPG", "critics and value of IQL", "critic of DQN", "V and Q of Q-learning"),
    *("actor and critics of TD3", "mean and critics of SAC", "mean and value of PPO"),
    *("actor and critics of TD3, with a preview", "value of PPO, with a preview"),
)


def learned(loss: Any) -> dict[str, Tensor]:
    """Return a loss's learned parameters, without an actor's c, which no action depends on."""
    return {
        name: parameter
        for name, parameter in loss.named_parameters()
        if parameter.requires_grad and not (name.startswith("actor") and name.endswith(".c"))
    }


def train(name: str) -> Any:
    loss = make_loss(name)
    batch = make_batch(loss)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    for step in range(2):
        optimizer.zero_grad()
        total(loss, batch, seed=step).backward()
        optimizer.step()
    return loss


@pytest.mark.parametrize("name", LOSSES)
def test_gradients_reach_all_that_is_learned(name):
    loss = make_loss(name)
    total(loss, make_batch(loss)).backward()
    assert any(".module.C" in key for key in learned(loss)) or "DQN" in name
    for key, parameter in learned(loss).items():
        assert parameter.grad is not None, key
        assert parameter.grad.isfinite().all(), key
        assert parameter.grad.norm() > 0, key


@pytest.mark.parametrize("name", ROLES)
def test_training_moves_theta_can_be_repeated_and_saved(name):
    once, fresh = train(name), make_loss(name, seed=1)
    start, again = learned(make_loss(name)), learned(train(name))
    batch = make_batch(once)
    trained = total(once, batch)
    assert trained.isfinite()
    for key, parameter in learned(once).items():
        assert parameter.isfinite().all(), key
        assert not torch.equal(parameter, start[key]), key
        assert torch.equal(parameter, again[key]), key
    with torch.no_grad():
        assert not torch.equal(total(fresh, batch), trained)  # it registers buffers, too
    torch.save(once.state_dict(), file := io.BytesIO())
    file.seek(0)
    fresh.load_state_dict(torch.load(file, weights_only=True))
    assert torch.equal(total(fresh, batch), trained)


# --- Single losses and modules around them -------------------------------------------------------


def test_actions_beyond_a_critics_hard_bounds_are_refused_by_name():
    """CQL draws actions between -1 and 1, regardless of the action's bounds."""
    narrow = [critic(seed) for seed in (1, 2)]
    for operator in narrow:
        for bound in (operator.module.lb, operator.module.ub):
            bound[2] /= 4  # of u_0
    loss = CQLLoss(network_gaussian(), narrow)
    with pytest.raises(SolverError, match=r"INFEASIBLE.* soften rows with a finite w"):
        total(loss, make_batch())
