"""Returns of several steps, from consecutive rows of the replay.

TorchRL's ``MultiStep`` is not used: it keeps the first step's ``terminated`` where the next state
is a later one, so that V bootstraps beyond a termination, and spreads NaN rewards to other
episodes. Its key ``steps_to_next_obs`` is kept, by which TorchRL's estimators discount V(s+).
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torch_qpmpc.checks import check_number, check_whole
from torch_qpmpc.errors import QPError

#: The key of the number of steps from s to s+; TorchRL's name.
STEPS = "steps_to_next_obs"


def end_where_cut(slices: TensorDictBase, rows: Tensor, newest: int) -> TensorDictBase:
    """Set ``("next", "done")`` where the following row continues another episode.

    Args:
        slices: ``(M, n)`` consecutive rows of columns of the replay, with their trajectory ids.
        rows: their rows in the storage, ``(M, n)``.
        newest: the row that was written last, which nothing follows.
    """
    ids = slices["collector", "traj_ids"]
    cut = rows == newest
    cut[:, :-1] |= ids[:, 1:] != ids[:, :-1]
    return slices.set(("next", "done"), slices["next", "done"] | cut.unsqueeze(-1))


def n_step_transitions(slices: TensorDictBase, gamma: float) -> TensorDictBase:
    """Return the transitions ``(M,)`` from each slice's first s over its steps, at most n.

    With k = `STEPS`, the number of steps up to the first done, the reward is
    ``sum over i < k of gamma^i r_i``, and all other entries under ``"next"`` are those after k
    steps.

    Args:
        slices: ``(M, n)`` consecutive transitions; those after a done are not used.
        gamma: the discount factor of the target.

    Raises:
        QPError: if ``slices`` has another number of dimensions or ``gamma`` is not in [0, 1].
    """
    if slices.batch_dims != 2:
        raise QPError.expected("slices", f"shape {tuple(slices.shape)}", "(M, n)")
    check_number("gamma", gamma, lambda x: 0 <= x <= 1, "a number in [0, 1]")
    first: Any = slices[:, 0]
    after: Any = slices["next"]
    reward, done = after["reward"], after["done"]
    open_before = torch.ones_like(done)
    open_before[:, 1:] = (~done[:, :-1]).cumprod(1).bool()
    steps = open_before.sum(1)
    powers = gamma ** torch.arange(slices.shape[1], device=reward.device, dtype=reward.dtype)
    # where, not a product: the reward of another episode may be NaN.
    summed = torch.where(open_before, reward, 0).mul(powers.unsqueeze(-1)).sum(1)
    last = after[torch.arange(len(slices), device=steps.device), steps.squeeze(-1) - 1]
    return first.set("next", last.set("reward", summed)).set(STEPS, steps)


def check_returns(n_step: int, gamma: float | None, batch_size: int) -> None:
    """Raise `QPError` unless batches of ``batch_size`` are of n-step transitions or slices."""
    check_whole("n_step", n_step, 1)
    if gamma is not None:
        check_number("gamma", gamma, lambda x: 0 <= x <= 1, "a number in [0, 1]")
    elif batch_size % n_step:
        expected = f"a multiple of n_step = {n_step}"
        raise QPError.expected("batch_size", batch_size, expected, "Slices have n_step steps.")
