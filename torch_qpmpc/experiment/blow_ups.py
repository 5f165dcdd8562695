"""Episodes of a log that blow up."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase

from torch_qpmpc.mpc.log import NEXT, valid_steps

#: The largest size of an observation, relative to the largest in the first transitions.
GROWTH = 1e6


def without_blow_ups(log: TensorDictBase) -> tuple[TensorDictBase, int]:
    """Mask each episode from its first diverging step on.

    An episode blows up where an observation or a reward is not finite, or an observation is larger
    than 1e6 times the largest of the log's first transitions.

    Args:
        log: logged steps, ``(T,)`` or ``(episodes, T)``, as in `as_log`.

    Returns:
        The log, with an entry ``mask`` if steps are masked, and the number of these episodes.
    """
    rows = log if log.batch_dims == 2 else log.unsqueeze(0)
    size = torch.maximum(*(rows[key].double().abs().amax(-1) for key in ("observation", NEXT)))
    limit = GROWTH * size[:, 0].nan_to_num(0.0, 0.0).amax()
    bad = ~(size <= limit) if limit > 0 else ~size.isfinite()
    if (reward := rows.get(("next", "reward"), None)) is not None:
        bad |= ~reward.reshape(bad.shape).isfinite()
    if not (bad & valid_steps(rows)).any():
        return log, 0
    done = rows.get(("next", "done"), torch.zeros_like(bad)).reshape(bad.shape)
    cut, over, episodes = torch.zeros_like(bad), bad.new_zeros(len(bad)), 0
    for k in range(bad.shape[1]):
        episodes += (bad[:, k] & ~over).sum().item()
        over = over | bad[:, k]
        cut[:, k] = over
        over = over & ~done[:, k]
    masked = log.clone(recurse=False)
    masked["mask"] = (valid_steps(rows) & ~cut).reshape(log.shape)
    return masked, int(episodes)
