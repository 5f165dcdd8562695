"""Small TorchRL losses with the QP in one or more roles."""

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import (
    AddStateIndependentNormalScale,
    NormalParamExtractor,
    TensorDictModule,
    TensorDictSequential,
)
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.modules import ProbabilisticActor, QValueActor, TanhNormal, ValueOperator
from torchrl.objectives import (
    A2CLoss,
    ClipPPOLoss,
    CQLLoss,
    DDPGLoss,
    DQNLoss,
    IQLLoss,
    LossModule,
    REDQLoss,
    ReinforceLoss,
    SACLoss,
    TD3BCLoss,
    TD3Loss,
)

from tests.problems import random_mpc, random_states
from torch_qpmpc import QPMPC, QPActorValueOperator, QPQLearningLoss

GAMMA = 0.9
#: The action's bounds, and a grid over them for DQN.
BOUND = 1.0
BOUNDS: Any = (-BOUND, BOUND)
GRID = torch.linspace(-BOUND, BOUND, 5).unsqueeze(-1)


#: Keys of a QP that knows one signal ahead of time.
PREVIEW: dict[str, Any] = {"preview_key": "preview"}


def make_mpc(seed: int, n_d: int = 0) -> QPMPC:
    """Make a QP initialised by ``seed``; its bounds are buffers."""
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
LOSSES: dict[str, Callable[[], LossModule]] = {
    "critic of DDPG": lambda: DDPGLoss(network_policy(), critic(), delay_actor=True),
    "critics of TD3": lambda: TD3Loss(network_policy(), critics(), bounds=BOUNDS),
    "critics of TD3+BC": lambda: TD3BCLoss(network_policy(), critics(), bounds=BOUNDS),
    "critics of SAC": lambda: SACLoss(network_gaussian(), critics()),
    "critics of REDQ": lambda: REDQLoss(network_gaussian(), critics(3), num_qvalue_nets=3),
    "critics of CQL": lambda: CQLLoss(network_gaussian(), critics()),
    "critics and value of IQL": lambda: IQLLoss(network_gaussian(), critics(), value()),
    "critic of DQN": lambda: DQNLoss(grid_critic(), action_space="one_hot"),
    "V and Q of Q-learning": lambda: QPQLearningLoss(critic(), delay_value=True),
    "actor of DDPG": lambda: DDPGLoss(policy(), network_critic(), delay_actor=True),
    "actor of TD3": lambda: TD3Loss(policy(), network_critic(), bounds=BOUNDS),
    "actor of TD3+BC": lambda: TD3BCLoss(policy(), network_critic(), bounds=BOUNDS),
    "actor and critic of DDPG": lambda: DDPGLoss(policy(), critic(), delay_actor=True),
    "actor and critics of TD3": lambda: TD3Loss(policy(), critics(), bounds=BOUNDS),
    "mean and critics of SAC": lambda: SACLoss(qp_gaussian(), critics()),
    "value and critics of SAC v1": lambda: SACLoss(network_gaussian(), critics(), value()),
    "value of A2C": lambda: A2CLoss(network_gaussian(), value()),
    "value of PPO": lambda: ClipPPOLoss(network_gaussian(), value()),
    "value of REINFORCE": lambda: ReinforceLoss(network_gaussian(), value()),
    "mean and value of PPO": lambda: ClipPPOLoss(qp_gaussian(), value()),
    "V and Q of Q-learning, with a preview": lambda: QPQLearningLoss(
        critic(**PREVIEW), delay_value=True
    ),
    "actor and critics of TD3, with a preview": lambda: TD3Loss(
        policy(**PREVIEW), critics(**PREVIEW), bounds=BOUNDS
    ),
    # TorchRL's losses pass the critics no entry that the actor does not read.
    "mean, critics and value of IQL, with a preview": lambda: IQLLoss(
        qp_gaussian(**PREVIEW), critics(**PREVIEW), value(**PREVIEW)
    ),
    "value of PPO, with a preview": lambda: ClipPPOLoss(network_gaussian(), value(**PREVIEW)),
}


def make_loss(name: str, estimator: str | None = None, seed: int = 0) -> LossModule:
    """Make one of `LOSSES` with its value estimator."""
    torch.manual_seed(seed)
    loss = LOSSES[name]()
    loss.make_value_estimator(estimator, gamma=GAMMA)  # pyright: ignore[reportArgumentType] - names are accepted
    return loss


def make_batch(loss: LossModule | None = None, *shape: int) -> TensorDict:
    """Make transitions along the last dimension, some of them terminal, as ``loss`` needs them."""
    *batch, steps = shape or (2, 4)
    s = random_states(20 * (steps + 1), seed=3)[: torch.Size((*batch, steps + 1)).numel()]
    s = s.float().view(*batch, steps + 1, 2)
    preview = torch.cat((s.flip(-1), s.square()), -1)
    ended = random_states(1000, 1, size=1.0, seed=4)[: torch.Size((*batch, steps)).numel()]
    ended = ended.view(*batch, steps, 1)
    action = random_states(1000, 1, size=BOUND, seed=5)[: ended.numel()]
    after = TensorDict(
        observation=s[..., 1:, :].clone(),
        preview=preview[..., 1:, :].clone(),
        reward=-s[..., 1:, :].square().sum(-1, keepdim=True),
        done=ended > 0.5,
        terminated=ended > 0.8,
        batch_size=(*batch, steps),
    )
    td = TensorDict(
        observation=s[..., :-1, :].clone(),
        preview=preview[..., :-1, :].clone(),
        action=action.float().view(*batch, steps, 1),
        next=after,
        batch_size=(*batch, steps),
    )
    td.names = [None] * len(batch) + ["time"]  # pyright: ignore[reportAttributeAccessIssue]
    if isinstance(loss, DQNLoss):
        nearest = (td["action"] - GRID.flatten()).abs().argmin(-1)
        td["action"] = nn.functional.one_hot(nearest, len(GRID))
    if isinstance(loss, A2CLoss | ClipPPOLoss | ReinforceLoss):
        params: Any = loss.actor_network_params
        with torch.no_grad(), params.to_module(loss.actor_network):
            loss.actor_network(td)
    return td


def total(loss: LossModule, batch: TensorDict, seed: int = 0) -> Tensor:
    """Sum the losses of a module, with seeded noise."""
    torch.manual_seed(seed)
    out = loss(batch.copy())
    return torch.stack([x for key, x in out.items() if key.startswith("loss")]).sum()
