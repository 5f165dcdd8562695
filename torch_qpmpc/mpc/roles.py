"""The roles of outputs in a log: those that the actions do not move, such as set-points."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torch_qpmpc.mpc.log import Trajectory

#: The other orders of the actions, in which they cannot explain a change.
ORDERS = 99
#: The fewest changes of an input that show what it moves.
FEWEST = 100
#: The least share of steps without a change of an output that is held.
CONSTANT = 0.5


def unmoved(trajectories: Sequence[Trajectory], horizon: int) -> list[int]:
    """Return the outputs that are constant in most steps, and that the actions do not move.

    It is a randomisation test of 1 %: where an action changes, its new value and the square of that
    must not explain the output's change over the next step or the horizon, beyond what is linear in
    y_k, better than the same values in 99 random orders do. So the actions must be random; feedback
    can only keep an output from the list. So does an input with fewer than 100 changes, as it shows
    too little. Outputs that never change are always in the list.

    Args:
        trajectories: the log.
        horizon: N.
    """
    changes = torch.cat([log.y.diff(dim=0) for log in trajectories])
    never = (changes == 0).all(0)
    constant = (changes == 0).double().mean(0) >= CONSTANT
    for steps in {1, horizon} if constant.any() else ():
        constant &= ~_moved([log for log in trajectories if log.steps > steps], steps)
    return (never | constant).nonzero().flatten().tolist()


def _moved(trajectories: Sequence[Trajectory], steps: int) -> Tensor:
    """Return True for the outputs whose change over ``steps`` the actions explain, ``(n_x,)``."""
    if not trajectories:
        return torch.tensor(True)
    starts = [slice(1, log.steps - steps + 1) for log in trajectories]
    pairs = [*zip(trajectories, starts, strict=True)]
    y = torch.cat([log.y[i] for log, i in pairs])
    change = torch.cat([log.y[1 + steps :] for log in trajectories]) - y
    u = torch.cat([log.u[i] for log, i in pairs])
    new = torch.cat([log.u.diff(dim=0)[: log.steps - steps] for log in trajectories]) != 0
    y = torch.cat((torch.ones_like(y[:, :1]), (y - y.mean(0)) / y.std(0).clamp(min=1e-300)), -1)
    rest = (change - y @ torch.linalg.lstsq(y, change, driver="gelsd").solution) * change.any(0)
    changing = new.any(0)
    if not changing.any() or (new[:, changing].sum(0) < FEWEST).any():
        return torch.tensor(True)
    draw, explained = torch.Generator().manual_seed(0), torch.zeros(ORDERS + 1, len(rest.mT))
    for values, at in zip(u.mT[changing], new.mT[changing], strict=True):
        values = values[at] - values[at].mean()
        orders = [torch.arange(len(values))]
        orders += [torch.randperm(len(values), generator=draw) for _ in range(ORDERS)]
        for each in (values, values.square() - values.square().mean()):
            # The squares of two levels are constant.
            size = each.square().sum().clamp(min=1e-12 * len(each))
            explained = explained + (each[torch.stack(orders)] @ rest[at]).square() / size
    return explained[0] > explained[1:].amax(0)
