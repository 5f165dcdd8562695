"""The choice of a start: two logs of the plant, and closed loops with the models of both."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import torch
from omegaconf import DictConfig
from scipy.special import stdtrit
from tensordict import TensorDictBase, pad
from torch import Tensor
from tqdm import tqdm

from torch_qpmpc.envs.closed_loop import ClosedLoop
from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.rivals import ZERO_ACTION, zero_action
from torch_qpmpc.experiment.tasks import AnyPlant, find_task, make_mpc
from torch_qpmpc.experiment.tasks.choice import Choice, Row
from torch_qpmpc.experiment.tasks.identified import Start, identified_start
from torch_qpmpc.learning.operators import warm_policy
from torch_qpmpc.mpc.blended import identify_blended
from torch_qpmpc.mpc.log import valid_steps

#: Episodes of each start in the first round.
FEW = 4
#: The seeds of the episodes begin this far above the run's seed, away from an evaluation's.
APART = 10**6
#: The probability with which the chosen start costs less than zero action.
CONFIDENCE = 0.95
#: Blended models are among the starts if they leave less than this share of the held-out variance
#: that one model leaves unexplained.
BLENDED_SHARE = 0.8
#: The names of the candidates.
ESTIMATE, OUTPUTS, BLENDED = "MPC of the estimate", "MPC of the outputs", "blended models"
#: The end of the names of starts that are identified from the first log alone.
FIRST = ", first log"


def candidates(cfg: DictConfig, physics: AnyPlant, log: Any) -> dict[str, Start]:
    """Return at most three starts of a log by name.

    They are MPC of the estimate and of the outputs, each with the regulator's cost of x_N, and, at
    twice the horizon, models of the outputs that are blended where the plant is nonlinear.

    Raises:
        QPError: as in `identified_start`.
    """
    estimate, N = identified_start(cfg, physics, log), cfg.task.horizon
    outputs = estimate if not estimate.order else identified_start(cfg, physics, log, order=0)
    regulated = estimate.cost is not None and cfg.task.hessian != "diagonal"
    named = {ESTIMATE: estimate} if estimate.order else {}
    named = {
        name: start._replace(riccati=regulated)
        for name, start in (named | {OUTPUTS: outputs}).items()
    }
    if not outputs.layout.n_d and cfg.export is None and cfg.constraint.si is None:
        blended = identify_blended(outputs.log, 2 * N)
        unexplained = {count: 1 - R2 for count, R2 in blended.R2.items()}
        if min(unexplained.values()) < BLENDED_SHARE * unexplained[1]:
            named[BLENDED] = outputs._replace(horizon=2 * N, blended=blended)
    return {name: _solvable(cfg, physics, start) for name, start in named.items()}


def choose(
    cfg: DictConfig,
    physics: AnyPlant,
    log: Any,
    explored: Callable[[Start], TensorDictBase],
    quiet: bool = True,
) -> tuple[Start, TensorDictBase]:
    """Choose a start by closed loops on the plant; return it and the logs, one below the other.

    The `candidates` of the log have the same 4 episodes; ``explored`` collects a second log with
    the best one, and the candidates of both logs have these episodes, too. Then the best two have
    ``task.start_episodes`` in all, as zero action has. The best one is chosen if it costs less than
    zero action by a one-sided paired t-test of 95 %; if not, zero action is.
    """
    rows, costs = {}, {}
    named = {f"{name}{FIRST}": start for name, start in candidates(cfg, physics, log).items()}
    with tqdm(desc="starts", leave=False, disable=quiet or None) as bar:

        def run(name: str, count: int) -> None:
            bar.set_postfix_str(name)
            done = costs.get(name, torch.zeros(0, dtype=torch.float64))
            loop = _loop(cfg, physics, named[name], len(done), count)
            costs[name] = torch.cat((done, loop.costs.sum(0).nan_to_num(torch.inf, torch.inf)))
            lasted = float(loop.costs.numel() if loop.lengths is None else loop.lengths.sum())
            old = rows.get(name, Row())
            J, steps = costs[name], old.transitions + loop.costs.numel()
            rows[name] = Row(len(J), J.mean().item(), _error(J), steps, old.lasted + lasted)
            bar.update()

        few = min(FEW, cfg.task.start_episodes)
        for name in named:
            run(name, few)
        best = min(named, key=lambda name: rows[name].J)
        log = below(log, explored(named[best]))
        second = candidates(cfg, physics, log)
        named |= second
        for name in second:
            run(name, few)
        finalists = sorted(named, key=lambda name: rows[name].J)[:2]
        named[ZERO_ACTION] = named[finalists[0]]._replace(held=_zero(physics))
        for name in (*finalists, ZERO_ACTION):
            if name == ZERO_ACTION or few < cfg.task.start_episodes:
                run(name, cfg.task.start_episodes)
    best = min(finalists, key=lambda name: rows[name].J)
    chosen = best if _is_less(costs[best] - costs[ZERO_ACTION]) else ZERO_ACTION
    choice = Choice({name: row._replace(chosen=name == chosen) for name, row in rows.items()})
    return named[best]._replace(held=named[chosen].held, choice=choice), log


def chosen_before(cfg: DictConfig, physics: AnyPlant, log: TensorDictBase, choice: Choice) -> Start:
    """Return the start that a run has chosen from its logs.

    Raises:
        QPError: the logs have no such start.
    """
    first = choice.scheme.endswith(FIRST)
    named = candidates(cfg, physics, log[: -cfg.num_envs] if first else log)
    if (start := named.get(choice.scheme.removesuffix(FIRST))) is None:
        raise QPError.expected("starts.csv", f"{choice.scheme!r}", f"one of {', '.join(named)}")
    return start._replace(
        held=_zero(physics) if choice.name == ZERO_ACTION else None, choice=choice
    )


def below(first: TensorDictBase, second: TensorDictBase) -> TensorDictBase:
    """Return two logs, ``(T,)`` or ``(episodes, T)``, one below the other; padding is masked.

    Entries that only one has, as in a log of one's own, are left out.
    """
    logs = [log if log.batch_dims == 2 else log.unsqueeze(0) for log in (first, second)]
    steps = max(log.shape[1] for log in logs)
    logs = [log.clone(recurse=False).set("mask", valid_steps(log)) for log in logs]
    logs = [pad(log, [0, 0, 0, steps - log.shape[1]]) for log in logs]
    common = set.intersection(*({*log.keys(True, True)} for log in logs))
    both: Any = torch.cat([log.select(*common) for log in logs])
    return both


def _zero(physics: AnyPlant) -> Tensor:
    return zero_action(physics)(physics.lb_a[None])[0]


def _solvable(cfg: DictConfig, physics: AnyPlant, start: Start) -> Start:
    """Return the start, without the regulator's cost of x_N if its model and cost have none."""
    with suppress(QPError):
        make_mpc(cfg, start.plant(physics), start)
        return start
    return start._replace(riccati=False)


def _loop(cfg: DictConfig, physics: AnyPlant, start: Start, done: int, count: int) -> ClosedLoop:
    """Run a start's next ``count - done`` episodes."""
    plant, held = start.plant(physics), start.held
    if held is None:
        policy = warm_policy(make_mpc(cfg, plant, start))
    else:
        policy = lambda s: held.expand(len(s), -1)  # noqa: E731
    options = {"steps": cfg.task.eval_steps, "gamma": cfg.task.gamma}
    options |= {"starts": count - done, "seed": APART + cfg.seed + done}
    return find_task(cfg.task).closed_loop(policy, plant, **options)


def _is_less(differences: Tensor) -> bool:
    """Return True if the mean of ``differences`` is negative, by a one-sided t-test."""
    mean, t = differences.mean().item(), float(stdtrit(len(differences) - 1, CONFIDENCE))
    return mean == -math.inf or mean + t * _error(differences) < 0


def _error(costs: Tensor) -> float:
    """Return the standard error of the mean."""
    return (costs.std() / math.sqrt(len(costs))).item()
