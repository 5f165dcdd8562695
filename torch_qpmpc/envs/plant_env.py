"""The TorchRL environment of a `Plant`."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torch_qpmpc.checks import check_kind, check_whole
from torch_qpmpc.envs.plant import Plant
from torch_qpmpc.envs.vectorised import VectorisedEnv

#: The default number of different episodes of signals.
EPISODES = 1024


class PlantEnv(VectorisedEnv):
    """A TorchRL environment of ``num_envs`` vectorised episodes of a `Plant`.

    It emits the output y as ``observation`` ``(num_envs, n_y)``, and the known signals d_k, ..,
    d_{k+N} as ``preview`` ``(num_envs, (N + 1) n_d)`` if there are any. The transform `PastWindow`
    turns the observation into the window of past outputs and actions.

    The seed draws the signals of ``episodes`` episodes; each reset chooses one of them at random.
    Hidden entries, which a policy must not read, are ``state`` ``(num_envs, n_x)`` in float64,
    ``episode``, the index of the signals, ``step_count`` and ``violation``, each
    ``(num_envs, 1)``. At a partial reset, TorchRL's merging by mask restarts exactly the episodes
    that are reset.

    Episodes are truncated at ``max_steps`` (no ``StepCounter`` needed); they never terminate.

    Args:
        plant: the plant.
        num_envs: number of episodes run side by side, the batch size.
        max_steps: steps of an episode.
        dtype: dtype of observation, preview, action and reward; the plant stays in float64.
        device: device of the TensorDicts and of the generator; None for the CPU.
        seed: seed of the generator; None draws one from torch's global generator.
        episodes: number of different episodes of signals.

    Raises:
        QPError: if an argument does not fit, such as ``num_envs`` or ``episodes`` below 1.
    """

    def __init__(
        self,
        plant: Plant,
        num_envs: int,
        max_steps: int,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str | None = None,
        seed: int | None = None,
        episodes: int = EPISODES,
    ) -> None:
        check_kind("plant", plant, Plant)
        check_whole("episodes", episodes, 1)
        super().__init__(num_envs, max_steps, dtype, device, seed)
        self.plant = p = plant.to(self.device)
        self.episodes = episodes
        n_x = p.starts(torch.Generator(device=self.rng.device), 1).shape[-1]
        observed = {"observation": self._reals(p.n_y), "violation": self._reals(1)}
        if p.n_d:
            observed["preview"] = self._reals((p.horizon + 1) * p.n_d)
        hidden = {"state": self._reals(n_x, torch.float64), "episode": self._reals(1, torch.int64)}
        self._start(observed, hidden, self._box(p.lb_a, p.ub_a), seed)

    def _set_seed(self, seed: int | None) -> None:
        super()._set_seed(seed)
        length = self.max_steps + self.plant.horizon + 1
        self._signals = self.plant.signals(self.rng, self.episodes, length)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        # Reset every environment: at a partial reset, TorchRL keeps the old values of the others.
        x = self.plant.starts(self.rng, self.batch_size[0])
        count = self._zero_count()
        episode = torch.randint(self.episodes, count.shape, generator=self.rng, device=count.device)
        return self._observed(x, episode, count)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        x, u = tensordict["state"], self.plant.applied(tensordict["action"])
        episode, count = tensordict["episode"], tensordict["step_count"]
        w = self._signals[episode, count].squeeze(-2)
        out = self._observed(self.plant.step(x, u, w), episode, count + 1)
        return out.set("reward", -self.plant.cost(x, u, w).unsqueeze(-1).to(self.dtype))

    def _observed(self, x: Tensor, episode: Tensor, count: Tensor) -> TensorDict:
        p = self.plant
        w = self._signals[episode, count + torch.arange(p.horizon + 1, device=count.device)]
        shown = {
            "observation": p.output(x, w[:, 0]),
            "violation": p.violation(x, w[:, 0]).unsqueeze(-1),
        }
        if p.n_d:
            shown["preview"] = w[..., : p.n_d].flatten(-2)
        shown = {name: value.to(self.dtype) for name, value in shown.items()}
        return self._pack(count, state=x, episode=episode, **shown)
