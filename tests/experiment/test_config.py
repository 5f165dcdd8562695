"""Every key has a rule and is read, every rule has a key, and each bad value has a message."""

from __future__ import annotations

import itertools
import math
import re
import sys
from typing import Any

import pytest
from omegaconf import DictConfig, OmegaConf

import train
from tests.runs import CONFIGS, SMALL, choices, make_config
from torch_qpmpc import QPError
from torch_qpmpc.experiment.config import check_config, flatten, settings
from torch_qpmpc.experiment.config.messages import keys
from torch_qpmpc.experiment.run_folder import RunFolder
from torch_qpmpc.experiment.run_state import snapshot
from torch_qpmpc.experiment.tasks import TASKS

GROUPS = ("constraint", "noise", "optimizer", "task")
#: Penalties may be null.
OPTIONAL = ("constraint.deviation", "constraint.si")
#: Keys that built-in tasks lack.
NOT_NEEDED = ("task.file", "task.kwargs", "task.start_episodes", "task.held", "task.past")
#: The allowed values of each key, without keys of users' tasks.
KEYS = keys()


def keys_of_the_files() -> set[str]:
    """List the dotted keys of every file in configs/, except Hydra's."""
    keys = set()
    for path in set(CONFIGS.rglob("*.yaml")) - set((CONFIGS / "hydra").rglob("*.yaml")):
        tree = OmegaConf.to_container(OmegaConf.load(path), resolve=False)
        assert isinstance(tree, dict)
        whole = "# @package _global_" in path.read_text(encoding="utf-8")
        group = "" if whole or path.parent == CONFIGS else path.parent.name
        keys |= set(
            flatten({k: v for k, v in tree.items() if k not in ("defaults", "hydra")}, group)
        )
    return keys


def test_each_key_of_the_files_is_one_of_the_models():
    assert keys_of_the_files() - set(OPTIONAL) == set(KEYS)
    assert all(KEYS.values()), "each says what its value must be"


#: The shortest run, in which each part is called once.
SHORT = (*SMALL, "updates=2", "task.eval_steps=2", "task.episode_steps=4")
DATA = ("start=data", "task=pendulum", "start.transitions=40")


class Recorder:
    """A configuration that records which leaves are read."""

    def __init__(self, cfg: DictConfig, seen: set[str], prefix: str = "") -> None:
        self.__dict__.update(_cfg=cfg, _seen=seen, _prefix=prefix)

    def __getattr__(self, name: str) -> Any:
        key, value = f"{self._prefix}{name}", self._cfg[name]
        if isinstance(value, DictConfig) and key not in KEYS:
            return Recorder(value, self._seen, f"{key}.")
        self._seen.add(key)
        return value

    __getitem__ = __getattr__

    def keys(self) -> list[Any]:
        return list(self._cfg)

    def get(self, name: str) -> Any:
        return self[name] if name in self._cfg else None

    def __contains__(self, name: str) -> bool:
        return name in self._cfg


def test_each_key_is_read(tmp_path, monkeypatch):
    """A run reads the key, or the run folder's name has it."""
    seen: set[str] = set()
    # These two read all keys at once, which proves nothing.
    monkeypatch.setattr(train, "check_config", lambda _: None)
    for name, overrides in {
        "second": ("gate=true", "constraint=combined", "optimizer=gauss_newton", "batch_size=8"),
        "data": (
            *DATA,
            "constraint=free",
            "+task.start_episodes=2",
            "+task.held=null",
            "+task.past=null",
        ),
    }.items():
        cfg = make_config(*SHORT, *overrides)
        monkeypatch.setattr(
            train, "RunFolder", lambda folder, _, after, cfg=cfg: RunFolder(folder, cfg, after)
        )
        monkeypatch.setattr(train, "snapshot", lambda _, *parts, cfg=cfg: snapshot(cfg, *parts))
        recorder: Any = Recorder(cfg, seen)
        train.train(recorder, str(tmp_path / name))
    text = (CONFIGS / "config.yaml").read_text(encoding="utf-8").partition("hydra:")[2]
    seen |= set(re.findall(r"\$\{(?!hydra\.)([\w.]+)\}", text))
    seen |= {"logger"}  # RunFolder reads it from the configuration itself
    assert seen - set(OPTIONAL) == set(KEYS)


#: The noises of each task.
NOISES = {
    "point_mass": {"gaussian", "brownian"},
    "gros_zanon": {"uniform"},
    "gymnasium": {"none"},
    "pendulum": {"none"},
}


def faults(constraint: str, noise: str, optimizer: str, task: str) -> list[str]:
    """List the conflicting keys of a choice of groups."""
    return [] if noise in NOISES[task] else ["noise.name"]


def chosen(constraint: str, noise: str, optimizer: str, task: str) -> DictConfig:
    groups = dict(zip(GROUPS, (constraint, noise, optimizer, task), strict=True))
    more = ["task.id=Pendulum-v1"] if task == "gymnasium" else []
    return make_config(*(f"{key}={x}" for key, x in groups.items()), *more, "warmup_steps=32")


#: Pairs of choices with rules of their own: of a constraint and an optimiser, a noise and a task.
LEARNERS = [*itertools.product(choices("constraint"), choices("optimizer"))]
PLANTS = [*itertools.product(choices("noise"), choices("task"))]


def joined(learner: tuple[str, str], plant: tuple[str, str]) -> tuple[str, ...]:
    (constraint, optimizer), (noise, task) = learner, plant
    return constraint, noise, optimizer, task


def compatible() -> list[tuple[str, ...]]:
    """Join each compatible pair of the one kind with the next of the other."""
    learners = [x for x in LEARNERS if not faults(*joined(x, ("none", "pendulum")))]
    plants = [x for x in PLANTS if not faults(*joined(("free", "sgd"), x))]
    count = max(len(learners), len(plants))
    pairs = zip(itertools.cycle(learners), itertools.cycle(plants), strict=False)
    return [joined(*pair) for pair in itertools.islice(pairs, count)]


def test_each_task_has_its_noises():
    own = choices("task")  # and not those that other tests have registered
    of_tasks = {name: {*task.noises} for name, task in TASKS.items() if name in own}
    assert of_tasks | {"pendulum": of_tasks["gymnasium"]} == NOISES


@pytest.mark.parametrize("names", compatible(), ids="-".join)
def test_each_choice_of_groups_is_accepted(names):
    check_config(chosen(*names))


def choices_with(key: str) -> list[str]:
    """Return the choices of groups that have the key."""
    if key in settings(make_config("optimizer=gauss_newton")):
        return ["optimizer=gauss_newton"]
    having = {"task": "task=pendulum", "start": "start=data"}
    return ["optimizer=adam", *(c for group, c in having.items() if key.startswith(f"{group}."))]


WHOLE = [0, -1, 1.5, True, "three", None, math.nan]
REAL = [-1.0, math.nan, math.inf, True, "much", None]
FRACTION = [0, -0.5, 1.1, math.nan, False, "half", None]
FLAG = [0, 1, "yes", None]
NAME = [3, True, None]
MATRIX = [1.0, [1.0], [[1.0], [1.0, 2.0]], [["a"]], [[math.nan]], [[True]], "???"]
BAD: dict[str, list[Any]] = {
    "seed": [*WHOLE[1:], 2**63],
    "solver": NAME,
    "replay": FLAG,
    "release": [*WHOLE[:-2], math.nan],
    "exploration_std": REAL,
    "td_error_clip": [0, *REAL[:-1]],
    "weighted": FLAG,
    "step": ["newton", *NAME],
    "ablation": [3, True],
    "eval_seed": WHOLE[1:-2],
    "logger": ["visdom", *NAME],
    "export": ["python", 3, True],
    "prove": [-0.1, "box", math.nan],
    "figures": ["each", *FLAG],
    "gate": ["acts", *FLAG],
    "gate_bound": [0, *REAL[:-1]],
    "rivals": ["tightened", 3, None, [1]],
    "resume": [3, True],
    "start.name": ["policy", *NAME],
    "start.file": [3, True],
    "start.transitions": WHOLE,
    "start.levels": ["normal", *NAME],
    "start.hold": [0.5, *REAL],
    "start.ridge": REAL[:-1],
    "task.name": ["pendulum", *NAME],
    "task.id": ["???", *NAME],
    "task.kwargs": ["g=1", 3, [1.0], {1: 2}],
    "task.file": [3, True],
    "task.A": MATRIX,
    "task.B": MATRIX,
    "task.stage_weight": MATRIX,
    "task.gamma": FRACTION,
    "task.hessian": ["dense", *NAME],
    "task.terminal_weight": ["lqr", *NAME],
    "constraint.structure": ["banded", *NAME],
    "optimizer.lr": FRACTION,
    "task.learn_cost": ["H", ["H", "C"], ["h"], [["H"]], None, 3],
    "task.state_slack": [*REAL[:2], *REAL[3:]],
    "task.action_slack": [*REAL[:2], *REAL[3:]],
    "task.discount_slack": FLAG,
    "noise.name": NAME,
    "noise.std": REAL[:-1],
    "constraint.name": NAME,
    "constraint.learn": ["C", ["C", "H"], ["c"], [{"C": 1}], None, 3],
    "optimizer.name": ["rmsprop", *NAME],
    "optimizer.betas": [0.9, [0.9], [0.9, 1.0], [-0.1, 0.9], ["a", "b"], [0.9] * 3, None],
    "optimizer.final_fraction": FRACTION,
}
for _name in ("threads", "updates", "batch_size", "num_envs", "steps_per_update"):
    BAD[_name] = WHOLE
BAD["warmup_steps"] = WHOLE[1:]
BAD["gate_interval"] = BAD["task.past"] = [value for value in WHOLE if value is not None]
for _name in ("replay_capacity", "eval_interval", "log_interval", "constraint.si.windows"):
    BAD[_name] = WHOLE
for _name in ("task.horizon", "task.episode_steps", "task.eval_steps"):
    BAD[_name] = WHOLE
for _name in ("scale_constraints", "damping"):
    BAD[f"optimizer.{_name}"] = [0, *REAL]
BAD["task.observation_bounds"] = FLAG
BAD["task.held"] = [[-1], [0.5], ["a"], 3]
BAD["task.start_episodes"] = WHOLE[1:]
for _name in ("lr_cost", "lr_constraints"):
    BAD[f"optimizer.{_name}"] = REAL
for _name in ("deviation.c_1", "deviation.c_2", "deviation.c_3", "si.beta"):
    BAD[f"constraint.{_name}"] = REAL


@pytest.mark.parametrize("key", KEYS)
def test_impossible_values_are_rejected_by_name(key):
    assert key in BAD, "a new key: add what it rejects"
    cfg = make_config("constraint=combined", *choices_with(key))
    for value in BAD[key]:
        OmegaConf.update(cfg, key, value, merge=False, force_add=True)
        sentence = f"{key}: got {value!r}, expected {keys()[key]}."
        with pytest.raises(QPError, match=f"^{re.escape(sentence)}"):
            check_config(cfg)


def test_rivals_are_those_of_the_task():
    check_config(make_config("rivals=[tightened,identification]"))
    known = "tightened; identification. They are the rivals of task point_mass"
    with pytest.raises(QPError, match=rf"rivals: got \['nobody'\], expected .* these: {known}"):
        check_config(make_config("rivals=[nobody]"))
    with pytest.raises(QPError, match=r"rivals: got \['tightened'\], .* these: zero action; ide"):
        check_config(make_config("task=pendulum", "rivals=[tightened]"))


def test_the_edges_are_accepted():
    cfg = make_config(
        "constraint=combined",
        "optimizer=adam",
        "seed=0",
        "updates=1",
        "td_error_clip=null",
        "exploration_std=0",
        "task.gamma=1",
        "task.state_slack=inf",
        "task.learn_cost=[]",
        "noise.std=0",
        "constraint.deviation.c_2=0",
        "constraint.si.beta=0",
        "optimizer.lr_cost=0",
        "optimizer.betas=[0,0]",
    )
    check_config(cfg)


@pytest.mark.parametrize(
    ("key", "remedy"),
    [
        ("batchsize", "Did you mean batch_size?"),
        ("taks", "Did you mean task?"),
        ("task.horizn", "Did you mean task.horizon?"),
        ("constraint.deviaton.c_1", "Did you mean constraint.deviation.c_1?"),
        ("zzz", "See configs/config.yaml."),
    ],
)
def test_unknown_keys(key, remedy):
    cfg = make_config()
    OmegaConf.update(cfg, key, 3, force_add=True)
    sentence = f"{key}: got an unknown key, expected a key of configs/. {remedy}"
    with pytest.raises(QPError, match=re.escape(sentence)):
        check_config(cfg)


NEEDED = [key for key in KEYS if key not in NOT_NEEDED]


@pytest.mark.parametrize("key", [*NEEDED, *OPTIONAL, *GROUPS, "start"])
def test_missing_keys(key):
    cfg = make_config("constraint=combined", *choices_with(key))
    owner, _, leaf = key.rpartition(".")
    OmegaConf.set_struct(cfg, False)
    del (OmegaConf.select(cfg, owner) if owner else cfg)[leaf]
    with pytest.raises(QPError, match=rf"^{re.escape(key)}(\.\w+)*: got nothing, expected \w+"):
        check_config(cfg)


def test_betas_are_adams():
    cfg = make_config("optimizer=sgd")
    assert "betas" not in cfg.optimizer
    check_config(cfg)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            ["+optimizer.damping=1"],
            "optimizer.damping: got a key of another choice, expected a key",
        ),
        (
            ["+task.id=Pendulum-v1"],
            "task.id: got a key of another choice, expected a key of this t",
        ),
        (["+optimizer.lr_cots=1"], "optimizer.lr_cots: got an unknown key, .* optimizer.lr_cost?"),
        (["optimizer.name=rmsprop"], "optimizer.name: got 'rmsprop', expected one of adam, sgd, "),
        (["task.name=unknown"], "task.name: got 'unknown', expected one of .*point_mass"),
        (["constraint.si=3"], "constraint.si: got 3, expected its keys, as in configs/."),
    ],
)
def test_keys_of_groups(overrides, message):
    with pytest.raises(QPError, match=f"^{message}"):
        check_config(make_config("optimizer=adam", *overrides))


@pytest.mark.parametrize("group", GROUPS)
def test_a_group_has_keys(group):
    cfg = make_config()
    OmegaConf.update(cfg, group, 3, merge=False)
    with pytest.raises(QPError, match=f"^{group}: got 3, expected its keys, as in configs/"):
        check_config(cfg)


def test_a_misspelt_key_is_named_before_the_missing_one_and_that_before_a_conflict():
    cfg = make_config("constraint=fixed", "task.learn_cost=[]")
    OmegaConf.set_struct(cfg, False)
    for message in (
        r"^task.learn_cost: got \[\]",
        "^updates: got nothing",
        "^update: got an unknown",
    ):
        with pytest.raises(QPError, match=message):
            check_config(cfg)
        if "updates" in cfg:
            del cfg["updates"]
        else:
            cfg["update"] = 3


def test_solver_must_be_known():
    with pytest.raises(QPError, match="solver: got 'cplex'"):
        check_config(make_config("solver=cplex"))


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["constraint.learn=[b]"], r"constraint.learn: got \['b'\], expected a list with C"),
        (
            ["constraint=deviation", "constraint.learn=[]"],
            r"constraint.learn: got \[\], expected a list with C.* or learn C",
        ),
        (
            ["constraint=si", "task.episode_steps=5"],
            r"task.episode_steps: got 5, expected at least task.horizon = 10",
        ),
        (
            ["constraint=fixed", "task.learn_cost=[]"],
            r"task.learn_cost: got \[\], expected something to learn, here or in constraint.learn",
        ),
        (
            ["constraint=si", "replay=false"],
            "replay: got False, expected true. constraint.si",
        ),
        (
            ["constraint=deviation", "constraint.structure=tied"],
            "constraint.structure: got 'tied', expected free. A tied C has nothing off its band",
        ),
        (
            ["constraint=si", "constraint.structure=varying"],
            "constraint.structure: got 'varying', expected free. gauss_newton needs a free C",
        ),
        (
            ["constraint=mpc", "constraint.learn=[C,G]"],
            r"constraint.learn: got \['C', 'G'\], expected no G. No task has mixed",
        ),
        (["release=10"], "release: got 10, expected null. Nothing is tied: choose constraint=mpc"),
        (
            ["task.terminal_weight=riccati"],
            "task.terminal_weight: got 'riccati', expected default or identity. The Riccati weig",
        ),
        (
            ["noise=uniform"],
            "noise.name: got 'uniform', expected a noise of task point_mass: gauss",
        ),
        (["noise.name=pink"], "noise.name: got 'pink', expected a noise of .* gaussian, brownian"),
        (
            ["task=gros_zanon", "noise=gaussian"],
            "noise.name: got 'gaussian', expected a noise of task gros_zanon: uniform.",
        ),
        (
            ["task=gros_zanon", "noise.std=0.1"],
            "noise.std: got 0.1, expected null. The noise of gros_zanon cannot be changed",
        ),
        (["num_envs=7"], r"replay_capacity: got 16000, expected a multiple of num_envs = 7"),
    ],
)
def test_values_that_do_not_fit_each_other(overrides, message):
    with pytest.raises(QPError, match=message):
        check_config(make_config(*overrides))


def test_short_episodes_do_without_the_si_penalty():
    check_config(make_config("constraint=free", "task.episode_steps=5", "warmup_steps=1"))


def test_a_gymnasium_task_has_episodes_of_the_environments_length():
    check_config(make_config("task=gymnasium", "task.id=Pendulum-v1", "constraint=si"))
    message = "task.eval_steps: got 0, expected a whole number >= 1"
    with pytest.raises(QPError, match=message):
        check_config(make_config("task=gymnasium", "task.id=Pendulum-v1", "task.eval_steps=0"))


def test_flatten():
    tree = {"a": 1, "b": {"c": [1, 2], "d": {"e": None}}}
    assert flatten(tree) == {"a": 1, "b.c": [1, 2], "b.d.e": None}
    assert flatten({"e": None}, "b.d") == {"b.d.e": None}


def test_the_step_rule_needs_its_solver(monkeypatch):
    monkeypatch.setitem(sys.modules, "clarabel", None)
    with pytest.raises(QPError, match=r"step: got 'sdp' without Clarabel, .* pip install"):
        check_config(make_config("step=sdp"))


CASE_3 = ["constraint=deviation"]
#: Settings of each ablation that differ from its optimiser's defaults, beside its name.
ABLATIONS: dict[str, tuple[list[str], dict[str, Any]]] = {
    "reference": (CASE_3, {}),
    "adam_proximal": ([*CASE_3, "optimizer=adam"], {}),
    "sgd": ([*CASE_3, "optimizer=sgd"], {"step": "projection"}),
    "markov": (CASE_3, {"constraint.deviation.c_3": 1.0}),
    "si_raw": (["optimizer=adam", "constraint=si"], {}),
    "horizon_5": (CASE_3, {"task.horizon": 5}),
    "horizon_20": (CASE_3, {"task.horizon": 20, "warmup_steps": 20}),
    "projection": (CASE_3, {"step": "projection"}),
}


@pytest.mark.parametrize("name", choices("ablation"))
def test_an_ablation_differs_in_its_named_settings(name):
    base, expected = ABLATIONS[name]
    found = make_config(f"+ablation={name}")
    check_config(found)
    found, usual = (flatten(OmegaConf.to_container(x)) for x in (found, make_config(*base)))
    differing = {key: value for key, value in found.items() if value != usual[key]}
    assert differing == {"ablation": name, **expected}


@pytest.mark.parametrize("name", choices("ablation"))
def test_an_ablation_goes_with_both_penalties_and_a_step_rule(name):
    check_config(make_config(f"+ablation={name}", "constraint=combined", "optimizer=adam"))
    cfg = make_config(f"+ablation={name}", "step=projection")
    assert (cfg.step, cfg.ablation) == ("projection", name)


def test_what_acts_by_default():
    """Only accepted policies act where tables were made so."""
    assert make_config().gate is True
    assert {make_config(f"task={name}").gate for name in ("gros_zanon", "pendulum")} == {"act"}
