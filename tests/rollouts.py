"""Transitions of vectorised environments, also of ones whose episodes start at different steps."""

from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector


class Staggered:
    """Makes episodes of a vectorised environment start at different steps.

    Every later reset is then partial. It comes before the environment among the bases.
    """

    batch_size: torch.Size
    max_steps: int

    def _reset(self, tensordict: Any = None, **kwargs: Any) -> Any:
        out = super()._reset(tensordict, **kwargs)  # pyright: ignore[reportAttributeAccessIssue]
        if tensordict is None or "_reset" not in tensordict:
            out["step_count"] = torch.arange(self.batch_size[0]).unsqueeze(-1) % self.max_steps
        return out


def network_policy(env: Any) -> Any:
    """Make a small network of an environment's observation; two calls make the same one."""
    torch.manual_seed(0)
    observation, action = env.observation_spec["observation"], env.action_spec
    layer = nn.Linear(observation.shape[-1], action.shape[-1], dtype=observation.dtype)
    net = nn.Sequential(layer, nn.Tanh())
    return TensorDictModule(net, in_keys=["observation"], out_keys=["action"])


def collected(env: Any, batches: int, steps: int) -> Any:
    """Collect ``(num_envs, batches * steps)`` transitions of `network_policy`."""
    frames = {"frames_per_batch": steps * env.batch_size[0]}
    frames["total_frames"] = batches * frames["frames_per_batch"]
    policy = network_policy(env)
    collector = Collector(env, policy, auto_register_policy_transforms=False, **frames)
    data: list[Any] = [batch.clone() for batch in collector]
    collector.shutdown()
    return torch.cat(data, dim=1)
