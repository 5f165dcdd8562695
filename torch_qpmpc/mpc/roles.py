"""The roles of outputs in a log: those that the actions do not move, such as set-points."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torch_qpmpc.mpc.trajectories import Trajectory

#: The other orders of the actions, in which they cannot explain a change.
SHIFTS = 99
#: The least share of steps without a change of an output that is held.
CONSTANT = 0.5


def unmoved(trajectories: Sequence[Trajectory], horizon: int) -> list[int]:
    """Return the outputs that are constant in most steps, and that the actions do not move.

    It is a randomisation test of 1 %: where an action changes, its new value must not explain the
    output's change over the next step or the horizon, beyond what is linear in y_k, better than the
    same values in 99 other orders do. So the actions must be random; feedback can only keep an
    output from the list.

    Args:
        trajectories: the log.
        horizon: N.
    """
    changes = torch.cat([log.y.diff(dim=0) for log in trajectories])
    constant = (changes == 0).double().mean(0) >= CONSTANT
    for steps in {1, horizon} if constant.any() else ():
        constant &= ~_moved([log for log in trajectories if log.steps > steps], steps)
    return constant.nonzero().flatten().tolist()


def _moved(trajectories: Sequence[Trajectory], steps: int) -> Tensor:
    """Return True for the outputs whose change over ``steps`` the actions explain, ``(n_x,)``."""
    if not trajectories:
        return torch.tensor(False)
    starts = [slice(1, log.steps - steps + 1) for log in trajectories]
    pairs = [*zip(trajectories, starts, strict=True)]
    y = torch.cat([log.y[i] for log, i in pairs])
    change = torch.cat([log.y[1 + steps :] for log in trajectories]) - y
    u = torch.cat([log.u[i] for log, i in pairs])
    new = torch.cat([log.u.diff(dim=0)[: log.steps - steps] for log in trajectories]) != 0
    y = torch.cat((torch.ones_like(y[:, :1]), (y - y.mean(0)) / y.std(0).clamp(min=1e-300)), -1)
    rest = (change - y @ torch.linalg.lstsq(y, change, driver="gelsd").solution) * change.any(0)
    own, others = 0.0, torch.zeros(SHIFTS, len(rest.mT), dtype=torch.float64)
    for values, at in zip(u.mT, new.mT, strict=True):
        values = values[at] - values[at].mean()
        rolled = [values.roll(len(values) * i // (SHIFTS + 1)) for i in range(SHIFTS + 1)]
        explained = (torch.stack(rolled) @ rest[at]).square() / values.square().sum()
        own, others = own + explained[0], others + explained[1:]
    return own > others.amax(0)
