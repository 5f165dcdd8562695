"""Transitions for the Q-learning loss, a small QP to learn, and reference targets."""

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from tests.problems import normal, random_states
from torch_qpmpc import QPMPC, QPActorValueOperator, QPQLearningLoss

#: Exactly representable in float32, TorchRL's dtype.
GAMMA, LMBDA = 0.875, 0.75
LEARN = ("H", "H_f", "q", "c", "w", "C", "b", "G", "lb", "ub")
#: The lambda for which each estimator equals TD(lambda).
TRACE = {"td0": 0.0, "td1": 1.0, "tdlambda": LMBDA}
METADATA = ["td_error", "pred_value", "target_value", "pred_value_max", "target_value_max"]


def make_operator(keys: dict[str, Any] | None = None, **options: Any) -> QPActorValueOperator:
    """Make a small QP of a double integrator with friction, with all of theta learned."""
    settings = {
        "gamma": GAMMA,
        "state_bounds": ([-1.0, -1.0], [1.0, 1.0]),
        "action_bounds": ([-1.0], [1.0]),
        "stage_weight": [1.0, 0.5, 0.1],
        "state_slack": 10.0,
        "learn": LEARN,
        "solver": "daqp",
        "on_failure": "mask",
    } | options
    mpc = QPMPC.from_model([[1.0, 0.1], [0.0, 0.9]], [[0.0], [0.1]], 3, **settings)
    return QPActorValueOperator(mpc, **(keys or {}))


def make_loss(estimator: Any = "td0", operator=None, **options: Any) -> QPQLearningLoss:
    loss = QPQLearningLoss(operator or make_operator(), **options)
    more = {"lmbda": LMBDA} if estimator == "tdlambda" else {}
    loss.make_value_estimator(estimator, gamma=GAMMA, **more)
    return loss


def make_batch(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> TensorDict:
    """Make transitions of episodes along the last dimension; some end inside, by either flag."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(bound: float, *size: int) -> Tensor:
        return bound * (2 * torch.rand(size, generator=generator, dtype=torch.float64) - 1)

    *batch, steps = shape
    s = uniform(1.5, *batch, steps + 1, 2).to(dtype)
    ended = torch.rand(*shape, 1, generator=generator)
    following = {
        "observation": s[..., 1:, :].clone(),
        "reward": uniform(3.0, *shape, 1).to(dtype),
        "done": ended < 0.4,
        "terminated": ended < 0.2,
        "truncated": (ended >= 0.2) & (ended < 0.4),
    }
    return TensorDict(
        {
            "observation": s[..., :-1, :].clone(),
            "action": uniform(0.9, *shape, 1).to(dtype),
            "next": TensorDict(following, batch_size=shape),
        },
        batch_size=shape,
    )


def hand_target(mpc: QPMPC, td: TensorDictBase, trace: float) -> Tensor:
    """Compute -L - gamma (1 - terminated) V(s+), and TD(lambda) beyond it, in a loop over time."""
    with torch.no_grad():
        V = mpc.value(td["next", "observation"])
    reward, done, terminated = (td["next", k].squeeze(-1) for k in ("reward", "done", "terminated"))
    target, steps = torch.zeros_like(reward), reward.shape[-1]
    for t in reversed(range(steps)):
        future = -V[..., t]
        if t + 1 < steps:
            mixed = (1 - trace) * future + trace * target[..., t + 1]
            future = torch.where(done[..., t], future, mixed)
        target[..., t] = reward[..., t] + GAMMA * torch.where(terminated[..., t], 0.0, future)
    return target


def hand_prediction(mpc: QPMPC, td: TensorDictBase) -> Tensor:
    return -mpc.action_value(td["observation"], td["action"])


def perturb(module: torch.nn.Module, size: float = 0.05, seed: int = 1) -> None:
    """Move every parameter at random, in place."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in module.parameters():
            normal = torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
            parameter += size * normal.to(parameter)


def learned_leaves(loss: QPQLearningLoss) -> dict[Any, Tensor]:
    leaves = loss.value_network_params.items(True, True)
    return {key: leaf for key, leaf in leaves if isinstance(leaf, torch.nn.Parameter)}


def transitions(count: int = 12, seed: int = 0) -> TensorDict:
    following = TensorDict(
        observation=random_states(count, seed=seed + 1),
        reward=normal(count, 1, seed=seed + 2),
        done=torch.zeros(count, 1, dtype=torch.bool),
        terminated=torch.zeros(count, 1, dtype=torch.bool),
        batch_size=count,
    )
    return TensorDict(
        observation=random_states(count, seed=seed + 3),
        action=random_states(count, 1, size=0.5, seed=seed + 4),
        next=following,
        batch_size=count,
    )
