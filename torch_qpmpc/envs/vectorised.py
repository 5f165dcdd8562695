"""TorchRL environments of vectorised episodes, whose only state is a random generator."""

from abc import abstractmethod
from typing import Any, ClassVar

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from torch_qpmpc.checks import check_kind, check_seed, check_whole
from torch_qpmpc.errors import QPError


class VectorisedEnv(EnvBase):
    """``num_envs`` episodes of a plant side by side, without a Python loop; none terminates.

    Its only state is the generator. Whatever else a step needs travels in the TensorDict as hidden
    entries beside the observation, ``step_count`` ``(num_envs, 1)`` among them, so that TorchRL's
    merging by mask restarts exactly the episodes that are reset. A policy must not read them.

    Args:
        plant: the plant.
        num_envs: number of episodes run side by side, the batch size.
        max_steps: steps of an episode.
        dtype: dtype of what the environment emits and of the action; the plant stays in float64.
        device: device of the TensorDicts and of the generator; None for the CPU.
        seed: seed of the generator; None draws one from torch's global generator.

    Raises:
        QPError: an argument does not fit, such as ``num_envs`` or ``max_steps`` below 1.
    """

    #: The class of the plant.
    kind: ClassVar[type]

    def __init__(
        self,
        plant: Any,
        num_envs: int = 8,
        max_steps: int = 50,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str | None = None,
        seed: int | None = None,
    ) -> None:
        check_kind("plant", plant, self.kind)
        check_whole("num_envs", num_envs, 1)
        check_whole("max_steps", max_steps, 1)
        if not isinstance(dtype, torch.dtype) or not dtype.is_floating_point:
            raise QPError.expected("dtype", dtype, "a floating-point torch.dtype")
        super().__init__(device=device, batch_size=torch.Size([num_envs]))
        self.max_steps, self.dtype, self.plant = max_steps, dtype, plant.to(self.device)
        self.rng = torch.Generator(device=self.device or "cpu")
        observed, hidden = self._entries()
        hidden["step_count"] = count = self._reals(1, dtype=torch.int64)
        flags = ("done", "terminated", "truncated")
        flag = Categorical(2, shape=count.shape, dtype=torch.bool, device=self.device)

        def composite(specs: dict[str, Any]) -> Composite:
            copies = {name: spec.clone() for name, spec in specs.items()}
            return Composite(copies, shape=self.batch_size, device=self.device)

        self.state_spec = composite(hidden)
        self.observation_spec = composite({**observed, **hidden})
        self.action_spec = self._box(self.plant.lb_a, self.plant.ub_a)
        self.reward_spec = self._reals(1)
        self.done_spec = composite(dict.fromkeys(flags, flag))
        self.set_seed(int(torch.randint(2**31, ())) if seed is None else seed)

    @abstractmethod
    def _entries(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return the specs of what is observed and of what is hidden."""

    def _reals(self, size: int, dtype: torch.dtype | None = None) -> Unbounded:
        shape, dtype = torch.Size([*self.batch_size, size]), dtype or self.dtype
        return Unbounded(shape, dtype=dtype, device=self.device)

    def _box(self, low: Tensor, high: Tensor) -> Bounded:
        low, high = (b.to(self.dtype).expand(*self.batch_size, -1).clone() for b in (low, high))
        return Bounded(low, high, dtype=self.dtype, device=self.device)

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            check_seed(seed)
            self.rng.manual_seed(seed ^ self.plant.stream)

    def _zero_count(self) -> Tensor:
        return torch.zeros((*self.batch_size, 1), dtype=torch.int64, device=self.rng.device)

    def _pack(self, step_count: Tensor, **entries: Tensor) -> TensorDict:
        """Make a step's TensorDict of the entries, the step count and the flags."""
        truncated = step_count >= self.max_steps
        entries |= {"step_count": step_count, "done": truncated, "truncated": truncated.clone()}
        entries["terminated"] = torch.zeros_like(truncated)
        return TensorDict(entries, batch_size=self.batch_size, device=self.device)
