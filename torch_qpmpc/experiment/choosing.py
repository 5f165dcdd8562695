"""The choice of a start among those that a log allows, by closed loops on the plant."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import torch
from omegaconf import DictConfig
from scipy.special import stdtrit
from torch import Tensor
from tqdm import tqdm

from torch_qpmpc.envs.closed_loop import ClosedLoop
from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.rivals import ZERO_ACTION, zero_action
from torch_qpmpc.experiment.tasks import AnyPlant, find_task, make_mpc
from torch_qpmpc.experiment.tasks.choice import MEAN_ACTION, Choice, Row
from torch_qpmpc.experiment.tasks.identified import (
    Start,
    identified_model,
    identified_start,
    is_regulated,
    observed_cost,
    regulator_cost,
)
from torch_qpmpc.learning.operators import warm_policy
from torch_qpmpc.mpc.blended import BlendedModel, identify_blended
from torch_qpmpc.mpc.identification import Identified
from torch_qpmpc.mpc.local import local_steps, without
from torch_qpmpc.mpc.log import as_log, valid_steps
from torch_qpmpc.mpc.predictor import prediction_errors
from torch_qpmpc.mpc.rewards import RewardCost, fit_most, fit_rewards

#: Episodes of each start in the first round.
FIRST = 2
#: The seeds of the episodes begin this far above the run's seed, away from an evaluation's.
APART = 10**6
#: The probability with which the chosen start costs less than zero action.
CONFIDENCE = 0.95
#: Blended models are among the starts if they leave less than this share of the held-out variance
#: that one model leaves unexplained.
BLENDED_SHARE = 0.8
#: L of the window that is among the starts if the model with it leaves less than this share of the
#: held-out variance that the model without it leaves unexplained, in one step or over the horizon.
WINDOW, WINDOW_SHARE = 3, 0.5
#: A local model is among the starts if it leaves less than this share of what the model of all
#: steps leaves unexplained of the next outputs near where episodes begin.
LOCAL_SHARE = 0.5
#: A share of variance that counts as none.
TINY = 1e-8
#: The ends of the names of a start with the regulator's cost at x_N, and of one whose model holds
#: no output.
RICCATI, NONE_HELD = ", Riccati", ", no output held"


def starts(cfg: DictConfig, physics: AnyPlant, log: Any) -> dict[str, Start]:
    """Return the starts of a log by name.

    They are all combinations of the run's structure or a tied one, the run's horizon or twice of
    it, and a cost of (y_{k+1}, u_k) if that fits better or one of (y_k, u_k); the same with a
    window where the observation hides a part of the state; both structures with the regulator's
    cost of x_N; where the plant is nonlinear, a model and a cost of the steps near where episodes
    begin, with the regulator's, and models blended from the log, as a schedule; and those that hold
    zero action and the log's mean action. The first one is the run's own.

    Raises:
        QPError: as in `identified_start`.
    """
    own, N = identified_start(cfg, physics, log), cfg.task.horizon
    costs = [own.cost]
    if own.cost is not None and own.cost.shifted:
        costs.append(RewardCost(own.cost.now))
    if own.cost is not None:
        layout, diagonal = own.identified.options.layout, cfg.task.hessian == "diagonal"
        most = fit_most(own.log, layout, own.cost, diagonal)
        costs += [] if most is None else [most]
    models = _models(cfg, own)
    named = {
        f"{name}{_cost_name(cost)}": own._replace(identified=model, cost=cost)
        for name, model in (models | _windowed(cfg, own, models)).items()
        for cost in costs
    }
    named |= _regulated(cfg, own, models)
    if (blended := _blended(cfg, own, 2 * N)) is not None:
        # Of the tied model only the sizes count.
        model = models[f"tied C, N={2 * N}"]
        for cost in costs:
            start = own._replace(identified=model, cost=cost, blended=blended)
            named[f"blended models, N={2 * N}{_cost_name(cost)}"] = start
    u = own.log["action"].flatten(0, -2)[valid_steps(own.log).flatten()].double()
    held = {ZERO_ACTION: zero_action(physics)(u[:1])[0], MEAN_ACTION: u.mean(0)}
    return named | {name: own._replace(held=action) for name, action in held.items()}


def choose(cfg: DictConfig, physics: AnyPlant, log: Any, quiet: bool = True) -> Start:
    """Choose among the `starts` of a log by successive halving over closed loops on the plant.

    All have the same 2 episodes, the better half 2 more, the better half of these 4 more, and so on
    up to ``task.start_episodes``, which zero action has, too. If the log has outputs to hold, a
    start that predicts them takes the place of the best one of the last round if it costs less in
    the same episodes. The best one is chosen if it costs less than zero action; if not, zero action
    is. Both are one-sided paired t-tests of 95 %.
    """
    named = starts(cfg, physics, log)
    policies = {name: _policy(cfg, physics, start) for name, start in named.items()}
    costs = dict.fromkeys(named, torch.zeros(0, dtype=torch.float64))
    steps, lasted = dict.fromkeys(named, 0), dict.fromkeys(named, 0.0)
    left, count, last = [*named], FIRST, False
    with tqdm(desc="starts", leave=False, disable=quiet or None) as bar:

        def run(name: str, count: int) -> None:
            bar.set_postfix_str(name)
            plant = named[name].plant(physics)
            loop = _loop(cfg, plant, policies[name](), len(costs[name]), count)
            more, whole = loop.costs.sum(0), float(loop.costs.numel())
            costs[name] = torch.cat((costs[name], more.nan_to_num(torch.inf, torch.inf)))
            steps[name] += loop.costs.numel()
            lasted[name] += whole if loop.lengths is None else loop.lengths.sum().item()
            bar.update()

        while not last:
            last = count >= cfg.task.start_episodes
            for name in left:
                run(name, count)
            others = [name for name in left if name != ZERO_ACTION]
            others.sort(key=lambda name: costs[name].mean().item())  # the run's own wins a tie
            left = [ZERO_ACTION, *others[: -(-len(others) // 2)]]
            count = min(2 * count, cfg.task.start_episodes)
        best = left[1]
        if (other := _none_held(cfg, named[best])) is not None:
            name = best + NONE_HELD
            named[name], policies[name] = other, _policy(cfg, physics, other)
            costs[name], steps[name], lasted[name] = torch.zeros_like(costs[best][:0]), 0, 0.0
            run(name, len(costs[best]))
            best = name if _is_less(costs[name] - costs[best]) else best
    chosen = best if _is_less(costs[best] - costs[ZERO_ACTION]) else ZERO_ACTION
    rows = {}
    for name, start in named.items():
        R2, J = _R2(start), costs[name]
        errors, length = _error(J), lasted[name] / max(len(J), 1)
        rows[name] = Row(R2, len(J), J.mean().item(), errors, steps[name], name == chosen, length)
    return _start(named, Choice(rows))


def chosen_before(cfg: DictConfig, physics: AnyPlant, log: Any, choice: Choice) -> Start:
    """Return the start that a run has chosen from its log.

    Raises:
        QPError: the log has no such start.
    """
    named = starts(cfg, physics, log)
    for name in (choice.name, choice.scheme):
        held = named.get(name.removesuffix(NONE_HELD))
        if name not in named and held is not None:
            other = _none_held(cfg, held)
            named |= {} if other is None else {name: other}
        if name not in named:
            raise QPError.expected("starts.csv", f"{name!r}", f"one of {', '.join(named)}")
    return _start(named, choice)


def _models(cfg: DictConfig, own: Start) -> dict[str, Identified]:
    """Identify the models of all structures and horizons by name."""
    N, past = cfg.task.horizon, own.identified.options.layout.past
    models = {}
    for horizon in (N, 2 * N):
        for structure in dict.fromkeys((cfg.constraint.structure, "tied")):
            name = f"{structure} C, N={horizon}" + f", past={past}" * (past > 1)
            models[name] = _model(cfg, own, structure, horizon, past)
    return models


def _windowed(
    cfg: DictConfig, own: Start, models: Mapping[str, Identified]
) -> dict[str, Identified]:
    """Return the ``models`` with a window by name.

    Empty if a window hardly improves the held-out prediction, ``task.past`` is given, or all starts
    have the regulator's cost. Models for which the log's episodes are too short are left out.
    """
    if cfg.task.get("past") is not None or cfg.task.terminal_weight == "riccati":
        return {}
    windowed, first = {}, f"tied C, N={cfg.task.horizon}"
    for name in dict.fromkeys((first, *models)):
        options = models[name].options
        try:
            model = _model(cfg, own, options.structure, options.layout.horizon, WINDOW)
        except QPError:
            continue
        if name == first and not _hides(models[first], model):
            return {}
        windowed[f"{name}, past={WINDOW}"] = model
    return windowed


def _hides(one: Identified, window: Identified) -> bool:
    """Return True if one observation hides what a window shows: in a step or over the horizon."""
    return any(
        1 - _mean_R2(window, k) + TINY < WINDOW_SHARE * (1 - _mean_R2(one, k)) for k in (0, -1)
    )


def _regulated(cfg: DictConfig, own: Start, models: Mapping[str, Identified]) -> dict[str, Start]:
    """Return the starts with the regulator's cost of x_N by name.

    They have the run's horizon, as it hardly matters then.
    """
    layout, N = own.identified.options.layout, cfg.task.horizon
    if cfg.task.hessian == "diagonal" or layout.past > 1:
        return {}
    regulated, tied, ends = {}, models[f"tied C, N={N}"], ""
    if own.cost is not None:
        cost = RewardCost(own.cost.now)
        ends = f"{_cost_name(cost)}{RICCATI}"
        structures = dict.fromkeys((cfg.constraint.structure, "tied"))
        for structure in () if is_regulated(cfg, own) else structures:
            name = f"{structure} C, N={N}"
            start = own._replace(identified=models[name], cost=cost, riccati=True)
            regulated[f"{name}{ends}"] = start
    if (local := _local(cfg, own, tied)) is not None:
        regulated[f"local C, N={N}{ends}"] = local
    return {name: start for name, start in regulated.items() if _solvable(cfg, start)}


def _solvable(cfg: DictConfig, start: Start) -> bool:
    """Return True if the start needs no regulator, or there is one of its model and cost."""
    if not is_regulated(cfg, start):
        return True
    cost = observed_cost(cfg, start.log, start.identified.options.layout, start.cost)
    try:
        regulator_cost(cost, start, cfg.task.gamma)
    except QPError:
        return False
    return True


def _local(cfg: DictConfig, own: Start, tied: Identified) -> Start | None:
    """Return the start of a model and a cost of the steps nearest to where episodes begin.

    None if the ``tied`` model of all steps predicts the next outputs nearly as well there, or the
    log is too short.
    """
    layout, held = tied.options.layout, tied.options.held
    if (near := local_steps(own.log, layout.n_x, held)) is None:
        return None
    steps, still = near
    moving = without(steps, still, layout.n_x)
    try:
        model = identified_model(moving, layout, "tied", [*held, *still], cfg.start.ridge)
    except QPError:
        return None
    others = prediction_errors(as_log(steps, layout.n_x).trajectories, tied.constraints, layout)
    size = torch.cat([part.y for part in own.identified.log.trajectories]).std(0)
    kept = [i for i in range(layout.n_x) if i not in model.options.held]
    local, all_steps = (
        (errors[:, 0, kept] / size[kept]).square().nanmean() for errors in (model.errors, others)
    )
    if not local + TINY < LOCAL_SHARE * all_steps:
        return None
    local = own._replace(identified=model, still=still)
    if own.cost is None:
        return local
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a poor fit is one of many
        cost = fit_rewards(moving, layout)
    return local._replace(cost=cost, riccati=True)


def _model(cfg: DictConfig, own: Start, structure: str, horizon: int, past: int) -> Identified:
    """Identify a model of a start's log; it is the start's if that has the same sizes."""
    options = own.identified.options
    layout = replace(options.layout, horizon=horizon, past=past)
    if (layout, structure) == (options.layout, options.structure):
        return own.identified
    return identified_model(own.log, layout, structure, options.held, cfg.start.ridge)


def _cost_name(cost: RewardCost | None) -> str:
    """Return the end of a start's name."""
    return "" if cost is None else f", cost of {cost.variables}"


def _blended(cfg: DictConfig, start: Start, horizon: int) -> BlendedModel | None:
    """Return the models blended from a start's log; None if they are of no use here.

    They predict held-out steps little better than one model does, or the QP has known signals or a
    past, or the run needs one C for all states.
    """
    layout = start.identified.options.layout
    if layout.past > 1 or layout.n_d or cfg.export is not None:
        return None
    if cfg.constraint.si is not None:
        return None
    models = identify_blended(start.log, horizon, held=start.identified.options.held)
    unexplained = {count: 1 - R2 for count, R2 in models.R2.items()}
    return models if min(unexplained.values()) < BLENDED_SHARE * unexplained[1] else None


def _none_held(cfg: DictConfig, start: Start) -> Start | None:
    """Return the start with a model that predicts the outputs that the log has as unmoved.

    None if there are none, the run names them itself, or the start is a local one or holds an
    action.
    """
    options = start.identified.options
    if start.held is not None or start.still is not None or not options.held:
        return None
    if cfg.task.get("held") is not None:
        return None
    structure, ridge = options.structure, cfg.start.ridge
    model, blended = identified_model(start.log, options.layout, structure, [], ridge), None
    if start.blended is not None:
        blended = identify_blended(start.log, options.layout.horizon)
    other = start._replace(identified=model, blended=blended)
    return other if _solvable(cfg, other) else None


def _R2(start: Start) -> float:
    """Return the share of the outputs' variance that a start predicts; nan if it holds an action.

    It is that over the horizon, in parts of the log that are held out, without outputs held.
    """
    if start.held is not None:
        return math.nan
    if start.blended is not None:
        return max(start.blended.R2.values())
    return _mean_R2(start.identified)


def _mean_R2(model: Identified, k: int = -1) -> float:
    """Return the mean over the outputs, but for those held, of R2 after k + 1 steps, or all."""
    R2, held = model.R2[k], model.options.held
    return R2[[i for i in range(len(R2)) if i not in held]].mean().item()


def _start(named: dict[str, Start], choice: Choice) -> Start:
    """Return the chosen start: that of the best scheme, which holds an action if one is chosen."""
    return named[choice.scheme]._replace(held=named[choice.name].held, choice=choice)


def _policy(cfg: DictConfig, physics: AnyPlant, start: Start) -> Callable[[], Any]:
    """Return a function that makes a start's policy for one closed loop."""
    if (action := start.held) is not None:
        return lambda: lambda s: action.expand(len(s), -1)
    mpc = make_mpc(cfg, start.plant(physics), start)
    return lambda: warm_policy(mpc)


def _loop(cfg: DictConfig, physics: AnyPlant, policy: Any, done: int, count: int) -> ClosedLoop:
    """Run a policy's next ``count - done`` episodes."""
    options = {"steps": cfg.task.eval_steps, "gamma": cfg.task.gamma}
    options |= {"starts": count - done, "seed": APART + cfg.seed + done}
    return find_task(cfg.task).closed_loop(policy, physics, **options)


def _is_less(differences: Tensor) -> bool:
    """Return True if the mean of ``differences`` is negative, by a one-sided t-test."""
    mean, t = differences.mean().item(), float(stdtrit(len(differences) - 1, CONFIDENCE))
    return mean == -math.inf or mean + t * _error(differences) < 0


def _error(costs: Tensor) -> float:
    """Return the standard error of the mean."""
    return (costs.std() / math.sqrt(len(costs))).item()
