"""Every key has a rule and is read, every rule has a key, and each bad value has a message."""

import math
import re
from typing import Any

import pytest
from omegaconf import OmegaConf

import train
from tests.refused import refused
from tests.runs import CONFIGS, SMALL, choices, compose_config, make_config
from torch_qpmpc import QPError
from torch_qpmpc.experiment import config
from torch_qpmpc.experiment.config import Config, Group, flatten

#: Penalties may be null.
OPTIONAL = {"constraint.deviation", "constraint.si"}
KEYS = {*config.keys()}
GROUPS = ("start", "task", "noise", "constraint", "optimizer")


def keys_of_the_files() -> set[str]:
    """List the dotted keys of every file in configs/, except Hydra's."""
    keys = set()
    for path in set(CONFIGS.rglob("*.yaml")) - set((CONFIGS / "hydra").rglob("*.yaml")):
        tree: Any = OmegaConf.to_container(OmegaConf.load(path), resolve=False)
        whole = "# @package _global_" in path.read_text(encoding="utf-8")
        group = "" if whole or path.parent == CONFIGS else path.parent.name
        tree = {key: x for key, x in tree.items() if key not in ("defaults", "hydra")}
        keys |= {*flatten(tree, group)}
    return keys


def test_each_key_of_the_files_is_one_of_the_models_and_there_are_at_most_72():
    assert keys_of_the_files() - OPTIONAL == KEYS
    assert len(KEYS) <= 72


DATA = ("start=data", "task=pendulum", "start.transitions=40", "constraint=free")


def test_each_key_is_read(tmp_path, monkeypatch):
    """A run reads the key, or the run folder's name has it."""
    seen: set[str] = set()
    prefixes: dict[int, str] = {}

    def read(part: Group, name: str) -> Any:
        if id(part) in prefixes:
            seen.add(f"{prefixes[id(part)]}{name}")
        return object.__getattribute__(part, name)

    monkeypatch.setattr(Group, "__getattribute__", read)
    for name, overrides in {
        "first": ("gate=true", "optimizer=adam"),
        "second": ("gate=true", "constraint=combined", "optimizer=gauss_newton"),
        "data": (*DATA, "+task.start_episodes=2"),
    }.items():
        sizes = ("updates=2", "task.eval_steps=2", "task.episode_steps=4")
        cfg = make_config(*SMALL, *sizes, *overrides)
        prefixes.clear()
        prefixes |= {id(cfg): ""} | {id(vars(cfg)[x]): f"{x}." for x in GROUPS}
        parts = {x: vars(cfg.constraint)[x.partition(".")[2]] for x in OPTIONAL}
        prefixes |= {id(part): f"{x}." for x, part in parts.items()}
        train.train(cfg, str(tmp_path / name))
    text = (CONFIGS / "config.yaml").read_text(encoding="utf-8").partition("hydra:")[2]
    seen |= set(re.findall(r"\$\{(?!hydra\.)([\w.]+)\}", text))
    assert KEYS - seen == set()


@pytest.mark.parametrize(
    "overrides",
    [
        *((f"constraint={name}",) for name in choices("constraint")),
        *((f"optimizer={name}", "start=data") for name in choices("optimizer")),
        *((f"task={name}",) for name in ("point_mass", "gros_zanon", "pendulum")),
        ("task=gymnasium", "task.id=Pendulum-v1", "constraint=si"),
        ("noise=brownian", "noise.std=0", "seed=0", "updates=1", "td_error_clip=null"),
        ("optimizer=adam", "optimizer.lr_cost=0", "optimizer.betas=[0,0]", "task.gamma=1"),
        ("task.state_slack=inf", "exploration_std=0", "task.learn_cost=[]"),
        ("constraint=free", "task.episode_steps=5", "warmup_steps=1"),
    ],
    ids=" ".join,
)
def test_choices_and_edges_are_accepted(overrides):
    cfg = make_config(*overrides)
    assert Config.of(cfg.model_dump(exclude_unset=True)) == cfg, "as config.yaml keeps it"


def test_an_infinite_weight_is_written_as_in_the_files_or_as_hydra_reads_it():
    settings = (make_config(f"task.state_slack={x}").settings for x in (".inf", "inf"))
    assert [x["task.state_slack"] for x in settings] == [math.inf] * 2


#: Values that a key does not take, and words of the sentence.
MISTAKES: list[tuple[str, Any, str]] = [
    ("updates", 0, "got 0, but input should be greater than or equal to 1."),
    ("updates", True, "got True, but input should be a valid integer"),
    ("seed", 2**63, "got 9223372036854775808, but input should be less than 9223372036854775808."),
    ("exploration_std", math.inf, "got inf, but input should be a finite number."),
    ("task.state_slack", -1.0, "got -1.0, but input should be greater than or equal to 0."),
    ("gate", "acts", "got 'acts', but input should be 'act', 'plant', True or False."),
    ("solver", "cplex", "got 'cplex', expected one of proxqp, daqp"),
    ("constraint.learn", ["C", "H"], "got 'H', but input should be 'C', 'b', 'G', 'lb' or 'ub'."),
    ("constraint.si", 3, "got 3, but input should be a valid dictionary"),
    ("optimizer.name", "rmsprop", "got 'rmsprop', but input should be 'adam', 'sgd', 'gauss"),
    ("rivals", "none", "got 'none', but input should be a valid boolean or a valid list."),
    ("optimizer.betas", [0.9], "got [0.9], but list should have at least 2 items after validation"),
    ("task", 3, "got 3, expected its keys, as in configs/task/."),
    ("task.name", "unknown", "got 'unknown', expected one of "),
    ("task.A", [[1.0], [1.0, 2.0]], "but rows should be equally long."),
    ("task.id", "???", "got '???', expected the id of a Gymnasium environment, as in task.id="),
    ("batchsize", 3, "got an unknown key, expected a key of the chosen groups. Did you mean batch"),
    ("taks", 3, "got an unknown key, expected a key of the chosen groups. Did you mean task?"),
    ("constraint.deviaton.c_1", 3, "got an unknown key, .* Did you mean constraint.deviation.c_1?"),
    ("optimizer.damping", 1.0, "got an unknown key, expected a key of the chosen groups. See conf"),
]


@pytest.mark.parametrize(("key", "value", "words"), MISTAKES)
def test_a_mistake_is_one_sentence_with_its_key(key, value, words):
    task = "task=pendulum" if key in ("task.A", "task.id") else "task=point_mass"
    cfg = compose_config("constraint=deviation", "optimizer=adam", task)
    OmegaConf.set_struct(cfg, False)
    OmegaConf.update(cfg, key, value, merge=False, force_add=True)
    with pytest.raises(QPError, match=f"^{re.escape(key)}: .*") as error:
        Config.of(cfg)
    assert re.search(re.escape(words).replace(r"\.\*", ".*"), str(error.value))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("key", ["updates", "task.horizon", "optimizer.name", "constraint"])
def test_missing_keys(key):
    cfg = compose_config()
    owner, _, leaf = key.rpartition(".")
    OmegaConf.set_struct(cfg, False)
    del (OmegaConf.select(cfg, owner) if owner else cfg)[leaf]
    with pytest.raises(QPError, match=rf"^{re.escape(key)}: got nothing, but field required.$"):
        Config.of(cfg)
    cfg["update"] = 3
    with pytest.raises(QPError, match=r"^update: got an unknown"):
        Config.of(cfg)  # a misspelt key is named before the missing one


@refused(
    ("constraint.learn=[b]", r"constraint.learn: got \['b'\], expected a list with C, .* or "),
    ("constraint=si task.episode_steps=5", "task.episode_steps: got 5, expected at least task"),
    ("constraint=fixed task.learn_cost=[]", r"task.learn_cost: got \[\], expected something"),
    ("constraint=si replay=false", "replay: got False, expected true. constraint.si"),
    ("constraint.structure=tied", "constraint.structure: got 'tied', expected free. A tied C"),
    ("constraint=si constraint.structure=tied", ".*got 'tied', expected free. gauss_new"),
    ("task.terminal_weight=riccati", ".*got 'riccati', expected default or identity. The Ricc"),
    ("noise=uniform", "noise.name: got 'uniform', expected a noise of task point_mass: gauss"),
    ("task=gros_zanon noise.std=0.1", "noise.std: got 0.1, expected null. The noise of gros"),
    ("rivals=[nobody]", r"rivals: got \['nobody'\], expected .* identification. They are the"),
    ("num_envs=7", "replay_capacity: got 16000, .* num_envs = 7, .* Set replay_capacity=15960."),
    ("replay_capacity=32", "replay_capacity: got 32, expected .* and at least 160. Set .*=160."),
)
def test_values_that_do_not_fit_each_other(overrides):
    make_config(*overrides.split())


@pytest.mark.parametrize("name", choices("ablation"))
def test_an_ablation_is_named_and_differs_from_the_default(name):
    cfg = make_config(f"+ablation={name}")
    assert cfg.ablation == name
    assert cfg.settings != {**make_config().settings, "ablation": name}
