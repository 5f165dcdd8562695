"""The steps of a log that are nearest to where its episodes begin, for a model and a cost of there.

A log of random actions soon leaves the region where an unstable plant is to work, and the largest
outputs decide a fit to all of it. A linear model is the plant's derivative only near a point.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from torch_qpmpc.mpc.log import NEXT, as_log, kept_steps

#: Steps for each coefficient of an output's linear model, and of a quadratic cost.
PER_MODEL, PER_COST = 20, 4
#: An output is still if it varies by less than this share of what the moving ones do in the median,
#: in units of their deviations in the log: so does the cosine of a small angle.
STILL = 1 / 2


def local_steps(log: Any, n_x: int, held: Sequence[int] = ()) -> tuple[Any, list[int]] | None:
    """Return the steps that are nearest to the mean first output, and the outputs still there.

    Distances are in units of the outputs' deviations.

    Args:
        log: logged steps in one TensorDict, as in `as_log`.
        n_x: the number of outputs, the last entries of the observation.
        held: indices of outputs that a model holds anyway, which are not among those still.

    Returns:
        The steps, ``(steps, 1)``, and indices of outputs; None if they are over half of the log.

    Raises:
        QPError: as in `as_log`.
    """
    first = torch.stack([part.y[0] for part in as_log(log, n_x).trajectories]).mean(0)
    steps = log.reshape(-1)[kept_steps(log).flatten()]
    y = steps["observation"][..., -n_x:].double()
    n = n_x + steps["action"].shape[-1]
    count = max(PER_MODEL * (n + 1), PER_COST * (n + 1) * (n + 2) // 2)
    if 2 * count > len(y):
        return None
    size = y.std(0, correction=0)
    moving = size > 1e-12 * y.abs().amax(0)
    moving[[*held]] = False
    size = torch.where(size > 0, size, 1.0)
    distance = ((y - first) / size).square().sum(-1)
    near = steps[distance.topk(count, largest=False).indices.sort().values]
    spread = (near["observation"][..., -n_x:].double() / size).std(0, correction=0)
    median = spread[moving].quantile(0.5) if moving.any() else 0.0
    still = moving & (spread < STILL * median)
    return near.unsqueeze(1), still.nonzero().flatten().tolist()


def without(steps: Any, outputs: Sequence[int], n_x: int) -> Any:
    """Return a copy of logged steps where ``outputs`` are zero, so that fits ignore them."""
    steps = steps.clone()
    for key in ("observation", NEXT):
        steps[key][..., -n_x:][..., [*outputs]] = 0.0
    return steps
