"""What a run's configuration may hold: each key, and a sentence for what it must be."""

from __future__ import annotations

import difflib
import itertools
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from torch_qpmpc.envs.point_mass import NOISE_STD
from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.loggers import LOGGERS
from torch_qpmpc.mpc.projections import STEPS, check_step
from torch_qpmpc.mpc.validation import CONSTRAINTS, COST, HESSIANS, STRUCTURES
from torch_qpmpc.qp.solvers import backend

#: The noises that each task has.
NOISES = {
    "point_mass": tuple(NOISE_STD),
    "gros_zanon": ("uniform",),
    "gymnasium": ("none",),
}

Rule = tuple[Callable[[Any], bool], str]


def _number(x: Any) -> bool:
    return isinstance(x, int | float) and not isinstance(x, bool)


def _whole(least: int) -> Rule:
    return (
        lambda x: isinstance(x, int) and not isinstance(x, bool) and x >= least,
        f"a whole number >= {least}",
    )


def _one_of(*names: str) -> Rule:
    return lambda x: x in names, f"one of {', '.join(names)}"


def _subset(names: tuple[str, ...]) -> Rule:
    return (
        lambda x: isinstance(x, list) and all(name in names for name in x),
        f"a list of {', '.join(names)}",
    )


POSITIVE: Rule = lambda x: _number(x) and 0 < x < math.inf, "a finite number > 0"
NON_NEGATIVE: Rule = lambda x: _number(x) and 0 <= x < math.inf, "a finite number >= 0"
WEIGHT: Rule = (
    lambda x: _number(x) and x >= 0,
    "a number >= 0; for hard rows .inf in a file, inf on the command line",
)
FRACTION: Rule = lambda x: _number(x) and 0 < x <= 1, "a number in (0, 1]"
FLAG: Rule = lambda x: isinstance(x, bool), "true or false"
NAME: Rule = lambda x: isinstance(x, str), "a name"
MATRIX: Rule = (
    lambda x: (
        isinstance(x, list)
        and all(isinstance(row, list) and len(row) == len(x[0]) for row in x)
        and all(_number(entry) and math.isfinite(entry) for row in x for entry in row)
    ),
    "a list of equally long rows of finite numbers",
)
#: null until the user gives one: tasks.py then says what is missing.
MODEL: Rule = lambda x: x is None or MATRIX[0](x), MATRIX[1]

RULES: dict[str, Rule] = {
    "seed": (lambda x: _whole(0)[0](x) and x < 2**63, "a whole number >= 0 and < 2^63"),
    "solver": NAME,
    "warm_start": FLAG,
    "threads": _whole(1),
    "updates": _whole(1),
    "batch_size": _whole(1),
    "num_envs": _whole(1),
    "steps_per_update": _whole(1),
    "warmup_steps": _whole(0),
    "replay": FLAG,
    "replay_capacity": _whole(1),
    "exploration_std": NON_NEGATIVE,
    "td_error_clip": (lambda x: x is None or POSITIVE[0](x), "a finite number > 0, or null"),
    "delay_value": FLAG,
    "target_rate": FRACTION,
    "step": _one_of(*STEPS),
    "penalty_step": _one_of("proximal", "subgradient"),
    "release": (lambda x: x is None or _whole(1)[0](x), "a whole number >= 1, or null"),
    "resume": (lambda x: x is None or NAME[0](x), "a path, or null"),
    "ablation": (lambda x: x is None or NAME[0](x), "a name, or null"),
    "figures": FLAG,
    "logger": _one_of(*LOGGERS),
    "eval_interval": _whole(1),
    "log_interval": _whole(1),
    "algo.name": _one_of("qlearning", "ddpg", "td3"),
    "algo.actor": _one_of("qp", "mlp"),
    "algo.critic": _one_of("qp", "mlp"),
    "algo.actor_rate": POSITIVE,
    "algo.lr_network": POSITIVE,
    "algo.width": _whole(1),
    "algo.policy_delay": _whole(1),
    "algo.policy_noise": NON_NEGATIVE,
    "algo.noise_clip": NON_NEGATIVE,
    "collector.name": _one_of("single", "multi", "ray"),
    "collector.workers": _whole(1),
    "collector.sync": FLAG,
    "collector.num_cpus": POSITIVE,
    "task.name": _one_of("point_mass", "gros_zanon", "gymnasium"),
    "task.id": (
        lambda x: NAME[0](x) and x != "???",
        "the id of a Gymnasium environment, as in task.id=Pendulum-v1",
    ),
    "task.A": MODEL,
    "task.B": MODEL,
    "task.stage_weight": MODEL,
    "task.horizon": _whole(1),
    "task.gamma": FRACTION,
    "task.episode_steps": _whole(1),
    "task.eval_steps": _whole(1),
    "task.hessian": _one_of(*HESSIANS),
    "task.terminal_weight": _one_of("identity", "riccati"),
    "task.learn_cost": _subset(COST),
    "task.state_slack": WEIGHT,
    "task.action_slack": WEIGHT,
    "task.discount_slack": FLAG,
    "noise.name": _one_of(*itertools.chain(*NOISES.values())),
    "noise.std": (
        lambda x: x is None or NON_NEGATIVE[0](x),
        "a finite number >= 0, or null for the task's own",
    ),
    "constraint.name": NAME,
    "constraint.structure": _one_of(*STRUCTURES),
    "constraint.learn": _subset(CONSTRAINTS),
    "constraint.deviation.c_1": NON_NEGATIVE,
    "constraint.deviation.c_2": NON_NEGATIVE,
    "constraint.deviation.c_3": NON_NEGATIVE,
    "constraint.deviation.growth": NON_NEGATIVE,
    "constraint.si.beta": NON_NEGATIVE,
    "constraint.si.windows": _whole(1),
    "constraint.si.normalised": FLAG,
    "optimizer.name": _one_of("adam", "sgd", "gauss_newton"),
    "optimizer.lr_cost": NON_NEGATIVE,
    "optimizer.lr_constraints": NON_NEGATIVE,
    "optimizer.betas": (
        lambda x: isinstance(x, list) and len(x) == 2 and all(_number(b) and 0 <= b < 1 for b in x),
        "two numbers in [0, 1)",
    ),
    "optimizer.final_fraction": FRACTION,
    "optimizer.lr": FRACTION,
    "optimizer.memory": _whole(0),
    "optimizer.scale_cost": POSITIVE,
    "optimizer.scale_constraints": POSITIVE,
    "optimizer.damping": POSITIVE,
    "optimizer.trust_region": FLAG,
}
_RATES = {"optimizer.lr_cost", "optimizer.lr_constraints"}
_METRIC = {"optimizer.scale_cost", "optimizer.scale_constraints"}
_NETWORKS = {f"algo.{name}" for name in ("actor", "critic", "actor_rate", "lr_network", "width")}
_WORKERS = {"collector.workers", "collector.sync"}
#: The keys that each choice has beside those of all choices.
OF_CHOICE: dict[str, dict[str, set[str]]] = {
    "optimizer": {
        "adam": _RATES | {"optimizer.betas"},
        "sgd": _RATES,
        "gauss_newton": _METRIC
        | {f"optimizer.{name}" for name in ("lr", "damping", "memory", "trust_region")},
    },
    "algo": {
        "ddpg": _NETWORKS,
        "td3": _NETWORKS
        | {f"algo.{name}" for name in ("policy_delay", "policy_noise", "noise_clip")},
    },
    "collector": {"multi": _WORKERS, "ray": _WORKERS | {"collector.num_cpus"}},
    "task": {"gymnasium": {f"task.{name}" for name in ("id", "A", "B", "stage_weight")}},
}
#: A penalty that is null is off.
OPTIONAL = ("constraint.deviation", "constraint.si")


def _second_order(cfg: DictConfig) -> bool:
    return cfg.optimizer.name == "gauss_newton"


#: What a key must be in view of others: the key, when it is not that, what it must be, and why or
#: what to do.
CONFLICTS: tuple[tuple[str, Callable[[DictConfig], bool], str, str], ...] = (
    (
        "constraint.learn",
        lambda cfg: (
            (cfg.constraint.deviation is not None or cfg.constraint.si is not None)
            and "C" not in cfg.constraint.learn
        ),
        "C among them, as a penalty on C is on",
        "Set the penalty to null, or learn C.",
    ),
    (
        "task.learn_cost",
        lambda cfg: not cfg.constraint.learn and not cfg.task.learn_cost,
        "something to learn, here or in constraint.learn",
        "",
    ),
    (
        "constraint.learn",
        lambda cfg: cfg.constraint.structure != "free" and "G" in cfg.constraint.learn,
        "no G",
        "No task has mixed constraints to learn.",
    ),
    *(
        (
            key,
            lambda cfg, key=key: (
                cfg.constraint.si is not None and OmegaConf.select(cfg, key) < cfg.task.horizon
            ),
            "at least task.horizon = {cfg.task.horizon}",
            "So long are the windows of constraint.si.",
        )
        for key in ("task.episode_steps", "warmup_steps")
    ),
    (
        "replay",
        lambda cfg: cfg.constraint.si is not None and not cfg.replay,
        "true",
        "The windows of constraint.si come from there.",
    ),
    (
        "penalty_step",
        lambda cfg: (
            _second_order(cfg)
            and cfg.constraint.deviation is not None
            and cfg.penalty_step != "proximal"
        ),
        "proximal",
        "gauss_newton has no subgradients.",
    ),
    (
        "constraint.si.normalised",
        lambda cfg: (
            _second_order(cfg) and cfg.constraint.si is not None and cfg.constraint.si.normalised
        ),
        "False",
        "gauss_newton takes the penalty as a quadratic in C, which this is not.",
    ),
    (
        "constraint.structure",
        lambda cfg: (
            cfg.constraint.structure != "free"
            and (
                cfg.constraint.deviation is not None
                or (cfg.constraint.si is not None and _second_order(cfg))
            )
        ),
        "free",
        "A tied C has nothing off its band to penalise, and gauss_newton's SI penalty no free C.",
    ),
    (
        "release",
        lambda cfg: cfg.release is not None and cfg.constraint.structure == "free",
        "null",
        "Nothing is tied: choose constraint=mpc.",
    ),
    (
        "task.terminal_weight",
        lambda cfg: cfg.task.terminal_weight == "riccati" and cfg.task.hessian == "diagonal",
        "identity",
        "With task.hessian=block it can be.",
    ),
    (
        "noise.name",
        lambda cfg: cfg.noise.name not in NOISES[cfg.task.name],
        "a noise that {cfg.task.name} has",
        "The point mass has gaussian and brownian, gros_zanon uniform, the others none.",
    ),
    (
        "noise.std",
        lambda cfg: cfg.task.name != "point_mass" and cfg.noise.std is not None,
        "null",
        "The noise of {cfg.task.name} cannot be changed.",
    ),
    (
        "optimizer.name",
        lambda cfg: cfg.algo.name != "qlearning" and _second_order(cfg),
        "adam or sgd",
        "{cfg.algo.name} has no second order: say optimizer=adam.",
    ),
    (
        "warm_start",
        lambda cfg: cfg.algo.name != "qlearning" and cfg.warm_start,
        "false",
        "{cfg.algo.name} solves at other actions than it replays.",
    ),
    (
        "replay",
        lambda cfg: cfg.algo.name != "qlearning" and not cfg.replay,
        "true",
        "{cfg.algo.name} learns from a replay.",
    ),
    (
        "algo.actor",
        lambda cfg: (
            cfg.algo.get("actor") == "mlp"
            and (cfg.constraint.deviation is not None or cfg.constraint.si is not None)
        ),
        "qp",
        "The penalties are on a QP's C: choose constraint=free.",
    ),
    (
        "step",
        lambda cfg: cfg.algo.name != "qlearning" and cfg.step != "cholesky",
        "cholesky",
        "The critics of {cfg.algo.name} know no other.",
    ),
    (
        "release",
        lambda cfg: cfg.release is not None and cfg.algo.name != "qlearning",
        "null",
        "{cfg.algo.name} has more parameters than the QP's.",
    ),
    (
        "release",
        lambda cfg: cfg.release is not None and cfg.collector.name != "single",
        "null",
        "The workers of collector={cfg.collector.name} would keep the old parameters.",
    ),
    (
        "num_envs",
        lambda cfg: cfg.collector.name != "single" and bool(cfg.num_envs % cfg.collector.workers),
        "a multiple of collector.workers = {cfg.collector.workers}",
        "",
    ),
    (
        "steps_per_update",
        lambda cfg: (
            cfg.collector.name != "single"
            and not cfg.collector.sync
            and cfg.constraint.si is not None
            and cfg.steps_per_update < cfg.task.horizon
        ),
        "at least task.horizon = {cfg.task.horizon}",
        "The windows of constraint.si lie within one batch of a worker.",
    ),
    (
        "replay_capacity",
        lambda cfg: bool(cfg.replay_capacity % cfg.num_envs),
        "a multiple of num_envs = {cfg.num_envs}",
        "",
    ),
)


def check_config(cfg: DictConfig) -> None:
    """Raise `QPError` on the first unknown or missing key or impossible value of ``cfg``."""
    given = settings(cfg)
    off = [name for name in OPTIONAL if name in given and given.pop(name) is None]
    for key, value in given.items():
        if key not in RULES:
            close = difflib.get_close_matches(key, RULES, n=1)
            hint = f"Did you mean {close[0]}?" if close else "See configs/config.yaml."
            raise QPError.expected(key, "an unknown key", "a key of configs/", hint)
        accepts, expected = RULES[key]
        if not accepts(value):
            raise QPError.expected(key, repr(value), expected)
    special, own = set(), set()
    for group, choices in OF_CHOICE.items():
        special |= set().union(*choices.values())
        own |= choices.get(given.get(f"{group}.name", ""), set())
    for key in RULES:
        if key in special - own:
            continue
        if key not in given and not any(key.startswith(f"{name}.") for name in off):
            raise QPError.expected(key, "nothing", RULES[key][1])
    backend(cfg.solver)
    check_step(cfg.step)
    for key, wrong, expected, remedy in CONFLICTS:
        if wrong(cfg):
            expected, remedy = expected.format(cfg=cfg), remedy.format(cfg=cfg)
            raise QPError.expected(key, repr(given.get(key)), expected, remedy)


def load_config(file: Path) -> DictConfig:
    """The configuration that a run has saved."""
    cfg = OmegaConf.load(file)
    assert isinstance(cfg, DictConfig)
    return cfg


def settings(cfg: DictConfig) -> dict[str, Any]:
    """Every setting by its dotted key, as on the command line."""
    return flatten(OmegaConf.to_container(cfg, resolve=True))


def differences(then: Mapping[str, Any], now: Mapping[str, Any]) -> tuple[str, str] | None:
    """The `settings` in which two differ, as ``key=value`` of either, for a message."""
    changed = [key for key in {**then, **now} if then.get(key) != now.get(key)]
    if not changed:
        return None
    before, after = (", ".join(f"{key}={of.get(key)}" for key in changed) for of in (then, now))
    return before, after


def flatten(tree: Any, prefix: str = "") -> dict[str, Any]:
    """Nested mappings as one, with dotted keys."""
    if not isinstance(tree, Mapping):
        return {prefix: tree}
    pairs = (flatten(value, f"{prefix}.{key}".lstrip(".")) for key, value in tree.items())
    return {key: value for pair in pairs for key, value in pair.items()}
