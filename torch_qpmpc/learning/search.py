"""Direct search: a few scalars of theta by CMA-ES, on the cost of closed loops.

Margins, slack weights, the price of an action or a terminal slope shape the policy more than they
shape its TD error, and there are few of them: a search on J itself, with a library's evolution
strategy, needs some tens of closed loops.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils import parametrize

from torch_qpmpc.checks import check_kind, check_number, check_seed, check_whole
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.module import QPMPC

Theta = dict[str, Tensor]
#: The parts of theta that the scalars move.
PARTS = ("H", "H_f", "q", "b", "lb", "ub", "w")
#: Spawn key of the closed loops' seeds: they are never those of the gate, which judges the result.
SPAWN_KEY = 1


def _margin(mpc: QPMPC, theta: Theta, x: float) -> Theta:
    return {
        "lb": torch.where(mpc.soft, theta["lb"] + x, theta["lb"]),
        "ub": torch.where(mpc.soft, theta["ub"] - x, theta["ub"]),
    }


def _slack_weight(mpc: QPMPC, theta: Theta, x: float) -> Theta:
    return {"w": theta["w"] * np.exp(x)}


def _action_weight(mpc: QPMPC, theta: Theta, x: float) -> Theta:
    # A congruence: the block of the plan stays positive semidefinite.
    H, root = theta["H"], np.exp(x / 2)
    factor = torch.where(torch.arange(H.shape[-1]) >= H.shape[-1] - mpc.n_u, root, 1.0).to(H)
    if mpc.hessian == "diagonal":
        return {"H": H * factor.square()}
    return {"H": factor.unsqueeze(-1) * H * factor}


def _terminal_weight(mpc: QPMPC, theta: Theta, x: float) -> Theta:
    return {"H_f": theta["H_f"] * np.exp(x)}


def _terminal_slope(mpc: QPMPC, theta: Theta, x: float) -> Theta:
    q = theta["q"].clone()
    q[-mpc.n_x :] += x
    return {"q": q}


def _offset(mpc: QPMPC, theta: Theta, x: float) -> Theta:
    return {"b": theta["b"] + x}


#: Scalars that a search may move: functions of theta and x, without effect at x = 0.
KNOBS: dict[str, Callable[[QPMPC, Theta, float], Theta]] = {
    "margin": _margin,
    "w": _slack_weight,
    "H_u": _action_weight,
    "H_f": _terminal_weight,
    "q_f": _terminal_slope,
    "b": _offset,
}


def available(mpc: QPMPC) -> list[str]:
    """Return the names of the scalars that change the policy of this QP.

    A full H has no weights of its stages, and without soft rows there is nothing to tighten.
    """
    without: set[str] = set()
    if mpc.hessian == "full":
        without |= {"H_u", "H_f"}
    if not mpc.soft.any():
        without |= {"margin", "w"}
    return [name for name in KNOBS if name not in without]


def search(
    mpc: QPMPC,
    costs: Callable[[QPMPC, int], Tensor],
    knobs: Mapping[str, float],
    *,
    loops: int = 64,
    seed: int = 0,
) -> dict[str, float]:
    """Move a few scalars of theta by CMA-ES to where closed loops cost least.

    All candidates of a generation run with the same starts and disturbances, each generation with
    new ones.

    Args:
        mpc: the QPMPC, which is changed in place.
        costs: maps a QPMPC and a seed to the costs ``(starts,)`` of closed loops.
        knobs: the initial standard deviation of each scalar: ``margin``, by which the bounds of all
            soft rows are tightened, in their unit; ``b``, added to the model's offset; ``q_f``,
            added to the terminal slope; and ``w``, ``H_u`` and ``H_f``, the logarithms of factors
            of the slack weights and of the weights of actions and x_N.
        loops: the number of candidates, each one call of ``costs``.
        seed: seeds the search, the starts and the disturbances.

    Returns:
        The best scalars; all zero stand for the theta that the search started from.

    Raises:
        QPError: an argument is invalid, or a scalar is not `available`.

    Example:
        >>> import torch_qpmpc as qm
        >>> from torch_qpmpc.envs import PointMass
        >>> from torch_qpmpc.envs.closed_loop import closed_loop
        >>> physics = PointMass()
        >>> def costs(mpc, seed):
        ...     return closed_loop(mpc.policy, physics, steps=20, seed=seed).costs.sum(0)
        >>> options = {"stage_weight": [1.0] * 4 + [0.1] * 2, "action_bounds": ([-1] * 2, [1] * 2)}
        >>> mpc = qm.QPMPC.from_model(physics.A, physics.B, 5, **options)
        >>> scalars = search(mpc, costs, {"H_u": 0.5, "H_f": 0.5}, loops=12)
        >>> sorted(scalars)
        ['H_f', 'H_u']
    """
    from cma import CMAEvolutionStrategy

    check_kind("mpc", mpc, QPMPC)
    check_whole("loops", loops, 1)
    check_seed(seed)
    known = available(mpc)
    if not knobs or (unknown := set(knobs) - {*known}):
        got = sorted(unknown) if knobs else "none"
        raise QPError.expected("knobs", got, f"names among those of this QP, {', '.join(known)}")
    for name, size in knobs.items():
        check_number(f"knobs[{name}]", size, lambda x: x > 0, "a finite number > 0")
    theta = {part: getattr(mpc, part).detach().clone() for part in PARTS if hasattr(mpc, part)}
    # CMA-ES needs two dimensions.
    names, sizes = list(knobs), np.array([*knobs.values(), 1.0][: max(len(knobs), 2)])
    options = {"seed": seed + 1, "verbose": -9, "maxfevals": loops}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        strategy = CMAEvolutionStrategy(np.zeros(len(sizes)), 1.0, options)
    done = 0
    while done < loops:
        points = strategy.ask()
        entropy = np.random.SeedSequence([seed, done], spawn_key=(SPAWN_KEY,))
        run = int(entropy.generate_state(1)[0])
        means = []
        for x in points:
            _set(mpc, theta, dict(zip(names, x * sizes, strict=False)))
            cost = float(costs(mpc, run).mean())
            means.append(cost if np.isfinite(cost) else np.inf)
        strategy.tell(points, means)
        done += len(points)
    best = dict(zip(names, (strategy.result.xfavorite * sizes).tolist(), strict=False))
    _set(mpc, theta, best)
    return best


@torch.no_grad()
def _set(mpc: QPMPC, theta: Theta, scalars: Mapping[str, float]) -> None:
    """Set theta, moved by ``scalars``."""
    moved = dict(theta)
    for name, x in scalars.items():
        moved |= KNOBS[name](mpc, moved, float(x))
    for part, value in moved.items():
        if parametrize.is_parametrized(mpc, part):
            setattr(mpc, part, value)
        else:
            getattr(mpc, part).copy_(value)
