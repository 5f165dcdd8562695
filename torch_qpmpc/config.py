"""What a run's configuration may hold: each key, and a sentence for what it must be."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Mapping
from typing import Any

from omegaconf import DictConfig, OmegaConf

from torch_qpmpc.arguments import CONSTRAINTS, COST, HESSIANS, STRUCTURES
from torch_qpmpc.envs.point_mass import NOISE_STD
from torch_qpmpc.errors import QPError
from torch_qpmpc.solvers import backend

#: The noise of Gros and Zanon's system, which has no other.
UNIFORM = "uniform"

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
    "penalty_step": _one_of("proximal", "subgradient"),
    "release": (lambda x: x is None or _whole(1)[0](x), "a whole number >= 1, or null"),
    "figures": FLAG,
    "eval_interval": _whole(1),
    "log_interval": _whole(1),
    "task.name": _one_of("point_mass", "gros_zanon"),
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
    "noise.name": _one_of(*NOISE_STD, UNIFORM),
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
#: The keys that each optimiser has beside its name and final_fraction.
OF_OPTIMIZER = {
    "adam": _RATES | {"optimizer.betas"},
    "sgd": _RATES,
    "gauss_newton": _METRIC
    | {f"optimizer.{name}" for name in ("lr", "damping", "memory", "trust_region")},
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
        lambda cfg: (cfg.noise.name == UNIFORM) != (cfg.task.name == "gros_zanon"),
        "the noise of {cfg.task.name}",
        f"{UNIFORM} is that of gros_zanon, the others are the point mass's.",
    ),
    (
        "noise.std",
        lambda cfg: cfg.noise.name == UNIFORM and cfg.noise.std is not None,
        "null",
        "The noise of gros_zanon cannot be changed.",
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
    given = flatten(OmegaConf.to_container(cfg, resolve=True))
    off = [name for name in OPTIONAL if name in given and given.pop(name) is None]
    for key, value in given.items():
        if key not in RULES:
            close = difflib.get_close_matches(key, RULES, n=1)
            hint = f"Did you mean {close[0]}?" if close else "See configs/config.yaml."
            raise QPError.expected(key, "an unknown key", "a key of configs/", hint)
        accepts, expected = RULES[key]
        if not accepts(value):
            raise QPError.expected(key, repr(value), expected)
    special = set().union(*OF_OPTIMIZER.values())
    own = OF_OPTIMIZER.get(given.get("optimizer.name", ""), set())
    for key in RULES:
        if key in special - own:
            continue
        if key not in given and not any(key.startswith(f"{name}.") for name in off):
            raise QPError.expected(key, "nothing", RULES[key][1])
    backend(cfg.solver)
    for key, wrong, expected, remedy in CONFLICTS:
        if wrong(cfg):
            expected = expected.format(cfg=cfg)
            raise QPError.expected(key, repr(given.get(key)), expected, remedy)


def flatten(tree: Any, prefix: str = "") -> dict[str, Any]:
    """Nested mappings as one, with dotted keys."""
    if not isinstance(tree, Mapping):
        return {prefix: tree}
    pairs = (flatten(value, f"{prefix}.{key}".lstrip(".")) for key, value in tree.items())
    return {key: value for pair in pairs for key, value in pair.items()}
