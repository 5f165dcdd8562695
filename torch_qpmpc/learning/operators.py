"""TensorDict modules over a QPMPC: the QP as critic, value and actor of a TorchRL script.

Here, and only here, costs become rewards: TorchRL maximises, so state_value = -V(s) and
state_action_value = -Q(s, a), both with the trailing dimension of one that TorchRL wants.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import Tensor

from torch_qpmpc.checks import check_kind
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.module import QPMPC

#: Where a policy in closed loop leaves its active sets from step to step.
POLICY_ACTIVE_SET = "policy_active_set"


class _QPOperator(TensorDictModuleBase):
    """A view of a QPMPC. Every view holds it as ``module``, so that the parameters of one, such as
    a target network's, can drive any other."""

    module: QPMPC

    def __init__(
        self,
        mpc: QPMPC,
        in_keys: Sequence[NestedKey],
        out_key: NestedKey,
        active_set_key: NestedKey | None = None,
    ) -> None:
        super().__init__()
        check_kind("mpc", mpc, QPMPC)
        self.module = mpc
        self.active_set_key = active_set_key
        out_keys = [out_key] if active_set_key is None else [out_key, active_set_key]
        self.in_keys = list(in_keys)  # pyright: ignore[reportAttributeAccessIssue]
        self.out_keys = out_keys  # pyright: ignore[reportAttributeAccessIssue]

    def _set_value(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Minus V, or minus Q where there is an action to read, under the first out-key."""
        inputs = [_read(tensordict, key) for key in self.in_keys]
        if self.active_set_key is None:
            cost = self.module(*inputs)
        else:
            start = tensordict.get(self.active_set_key, None)
            cost, active = self.module.value_and_active_set(*inputs, warm_start=start)
            tensordict.set(self.active_set_key, active)
        return tensordict.set(self.out_keys[0], -cost.unsqueeze(-1))


def _read(tensordict: TensorDictBase, key: NestedKey) -> Tensor:
    """An entry; without this check, the Q of a missing action would be V."""
    value = tensordict.get(key, None)
    if value is None:
        found = ", ".join(map(str, tensordict.keys(True, True))) or "nothing"
        remedy = "Rename the operator's keys, such as action_key, or the TensorDict's."
        raise QPError.expected(str(key), "no such entry", f"one beside {found}", remedy)
    return value


class QPPolicyOperator(_QPOperator):
    """pi(s): observation ``(*batch, n_x)`` to action ``(*batch, n_u)``.

    With an ``active_set_key`` each call starts from the active sets under that key, or from the
    empty ones where there are none, and leaves its own there. Rollouts and collectors carry them to
    the next step.
    """

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        s = _read(tensordict, self.in_keys[0])
        if self.active_set_key is None:
            return tensordict.set(self.out_keys[0], self.module.policy(s))
        start = tensordict.get(self.active_set_key, None)
        if start is None:
            rows = len(self.module.G)
            start = torch.zeros((*s.shape[:-1], rows), dtype=torch.int8, device=s.device)
        action, active = self.module.policy_and_active_set(s, start)
        tensordict.set(self.active_set_key, active)
        return tensordict.set(self.out_keys[0], action)


class QPValueOperator(_QPOperator):
    """-V(s): observation ``(*batch, n_x)`` to state_value ``(*batch, 1)``."""

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self._set_value(tensordict)


class QPActorValueOperator(_QPOperator):
    """-Q(s, a), and the views that share its parameters.

    Args:
        mpc: the QPMPC.
        observation_key, action_key: what it reads.
        state_value_key, state_action_value_key: what the value and the critic write.
        active_set_key: where the value and the critic write the QP's active set, int8
            ``(*batch, n_g)``, and read one to start from if there is any, as from a replay buffer
            that kept it. None, the default, starts cold.

    Example:
        >>> import torch, torch_qpmpc as qm
        >>> from tensordict import TensorDict
        >>> operator = qm.QPActorValueOperator(qm.QPMPC(2, 1, 5))
        >>> td = TensorDict(observation=torch.zeros(3, 2), action=torch.zeros(3, 1), batch_size=3)
        >>> operator(td)["state_action_value"].shape
        torch.Size([3, 1])
    """

    def __init__(
        self,
        mpc: QPMPC,
        *,
        observation_key: NestedKey = "observation",
        action_key: NestedKey = "action",
        state_value_key: NestedKey = "state_value",
        state_action_value_key: NestedKey = "state_action_value",
        active_set_key: NestedKey | None = None,
    ) -> None:
        in_keys = [observation_key, action_key]
        super().__init__(mpc, in_keys, state_action_value_key, active_set_key)
        self.state_value_key = state_value_key

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self._set_value(tensordict)

    def get_policy_operator(self, active_set_key: NestedKey | None = None) -> QPPolicyOperator:
        """The actor: observation to action.

        ``active_set_key``, where each step of an episode leaves its active set for the next one, is
        another one than that of Q. None starts each step cold.
        """
        return QPPolicyOperator(self.module, self.in_keys[:1], self.in_keys[1], active_set_key)

    def get_value_operator(self) -> QPValueOperator:
        """The state value: observation to state_value."""
        keys = self.state_value_key, self.active_set_key
        return QPValueOperator(self.module, self.in_keys[:1], *keys)

    def get_critic_operator(self) -> QPActorValueOperator:
        """The critic: (observation, action) to state_action_value, this operator itself."""
        return self


def warm_policy(mpc: QPMPC) -> Callable[[Tensor], Tensor]:
    """`QPMPC.policy` for one closed loop: each call starts from the last call's active sets.

    Example:
        >>> import torch_qpmpc as qm
        >>> from torch_qpmpc.envs import PointMass
        >>> from torch_qpmpc.envs.closed_loop import closed_loop
        >>> physics = PointMass()
        >>> mpc = qm.QPMPC.from_model(physics.A, physics.B, 5, action_bounds=([-1, -1], [1, 1]))
        >>> loop = closed_loop(warm_policy(mpc), physics, steps=10)
    """
    return in_closed_loop(QPActorValueOperator(mpc).get_policy_operator(POLICY_ACTIVE_SET))


def in_closed_loop(actor: TensorDictModuleBase) -> Callable[[Tensor], Tensor]:
    """An actor as a function s to a, for one closed loop.

    What the actor writes beside the action, such as active sets, is there at its next call.
    """
    carried = TensorDict()

    def policy(s: Tensor) -> Tensor:
        return actor(carried.set("observation", s))["action"]

    return policy
