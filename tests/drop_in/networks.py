"""The QPs that stand in for the networks of TorchRL's own tests."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict.nn import AddStateIndependentNormalScale, TensorDictSequential
from torch import nn

from torch_qpmpc import QPMPC, QPActorValueOperator, ThetaNetwork
from torch_qpmpc.mpc.validation import CONSTRAINTS, COST


class Theta(QPMPC):
    """A QPMPC whose constants are not buffers.

    TorchRL's tests require that every leaf of a network, including buffers, has a gradient and
    changes. A QPMPC's buffers are constants (C_0, the discounts, which rows are soft) or parts of
    theta that are not learned. Here the constants are plain attributes, and all parts are learned.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        for name, constant in list(self.named_buffers(recurse=False)):
            delattr(self, name)
            setattr(self, name, constant)


#: True for QPs whose observation contains a preview [d_0, d_1], where it has the entries for one.
PREVIEW = False
#: True for QPs whose q and b a network schedules.
SCHEDULED = False


def make_theta(n_p: int, n_u: int, unused: str | None = None) -> Theta:
    """Make a small QP that learns all parts, each with a gradient in any batch.

    Its observation is p ``(*batch, n_p)``. Its linear cost pushes some actions to a bound and some
    beyond it. All entries of a part lie between its smallest and its largest in any order: TorchRL
    fills the copies of an ensemble's module with such numbers. (In a script, pass a list of
    modules.)
    """
    n_d = int(PREVIEW and n_p > 2)
    n_x, horizon = n_p - 2 * n_d, 2 - n_d
    # Each call draws from the generator that the tests seed.
    theta = Theta.of(
        n_x,
        n_u,
        horizon,
        n_d=n_d,
        state_bounds=([-0.5] * n_x, [0.5] * n_x),
        action_bounds=([-0.5] * n_u, [0.5] * n_u),
        stage_weight=0.5 + torch.rand(n_x + n_u),
        state_slack=2.0,
        action_slack=2.0,
        learn=[part for part in (*COST, *CONSTRAINTS) if part != unused],
        solver="daqp",
        seed=int(torch.randint(2**31, ())),
    )
    stage = torch.cat((torch.linspace(-1, 1, n_x), torch.linspace(-4, 4, n_u)))
    plan = torch.cat((*[stage] * horizon, torch.linspace(-1, 1, n_x)))
    theta.q.data[-len(plan) :] += plan
    return theta


def make_operator(
    mpc: Theta,
    view: Callable[[QPActorValueOperator], Any],
    observation_key: Any = "observation",
    **keys: Any,
) -> Any:
    """Make a view of a QP, after the network of its theta if it is scheduled."""
    keys["observation_key"] = observation_key
    if not SCHEDULED:
        return view(QPActorValueOperator(mpc, **keys))
    theta = ThetaNetwork(mpc, {"q": 0.1, "b": 0.1}, width=4, in_keys=[observation_key])
    # TorchRL's tests need a gradient in every layer, which a last layer of zeros does not give.
    last: Any = theta.net[-1]
    nn.init.normal_(last.weight)
    operator = view(QPActorValueOperator(mpc, theta_keys=theta.theta_keys, **keys))
    upstream: Any = theta
    return TensorDictSequential(upstream, operator, selected_out_keys=operator.out_keys)


def make_policy(n_p: int, n_u: int, observation: Any = "observation") -> Any:
    """Make a deterministic actor, without learning c, which no action depends on."""
    mpc = make_theta(n_p, n_u, unused="c")
    return make_operator(mpc, lambda operator: operator.get_policy_operator(), observation)


def make_gaussian(n_p: int, n_u: int) -> nn.Module:
    """Make a stochastic actor: the QP's action as location, and a learned scale."""
    return nn.Sequential(make_policy(n_p, n_u), AddStateIndependentNormalScale(n_u))


def make_critic(n_p: int, n_u: int, **keys: Any) -> Any:
    """Make a critic, -Q, with keys that a test may rename."""
    return make_operator(make_theta(n_p, n_u), lambda operator: operator, **keys)


def make_value(n_p: int, n_u: int, **keys: Any) -> Any:
    """Make a value, -V, initially below -Q: above it, IQL with expectile one learns nothing."""
    mpc = make_theta(n_p, n_u)
    mpc.c.data += 1000
    return make_operator(mpc, lambda operator: operator.get_value_operator(), **keys)
