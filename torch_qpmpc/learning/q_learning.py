"""Q-learning for a QP (eq:thup) as a TorchRL loss module."""

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModuleBase, TensorDictSequential, dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.objectives import LossModule, ValueEstimators
from torchrl.objectives.utils import _GAMMA_LMBDA_DEPREC_ERROR, dispatch_value_estimator

from torch_qpmpc.checks import POSITIVE, check_flag, check_number, class_name
from torch_qpmpc.errors import QPError
from torch_qpmpc.learning.operators import QPActorValueOperator, QPValueOperator
from torch_qpmpc.learning.td_error import (
    TD_SCALARS,
    invalid_rewards,
    inverse_variance,
    td_loss,
    td_metadata,
    usable,
)
from torch_qpmpc.qp.tracing import has_values


class QPQLearningLoss(LossModule):
    """The loss of semi-gradient Q-learning with a QP (eq:thup).

    The TD error is delta = L + gamma (1 - terminated) V(s+) - Q(s, a), with reward = -L in TorchRL.
    V and Q are the same QP without and with u_0 fixed, so V(s+) is exactly min over a of Q(s+, a).
    Truncation bootstraps, termination does not.

    Batches of n-step transitions (TorchRL's ``steps_to_next_obs``; set its ``done_keys`` to
    ``["done"]``, or ``terminated`` stays the first step's) and, with the TD(lambda) estimator, of
    slices ``(*batch, n)`` have returns of several steps.

    If `observe` sees all transitions, V(s+) is clipped to the values of paying the smallest and the
    largest cost so far, or zero, for ever (Munos and Szepesvari, "Finite-time bounds for fitted
    value iteration", JMLR 2008). Otherwise a transition to a state that no known transition leaves
    can raise its own target without bound.

    Samples whose QP has no certified solution (``on_failure="mask"`` in the QPMPC) add nothing to
    the loss and are counted in ``unsolved``; those with a NaN or infinite reward, in
    ``invalid_reward``, with a `RuntimeWarning`. The sign of the rewards is not checked: pass -L.
    Pass ``gamma`` to `make_value_estimator`, as for any TorchRL loss.

    Args:
        value_network: the critic to learn: a `QPActorValueOperator`, or a TensorDictSequential that
            ends with one, whose other modules write its inputs, such as residuals of theta.
        delay_value: evaluate V(s+) with a target network. By default, as in the paper, with the
            current theta.
        td_error_clip: bound on the absolute TD error in the update; none by default.
        weighted: multiply each sample's loss by `inverse_variance`.
        reduction: ``"mean"`` (default), ``"sum"`` or ``"none"``.
        use_prioritized_weights: weight the samples by ``priority_weight``; by default ``"auto"``,
            if the batch contains it.

    Raises:
        QPError: if an argument or, in a call, an entry of the batch does not fit.
        TypeError: if ``gamma`` is passed here.

    Example:
        >>> import torch, torch_qpmpc as qm
        >>> from tensordict import TensorDict
        >>> mpc = qm.QPMPC.from_model([[1.0]], [[1.0]], 5, stage_weight=[1.0, 0.1])
        >>> loss = qm.QPQLearningLoss(qm.QPActorValueOperator(mpc))
        >>> loss.make_value_estimator(gamma=0.9)
        >>> step = dict(
        ...     observation=torch.ones(3, 1),
        ...     reward=-torch.ones(3, 1),
        ...     done=torch.zeros(3, 1).bool(),
        ...     terminated=torch.zeros(3, 1).bool(),
        ... )
        >>> batch = TensorDict(
        ...     observation=torch.zeros(3, 1),
        ...     action=torch.zeros(3, 1),
        ...     next=TensorDict(step, 3),
        ...     batch_size=3,
        ... )
        >>> loss(batch)["loss_value"].backward()
    """

    @dataclass
    class _AcceptedKeys:
        """The keys that ``set_keys`` can rename; the defaults are TorchRL's."""

        advantage: NestedKey = "advantage"
        value_target: NestedKey = "value_target"
        value: NestedKey = "state_value"
        state_action_value: NestedKey = "state_action_value"
        action: NestedKey = "action"
        priority: NestedKey = "td_error"
        reward: NestedKey = "reward"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"
        priority_weight: NestedKey = "priority_weight"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    default_value_estimator = ValueEstimators.TD0
    SUPPORTED_VALUE_ESTIMATORS = tuple(ValueEstimators[x] for x in ("TD0", "TD1", "TDLambda"))
    out_keys = ["loss_value", *TD_SCALARS]  # noqa: RUF012  # pyright: ignore[reportAssignmentType] - TorchRL's convention

    value_network: QPActorValueOperator | TensorDictSequential
    state_value_network: QPValueOperator | TensorDictSequential
    value_network_params: TensorDictParams
    target_value_network_params: TensorDictParams
    reward_range: Tensor

    def __init__(
        self,
        value_network: QPActorValueOperator | TensorDictSequential,
        *,
        delay_value: bool = False,
        td_error_clip: float | None = None,
        weighted: bool = False,
        gamma: float | None = None,
        reduction: str | None = None,
        use_prioritized_weights: str | bool = "auto",
    ) -> None:
        self._in_keys = None
        super().__init__()
        if gamma is not None:
            raise TypeError(_GAMMA_LMBDA_DEPREC_ERROR)
        if not isinstance(last := _last(value_network), QPActorValueOperator):
            got = class_name(last)
            if last is not value_network:
                got = f"a TensorDictSequential that ends with {got}"
            remedy = "Wrap the QPMPC: QPActorValueOperator(mpc)."
            raise QPError.expected("value_network", got, "a QPActorValueOperator", remedy)
        if td_error_clip is not None:
            check_number("td_error_clip", td_error_clip, *POSITIVE)
        if reduction not in (None, "mean", "sum", "none"):
            raise QPError.expected("reduction", repr(reduction), "'mean', 'sum' or 'none'")
        check_flag("delay_value", delay_value)
        check_flag("weighted", weighted)
        if use_prioritized_weights not in ("auto", True, False):
            got = repr(use_prioritized_weights)
            raise QPError.expected("use_prioritized_weights", got, "'auto', True or False")
        self.delay_value, self.td_error_clip, self.weighted = delay_value, td_error_clip, weighted
        self.reduction = reduction or "mean"
        self.use_prioritized_weights = use_prioritized_weights
        self.convert_to_functional(
            value_network,  # pyright: ignore[reportArgumentType] - any TensorDict module is accepted
            "value_network",
            create_target_params=delay_value,
        )
        self.register_buffer("reward_range", torch.tensor([torch.inf, -torch.inf]).double())
        # Not registered as a submodule, because its parameters are the value network's.
        view: Any = self.operator.get_value_operator()
        if isinstance(network := self.value_network, TensorDictSequential):
            upstream: Any = network.module[:-1]
            view = TensorDictSequential(*upstream, view)
        object.__setattr__(self, "state_value_network", view)

    @property
    def operator(self) -> QPActorValueOperator:
        """The operator of the QP, the last module of the value network."""
        return _last(self.value_network)

    def get_extra_state(self) -> Tensor:
        """Return the part of the state_dict that identifies its QPMPC."""
        return self.operator.module.get_extra_state()

    def set_extra_state(self, state: Tensor) -> None:
        """Do nothing: `_load_from_state_dict` has compared it already."""

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *args: Any) -> None:
        state_dict = self.operator.module.checked_state(state_dict, prefix)
        super()._load_from_state_dict(state_dict, prefix, *args)

    def _forward_value_estimator_keys(self, **kwargs: Any) -> None:
        if self._value_estimator is not None:
            self._value_estimator.set_keys(**self._estimator_keys())
        self._in_keys = None

    def _estimator_keys(self) -> dict[str, NestedKey]:
        names = ("advantage", "value_target", "value", "reward", "done", "terminated")
        return {name: getattr(self.tensor_keys, name) for name in names}

    @property
    def in_keys(self) -> list[NestedKey]:
        if self._in_keys is not None:
            return self._in_keys
        names, observation = self.tensor_keys, self.state_value_network.in_keys
        following = (names.reward, names.done, names.terminated, *observation)
        keys = {*self.value_network.in_keys, *(unravel_key(("next", key)) for key in following)}
        if self.use_prioritized_weights is True:
            keys.add(unravel_key(names.priority_weight))
        self._in_keys = sorted(keys, key=str)
        return self._in_keys

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        self._in_keys = values

    def make_value_estimator(
        self, value_type: ValueEstimators | str | None = None, **hyperparams: Any
    ) -> Any:
        """Choose how V(s+) enters the target: TD0 (default), TD1 or TDLambda.

        ``gamma`` is by default the discount of the QP.

        Raises:
            QPError: if ``gamma`` or ``lmbda`` is not in [0, 1].
        """
        for name in {"gamma", "lmbda"} & hyperparams.keys():
            value = hyperparams[name]
            if isinstance(value, Tensor):
                value = value.item() if value.numel() == 1 else value.tolist()
            check_number(name, value, lambda x: 0 <= x <= 1, "a number in [0, 1]")
        hyperparams.setdefault("gamma", self.operator.module.gamma)
        value_type, options = self._prepare_value_estimator_kwargs(value_type, **hyperparams)
        if options is None:
            return self
        network, supported = self.state_value_network, self.SUPPORTED_VALUE_ESTIMATORS
        options |= {"tensor_keys": self._estimator_keys(), "supported": supported}
        dispatch_value_estimator(self, value_type, value_network=network, **options)
        return None

    @dispatch()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the loss of a batch of transitions, with detached scalars that describe it."""
        loss_value, metadata = self.loss_value(tensordict)
        out = TensorDict({"loss_value": loss_value, **metadata}, batch_size=[])
        self._clear_weakrefs(tensordict, out, "value_network_params", "target_value_network_params")
        return out

    def loss_value(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return loss and scalars of ``tensordict``; write the squared TD errors as its priority.

        If the value network has an ``active_set_key``, the active sets of Q(s, a) and, under
        ``"next"``, of V(s+) are read from there if present, and written there.

        Raises:
            QPError: if an entry is missing, does not fit, or holds weights that are not finite.
        """
        self._check_batch(tensordict)
        visited = self._visited(tensordict)
        if (active_set := self.operator.active_set_key) is not None:
            tensordict.set(active_set, visited.get(active_set))
        prediction = visited[self.tensor_keys.state_action_value].squeeze(-1)
        target = self.target(tensordict)
        use = usable(prediction, target)
        metadata = td_metadata(prediction.detach(), target, use)
        prediction = torch.where(use, prediction, 0)
        target = torch.where(use, target, 0).to(prediction)
        priority = (target - prediction).detach().square()
        tensordict.set(self.tensor_keys.priority, priority, inplace=True)
        loss = td_loss(prediction, target, self.td_error_clip)
        if self.weighted:
            flat, error = visited.reshape(-1), (target - prediction).detach()
            pairs = self.operator.known(flat), flat.get(self.operator.in_keys[1])
            rest = (x.reshape(-1) for x in (prediction.detach(), error, use))
            loss = inverse_variance(*pairs, *rest).view_as(loss) * loss
        weights = self.priority_weights(tensordict)
        return self._reduce_loss(loss, tensordict=tensordict, weights=weights), metadata

    def priority_weights(self, tensordict: TensorDictBase) -> Tensor | None:
        """Return the priority weights ``(*batch,)`` of a ``tensordict``; None without."""
        weights = self._maybe_get_priority_weight(tensordict)
        if weights is not None and has_values(weights) and not weights.isfinite().all():
            name = str(self.tensor_keys.priority_weight)
            raise QPError.expected(name, "NaN or inf", "finite weights", "Check the priorities.")
        return weights

    def _visited(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the entries that Q reads, with -Q(s, a) and, if it has a key, its active set."""
        visited = tensordict.select(*self._reads(self.value_network), strict=False).detach()
        _call_with(self.value_network_params, self.value_network, visited)
        return visited

    def _check_batch(self, tensordict: TensorDictBase) -> None:
        """Raise `QPError` if an entry is missing or would broadcast against the values."""
        keys, shape = self.tensor_keys, (*tensordict.batch_size, 1)
        ends = {keys.reward: None, keys.done: torch.bool, keys.terminated: torch.bool}
        for key, dtype in ends.items():
            path = unravel_key(("next", key))
            value = tensordict.get(path, None)
            if value is None:
                if key == keys.terminated and tensordict.get(("next", keys.done), None) is not None:
                    continue  # done replaces it
                remedy = "Name another with set_keys, or collect transitions."
                raise QPError.expected(str(path), "no such entry", f"one of shape {shape}", remedy)
            if value.shape != shape:
                remedy = "TorchRL's rewards and flags have a last dimension of one."
                got, want = f"shape {tuple(value.shape)}", f"shape {shape}"
                raise QPError.expected(str(path), got, want, remedy)
            if dtype is not None and value.dtype != dtype:
                raise QPError.expected(str(path), value.dtype, dtype, "Convert it: .bool().")
        if 0 in tensordict.batch_size:
            raise QPError.expected("tensordict", "an empty batch", "at least one transition")

    @torch.no_grad()
    def observe(self, tensordict: TensorDictBase) -> None:
        """Extend the range of rewards, which bounds V(s+), by those of ``tensordict``."""
        reward = tensordict.get(("next", self.tensor_keys.reward)).to(self.reward_range)
        if (reward := reward[reward.isfinite()]).numel():
            self.reward_range[0] = reward.min().minimum(self.reward_range[0])
            self.reward_range[1] = reward.max().maximum(self.reward_range[1])

    @torch.no_grad()
    def centre_(self, tensordict: TensorDictBase) -> float:
        """Move the QP's constant c to where the mean TD error of a batch is zero.

        A target network's c moves as far, and c moves even if it is not learned. This is LSTD in c
        alone (Bradtke and Barto, "Linear least-squares algorithms for temporal difference
        learning", Machine Learning 1996): gradient steps need about 1 / (1 - gamma) updates.

        Args:
            tensordict: transitions, as for `forward`. Those without a solution or a finite reward
                are left out, and values are not clipped.

        Returns:
            The change of c; zero if no transition is left, or gamma is 1 and none terminates.

        Raises:
            QPError: if an entry of the batch is missing or does not fit.
        """
        self._check_batch(tensordict)
        batch = tensordict.copy()
        prediction = self._visited(batch)[self.tensor_keys.state_action_value].squeeze(-1)
        value, terminated = self._unbounded_value(batch)
        reward = batch.get(("next", self.tensor_keys.reward))
        target = self._estimate(batch, reward, value)
        factor = self._estimate(batch, torch.zeros_like(reward), (~terminated).to(value))
        use = usable(prediction, target)
        lost = (1 - factor)[use].sum()
        # Where gamma is 1, rounding is left.
        if not lost > 1e-6 * use.sum():
            return 0.0
        shift = float((prediction - target)[use].sum() / lost)
        networks = self.value_network_params, self.target_value_network_params
        for params in networks[: 1 + self.delay_value]:
            with params.to_module(self.value_network, preserve_module_state=False):
                self.operator.module.c.add_(shift)
        return shift

    def _bounded(self, value: Tensor) -> Tensor:
        """Clip values, in TorchRL's signs, to the sums of rewards within their range or of none."""
        low, high = self.reward_range
        rest = (1 - torch.as_tensor(self.value_estimator.gamma)).clamp(min=torch.finfo().tiny)
        low, high = low.clamp(max=0) / rest, high.clamp(min=0) / rest
        unknown = self.reward_range[0] > self.reward_range[1]
        return torch.where(unknown, value, value.clamp(low.to(value), high.to(value)))

    @torch.no_grad()
    def target(self, tensordict: TensorDictBase) -> Tensor:
        """Return the value estimator's target of ``tensordict``, ``(*batch,)``, in TorchRL's signs.

        With TD(0) it is -(L + gamma (1 - terminated) V(s+)). It is -inf where it contains a V(s+)
        without a solution, and NaN where it contains an invalid reward.
        """
        key = unravel_key(("next", self.tensor_keys.reward))
        reward = tensordict.get(key)
        invalid = invalid_rewards(reward, key)
        value, _ = self._unbounded_value(tensordict)
        # An infinite cost marks a QP without a solution.
        next_value = torch.where(value.isfinite(), self._bounded(value), value)
        valid = reward.masked_fill(invalid, 0)
        target = self._estimate(tensordict, valid, next_value)
        target = torch.where(target.isfinite(), target, -torch.inf)
        if not has_values(invalid) or invalid.any():
            # With rewards of one if invalid and else zero, returns are nonzero if they contain one.
            tainted = self._estimate(tensordict, invalid.to(reward), torch.zeros_like(next_value))
            target = target.masked_fill(tainted != 0, torch.nan)
        return target

    def _estimate(self, tensordict: TensorDictBase, reward: Tensor, next_value: Tensor) -> Tensor:
        """Return the value estimates ``(*batch,)`` of the batch with these rewards."""
        batch = tensordict.copy().set(("next", self.tensor_keys.reward), reward)
        return self.value_estimator.value_estimate(batch, next_value=next_value).squeeze(-1)

    def _unbounded_value(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return -V(s+), zero after a termination, and True there, both ``(*batch, 1)``."""
        active_set, network = self.operator.active_set_key, self.state_value_network
        following = tensordict.get("next").select(*self._reads(network), strict=False)
        _call_with(self.target_value_network_params, network, following)
        if active_set is not None:
            tensordict.set(unravel_key(("next", active_set)), following.get(active_set))
        done = tensordict.get(("next", self.tensor_keys.done))
        terminated = tensordict.get(("next", self.tensor_keys.terminated), default=done)
        return following[self.tensor_keys.value].masked_fill(terminated, 0.0), terminated

    def _reads(self, network: TensorDictModuleBase) -> list[NestedKey]:
        """Return the in-keys of a view of the QP, and its active-set key if there is one."""
        key = self.operator.active_set_key
        return [*network.in_keys, *([] if key is None else [key])]


def _call_with(
    params: TensorDictBase, network: TensorDictModuleBase, tensordict: TensorDictBase
) -> None:
    """Call ``network`` on ``tensordict``, in place, with ``params`` instead of its own tensors.

    After an exception, tensordict's context would leave ``params`` in the network.
    """
    failure = None
    with params.to_module(network, preserve_module_state=False):
        try:
            network(tensordict)
        except BaseException as error:  # Ctrl-C, too
            failure = error
    if failure is not None:
        raise failure


def _last(network: Any) -> Any:
    """Return the last module of a sequence, or the module itself."""
    return network.module[-1] if isinstance(network, TensorDictSequential) else network
