"""The QP in TorchRL's losses: as critic, actor, mean and state value, and in ensembles."""

import io
from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import (
    AddStateIndependentNormalScale,
    NormalParamExtractor,
    TensorDictModule,
    TensorDictSequential,
)
from torch import Tensor, nn
from torchrl import objectives
from torchrl.data import Bounded
from torchrl.modules import ProbabilisticActor, QValueActor, TanhNormal, ValueOperator

from tests.problems import random_mpc, random_states
from torch_qpmpc import QPMPC, QPActorValueOperator, QPQLearningLoss, SolverError

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")
GAMMA = 0.9
#: The action's bounds, and a grid over them for DQN.
BOUND = 1.0
BOUNDS: Any = (-BOUND, BOUND)
GRID = torch.linspace(-BOUND, BOUND, 5).unsqueeze(-1)


#: Keys of a QP that knows one signal ahead of time.
PREVIEW: dict[str, Any] = {"preview_key": "preview"}


def make_mpc(seed: int, n_d: int = 0) -> QPMPC:
    learn = ("H", "q", "c", "C", "b")
    bounds = ([-BOUND], [BOUND])
    return random_mpc(seed, learn=learn, state_slack=5.0, action_bounds=bounds, n_d=n_d)


def critic(seed: int = 1, **keys: Any) -> Any:
    return QPActorValueOperator(make_mpc(seed, n_d=len(keys.keys() & PREVIEW)), **keys)


def critics(count: int = 2, **keys: Any) -> Any:
    """Make an ensemble as a list: TorchRL fills copies of a single module with random numbers."""
    return [critic(seed, **keys) for seed in range(1, count + 1)]


def value(seed: int = 9, **keys: Any) -> Any:
    return critic(seed, **keys).get_value_operator()


def policy(seed: int = 0, **keys: Any) -> Any:
    return critic(seed, **keys).get_policy_operator()


def network_policy() -> Any:
    net = nn.Sequential(nn.Linear(2, 1), nn.Tanh())
    return TensorDictModule(net, in_keys=["observation"], out_keys=["action"])


class NetworkCritic(nn.Module):
    """An ordinary Q(s, a)."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(3, 8), nn.Tanh(), nn.Linear(8, 1))

    def forward(self, s: Tensor, a: Tensor) -> Tensor:
        return self.layers(torch.cat((s, a), -1))


class GridCritic(nn.Module):
    """-Q of each action of a grid, for DQN."""

    def __init__(self) -> None:
        super().__init__()
        self.mpc = make_mpc(1)

    def forward(self, s: Tensor) -> Tensor:
        batch = (*s.shape[:-1], len(GRID), -1)
        return -self.mpc.action_value(s.unsqueeze(-2).expand(batch), GRID.expand(batch))


def network_critic() -> Any:
    return ValueOperator(NetworkCritic(), in_keys=["observation", "action"])


def stochastic(location: Any) -> Any:
    """Make a stochastic policy around the output of ``location``."""
    return ProbabilisticActor(
        location,
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": -BOUND, "high": BOUND},
        spec=Bounded(-BOUND, BOUND, torch.Size([1])),
        return_log_prob=True,
    )


def network_gaussian() -> Any:
    net = nn.Sequential(nn.Linear(2, 2), NormalParamExtractor())
    return stochastic(TensorDictModule(net, ["observation"], ["loc", "scale"]))


def qp_gaussian(**keys: Any) -> Any:
    """Make a stochastic policy with the QP as its mean and a learned scale."""
    scale: Any = TensorDictModule(AddStateIndependentNormalScale(1), ["loc"], ["loc", "scale"])
    return stochastic(TensorDictSequential(policy(action_key="loc", **keys), scale))


def grid_critic() -> Any:
    return QValueActor(GridCritic(), in_keys=["observation"], action_space="one_hot")


#: Losses, named by the role of the QP.
LOSSES: dict[str, Callable[[], objectives.LossModule]] = {
    "critic of DDPG": lambda: objectives.DDPGLoss(network_policy(), critic(), delay_actor=True),
    "critics of TD3": lambda: objectives.TD3Loss(network_policy(), critics(), bounds=BOUNDS),
    "critics of CQL": lambda: objectives.CQLLoss(network_gaussian(), critics()),
    "critics and value of IQL": lambda: objectives.IQLLoss(network_gaussian(), critics(), value()),
    "critic of DQN": lambda: objectives.DQNLoss(grid_critic(), action_space="one_hot"),
    "V and Q of Q-learning": lambda: QPQLearningLoss(critic(), delay_value=True),
    "actor of DDPG": lambda: objectives.DDPGLoss(policy(), network_critic(), delay_actor=True),
    "actor and critics of TD3": lambda: objectives.TD3Loss(policy(), critics(), bounds=BOUNDS),
    "mean and critics of SAC": lambda: objectives.SACLoss(qp_gaussian(), critics()),
    "value and critics of SAC v1": lambda: objectives.SACLoss(
        network_gaussian(), critics(), value()
    ),
    "value of PPO": lambda: objectives.ClipPPOLoss(network_gaussian(), value()),
    "mean and value of PPO": lambda: objectives.ClipPPOLoss(qp_gaussian(), value()),
    "V and Q of Q-learning, with a preview": lambda: QPQLearningLoss(
        critic(**PREVIEW), delay_value=True
    ),
    "actor and critics of TD3, with a preview": lambda: objectives.TD3Loss(
        policy(**PREVIEW), critics(**PREVIEW), bounds=BOUNDS
    ),
    # TorchRL's losses pass the critics no entry that the actor does not read.
    "mean, critics and value of IQL, with a preview": lambda: objectives.IQLLoss(
        qp_gaussian(**PREVIEW), critics(**PREVIEW), value(**PREVIEW)
    ),
    "value of PPO, with a preview": lambda: objectives.ClipPPOLoss(
        network_gaussian(), value(**PREVIEW)
    ),
}


def make_loss(name: str, seed: int = 0) -> objectives.LossModule:
    torch.manual_seed(seed)
    loss = LOSSES[name]()
    loss.make_value_estimator(gamma=GAMMA)
    return loss


def make_batch(loss: objectives.LossModule | None = None) -> TensorDict:
    """Make two episodes of four transitions, some of them terminal, as ``loss`` needs them."""
    s = random_states(10, seed=3).float().view(2, 5, 2)
    preview = torch.cat((s.flip(-1), s.square()), -1)
    ended = random_states(8, 1, size=1.0, seed=4).view(2, 4, 1)
    after = TensorDict(
        observation=s[:, 1:].clone(),
        preview=preview[:, 1:].clone(),
        reward=-s[:, 1:].square().sum(-1, keepdim=True),
        done=ended > 0.5,
        terminated=ended > 0.8,
        batch_size=(2, 4),
    )
    td = TensorDict(
        observation=s[:, :-1].clone(),
        preview=preview[:, :-1].clone(),
        action=random_states(8, 1, size=BOUND, seed=5).float().view(2, 4, 1),
        next=after,
        batch_size=(2, 4),
    )
    td.names = [None, "time"]  # pyright: ignore[reportAttributeAccessIssue]
    if isinstance(loss, objectives.DQNLoss):
        nearest = (td["action"] - GRID.flatten()).abs().argmin(-1)
        td["action"] = nn.functional.one_hot(nearest, len(GRID))
    if isinstance(loss, objectives.ClipPPOLoss):
        params: Any = loss.actor_network_params
        with torch.no_grad(), params.to_module(loss.actor_network):
            loss.actor_network(td)
    return td


def total(loss: objectives.LossModule, batch: TensorDict, seed: int = 0) -> Tensor:
    torch.manual_seed(seed)
    out = loss(batch.copy())
    return torch.stack([x for key, x in out.items() if key.startswith("loss")]).sum()


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
    loss = objectives.CQLLoss(network_gaussian(), narrow)
    with pytest.raises(SolverError, match=r"INFEASIBLE.* soften rows with a finite w"):
        total(loss, make_batch())
