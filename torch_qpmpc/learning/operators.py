"""TensorDict modules that make a QPMPC the critic, value or actor of a TorchRL script.

p is the entry ``observation`` or, with a ``preview_key``, the preview followed by the observation.

Only here do costs become rewards: TorchRL maximises, so state_value = -V(s) and
state_action_value = -Q(s, a), both with TorchRL's trailing dimension of one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import Tensor

from torch_qpmpc.checks import check_kind
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.parameters import check_names
from torch_qpmpc.qp.program import QuadraticProgram

#: The key of the known signals, as environments emit them.
PREVIEW = "preview"
#: The key of the active sets that a policy in closed loop passes from step to step.
POLICY_ACTIVE_SET = "policy_active_set"


class _QPOperator(TensorDictModuleBase):
    """A view of a QPMPC.

    Every view holds the QPMPC as ``module``, so that the parameters of a target network fit any.
    """

    module: QPMPC

    def __init__(
        self,
        mpc: QPMPC,
        in_keys: Sequence[NestedKey],
        out_key: NestedKey,
        active_set_key: NestedKey | None = None,
        preview_key: NestedKey | None = None,
        theta_keys: Mapping[str, NestedKey] | None = None,
    ) -> None:
        super().__init__()
        check_kind("mpc", mpc, QPMPC)
        self.module = mpc
        self.active_set_key, self.preview_key = active_set_key, preview_key
        theta_keys = {} if theta_keys is None else theta_keys
        check_kind("theta_keys", theta_keys, Mapping, "Map names to keys: {'q': ('theta', 'q')}.")
        check_names("theta_keys", theta_keys, mpc)
        self.theta_keys = dict(theta_keys)
        preview, active = ([] if key is None else [key] for key in (preview_key, active_set_key))
        in_keys, out_keys = [*in_keys, *preview, *theta_keys.values()], [out_key, *active]
        self.in_keys = in_keys  # pyright: ignore[reportAttributeAccessIssue]
        self.out_keys = out_keys  # pyright: ignore[reportAttributeAccessIssue]

    def known(self, tensordict: TensorDictBase) -> Tensor:
        """Return p ``(*batch, n_p)``: the preview, if there is a key of it, and the observation."""
        observation = entry(tensordict, self.in_keys[0])
        if self.preview_key is None:
            return observation
        return torch.cat((entry(tensordict, self.preview_key).to(observation), observation), -1)

    def _program(self, tensordict: TensorDictBase) -> QuadraticProgram | None:
        """Return the QPs with the residuals in ``tensordict``; None without ``theta_keys``."""
        if not self.theta_keys:
            return None
        residuals = {name: entry(tensordict, key) for name, key in self.theta_keys.items()}
        return self.module.quadratic_program(residuals)

    def _set_value(self, tensordict: TensorDictBase, *action_key: NestedKey) -> TensorDictBase:
        """Write -V, or -Q with the key of an action, to the first out-key."""
        inputs = [self.known(tensordict), *(entry(tensordict, key) for key in action_key)]
        qp = self._program(tensordict)
        if self.active_set_key is None:
            cost = self.module(*inputs, qp=qp)
        else:
            start = tensordict.get(self.active_set_key, None)
            solution = self.module.solve(*inputs, warm_start=start, qp=qp)
            tensordict.set(self.active_set_key, solution.active)
            cost = solution.value.to(inputs[0].dtype)
        return tensordict.set(self.out_keys[0], -cost.unsqueeze(-1))


def entry(tensordict: TensorDictBase, key: NestedKey) -> Tensor:
    """Return the entry ``key``; raise `QPError` if it is missing: without it, Q would be V."""
    value = tensordict.get(key, None)
    if value is None:
        present = ", ".join(map(str, tensordict.keys(True, True))) or "no entry"
        remedy = "Rename the module's keys, such as action_key, or the TensorDict's."
        raise QPError.expected(str(key), f"a TensorDict with {present}", f"one with {key}", remedy)
    return value


class QPPolicyOperator(_QPOperator):
    """The policy pi(p): observation, and preview if any, to action ``(*batch, n_u)``.

    With an ``active_set_key`` each call starts from the active sets under that key, or from empty
    ones if there are none, and writes its own there. Rollouts and collectors carry them to the next
    step.
    """

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write pi(p) to the action key."""
        p, qp = self.known(tensordict), self._program(tensordict)
        if self.active_set_key is None:
            return tensordict.set(self.out_keys[0], self.module.policy(p, qp=qp))
        start = tensordict.get(self.active_set_key, None)
        if start is None:
            rows = len(self.module.G)
            start = torch.zeros((*p.shape[:-1], rows), dtype=torch.int8, device=p.device)
        action, active = self.module.policy_and_active_set(p, start, qp)
        tensordict.set(self.active_set_key, active)
        return tensordict.set(self.out_keys[0], action)


class QPValueOperator(_QPOperator):
    """The state value -V(p): observation, and preview if any, to state_value ``(*batch, 1)``."""

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write -V(p) to the value key."""
        return self._set_value(tensordict)


class QPActorValueOperator(_QPOperator):
    """The critic -Q(p, a): (observation, action) to state_action_value ``(*batch, 1)``.

    The observation is p ``(*batch, n_p)``, such as a state s ``(*batch, n_x)``, and the action
    ``(*batch, n_u)``. The views of the value and of the policy share its parameters.

    Args:
        mpc: the QPMPC.
        observation_key, action_key: the keys of its inputs.
        preview_key: the key of the known signals [d_k, .., d_{k+N}], ``(*batch, (N + 1) n_d)``; a
            third input, after the action. The observation is then the rest of p. None, the
            default, if there are none, or if the observation contains them.
        theta_keys: the keys of residuals by their names in `QPMPC.coordinates`, such as
            ``{"q": ("theta", "q")}``: further inputs ``(*batch, ..)``, which an upstream module,
            such as `ThetaNetwork`, writes. None, the default, shares theta.
        state_value_key, state_action_value_key: the output keys of the value and the critic.
        active_set_key: the key where the value and the critic write the QP's active set, int8
            ``(*batch, n_g)``, after starting from the one they find there, such as one stored in a
            replay buffer. None, the default, starts cold.

    Raises:
        QPError: if ``mpc`` is not a QPMPC, a name in ``theta_keys`` is not a coordinate's, or a
            call lacks an input.

    Example:
        >>> import torch, torch_qpmpc as qm
        >>> from tensordict import TensorDict
        >>> mpc = qm.QPMPC.from_model([[1.0]], [[1.0]], 5, stage_weight=[1.0, 0.1])
        >>> operator = qm.QPActorValueOperator(mpc)
        >>> td = TensorDict(observation=torch.zeros(3, 1), action=torch.zeros(3, 1), batch_size=3)
        >>> operator(td)["state_action_value"].shape
        torch.Size([3, 1])
    """

    def __init__(
        self,
        mpc: QPMPC,
        *,
        observation_key: NestedKey = "observation",
        action_key: NestedKey = "action",
        preview_key: NestedKey | None = None,
        theta_keys: Mapping[str, NestedKey] | None = None,
        state_value_key: NestedKey = "state_value",
        state_action_value_key: NestedKey = "state_action_value",
        active_set_key: NestedKey | None = None,
    ) -> None:
        in_keys = [observation_key, action_key]
        keys = state_action_value_key, active_set_key, preview_key, theta_keys
        super().__init__(mpc, in_keys, *keys)
        self.state_value_key = state_value_key

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write -Q(p, a) to the action value's key of ``tensordict``, and return it."""
        return self._set_value(tensordict, self.in_keys[1])

    def get_policy_operator(self, active_set_key: NestedKey | None = None) -> QPPolicyOperator:
        """Return the actor: observation, and preview if any, to action.

        ``active_set_key`` is the key of the active set that each step of an episode passes to the
        next; it must not be the critic's. None starts each step cold.
        """
        keys = self.in_keys[1], active_set_key, self.preview_key, self.theta_keys
        return QPPolicyOperator(self.module, self.in_keys[:1], *keys)

    def get_value_operator(self) -> QPValueOperator:
        """Return the state value: observation, and preview if any, to state_value."""
        keys = self.state_value_key, self.active_set_key, self.preview_key, self.theta_keys
        return QPValueOperator(self.module, self.in_keys[:1], *keys)

    def get_critic_operator(self) -> QPActorValueOperator:
        """Return the critic, this operator."""
        return self


def preview_key(mpc: QPMPC) -> str | None:
    """Return `PREVIEW` if the QP has known signals, else None."""
    return PREVIEW if mpc.n_d else None


def warm_policy(mpc: QPMPC) -> Callable[[Tensor], Tensor]:
    """Return `QPMPC.policy` for one closed loop: each call starts from the last active sets."""
    actor = QPActorValueOperator(mpc).get_policy_operator(POLICY_ACTIVE_SET)
    carried = TensorDict()  # the observation, the action and the active sets
    return lambda p: actor(carried.set("observation", p))["action"]
