"""TorchRL's own tests of its losses, with QPs in place of their networks.

    TORCHRL_CHECKOUT=folder pytest tests/drop_in

The folder is a checkout of TorchRL's repository near the installed version. Its test classes are
imported, and the functions that make their networks are replaced.
"""

from __future__ import annotations

import importlib
import os
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import Bounded

from tests.drop_in.networks import make_critic, make_gaussian, make_policy, make_value
from torch_qpmpc import QPMPC

CHECKOUT = os.environ.get("TORCHRL_CHECKOUT")
if not CHECKOUT:
    pytest.skip("TORCHRL_CHECKOUT names no checkout of TorchRL", allow_module_level=True)
OBJECTIVES = Path(CHECKOUT) / "test" / "objectives"
if not OBJECTIVES.is_dir():
    raise FileNotFoundError(f"TORCHRL_CHECKOUT: {OBJECTIVES} is not there")
sys.path.insert(0, str(OBJECTIVES))
#: Base of the mixins, whose signatures are not checked against TorchRL's test classes.
Base: Any = object
ddpg, sac, iql = (importlib.import_module(f"test_{name}") for name in ("ddpg", "sac", "iql"))


class Deterministic(Base):
    """Networks for DDPG and TD3: the QP as actor and as critic, with separate thetas."""

    def _create_mock_actor(
        self, obs_dim: int = 3, action_dim: int = 4, device="cpu", in_keys=None, **other: Any
    ) -> Any:
        key = (in_keys or ["observation"])[0]
        dropout: Any = TensorDictModule(nn.Dropout(other.get("dropout", 0.0)), [key], ["kept"])
        actor: Any = TensorDictSequential(dropout, make_policy(obs_dim, action_dim, "kept"))
        bound = torch.ones(action_dim)
        actor.spec = Bounded(-bound, bound)
        return actor.to(device)

    def _create_mock_value(
        self,
        obs_dim: int = 3,
        action_dim: int = 4,
        device="cpu",
        out_keys=None,
        action_key="action",
        observation_key="observation",
    ) -> Any:
        out_key = (out_keys or ["state_action_value"])[0]
        return make_critic(
            obs_dim,
            action_dim,
            observation_key=observation_key,
            action_key=action_key,
            state_action_value_key=out_key,
        ).to(device)

    def _create_mock_common_layer_setup(self, n_act: int = 4, n_hidden: int = 2, **other: Any):
        *_, common, td = super()._create_mock_common_layer_setup(
            n_act=n_act, n_hidden=n_hidden, **other
        )
        actor = TensorDictSequential(common, make_policy(n_hidden, n_act, "hidden"))
        critic = make_critic(n_hidden, n_act, observation_key="hidden")
        return actor, TensorDictSequential(common, critic), common, td


class TestDDPG(Deterministic, ddpg.TestDDPG):
    def _create_mock_value(self, obs_dim: int = 3, state_dim: int = 8, **other: Any) -> Any:
        """Make a critic that takes a state in addition to the observation."""
        both: Any = TensorDictModule(
            lambda *parts: torch.cat(parts, -1), ["observation", "state"], ["both"]
        )
        critic = super()._create_mock_value(obs_dim + state_dim, observation_key="both", **other)
        return TensorDictSequential(both, critic)


class TestTD3(Deterministic, ddpg.TestTD3):
    pass


class Stochastic(Base):
    """Networks for SAC and IQL: the QP as critic, state value and mean of the policy."""

    composite = False

    def _create_mock_actor(self, obs_dim: int = 3, action_dim: int = 4, **other: Any) -> Any:
        self.composite = other.get("composite_action_dist", False)
        made = super()._create_mock_actor(obs_dim=obs_dim, action_dim=action_dim, **other)
        actor = made[0] if isinstance(made, tuple) else made
        actor[0].module = make_gaussian(obs_dim, action_dim)
        return made

    def _create_mock_qvalue(
        self,
        obs_dim: int = 3,
        action_dim: int = 4,
        device="cpu",
        out_keys=None,
        observation_key="observation",
        action_key="action",
    ) -> Any:
        return make_critic(
            obs_dim,
            action_dim,
            observation_key=observation_key,
            action_key=(action_key, "action1") if self.composite else action_key,
            state_action_value_key=(out_keys or ["state_action_value"])[0],
        ).to(device)

    def _create_mock_value(
        self,
        obs_dim: int = 3,
        action_dim: int = 4,
        device="cpu",
        out_keys=None,
        observation_key="observation",
    ) -> Any:
        return make_value(
            obs_dim,
            action_dim,
            observation_key=observation_key,
            state_value_key=(out_keys or ["state_value"])[0],
        ).to(device)

    def _create_mock_common_layer_setup(self, n_act: int = 4, n_hidden: int = 2, **other: Any):
        self.composite = other.get("composite_action_dist", False)
        actor, *values, common, td = super()._create_mock_common_layer_setup(
            n_act=n_act, n_hidden=n_hidden, **other
        )
        *_, parameters, distribution = actor
        net = make_gaussian(n_hidden, n_act)
        head: Any = TensorDictModule(net, ["hidden"], parameters.out_keys)
        actor = ProbabilisticTensorDictSequential(common, head, distribution)
        action_key = ("action", "action1") if self.composite else "action"
        critic = make_critic(n_hidden, n_act, observation_key="hidden", action_key=action_key)
        # Of a batch of two, the clipped TD errors of a smooth L1 loss can cancel in c's gradient.
        for part in critic.modules():
            if isinstance(part, QPMPC):
                part.c.data -= 5000  # its target has 0.99 of that
        value = make_value(n_hidden, n_act, observation_key="hidden")
        heads = [value, critic] if len(values) == 2 else [critic]
        return actor, *(TensorDictSequential(common, head) for head in heads), common, td


class TestSAC(Stochastic, sac.TestSAC):
    def _create_mock_data_sac(self, **other: Any) -> Any:
        self.composite = other.get("composite_action_dist", False)
        return super()._create_mock_data_sac(**other)

    def _create_seq_mock_data_sac(self, **other: Any) -> Any:
        self.composite = other.get("composite_action_dist", False)
        return super()._create_seq_mock_data_sac(**other)


class TestIQL(Stochastic, iql.TestIQL):
    pass
