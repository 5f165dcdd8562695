"""The tasks' plants and QPs match the configuration and the papers."""

import dataclasses
import math
import runpy
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pydantic import Field

import train
from tests import runs
from tests.refused import refused
from tests.stops import assert_same_numbers, stop
from torch_qpmpc import Cost, QPError
from torch_qpmpc.envs import GrosZanonLTI, PointMass
from torch_qpmpc.experiment import tasks
from torch_qpmpc.experiment.algorithms import evaluate
from torch_qpmpc.experiment.tasks.code import named_task, run_code
from torch_qpmpc.mpc.layout import banded_matrix


@pytest.mark.parametrize(
    ("overrides", "kind", "std"),
    [
        (("noise=gaussian",), "gaussian", 0.01),
        (("noise=brownian",), "brownian", 0.002),
        (("noise.std=0",), "gaussian", 0),
    ],
)
def test_physics_has_the_noise(overrides, kind, std):
    physics: Any = tasks.make_physics(runs.make_config(*overrides))
    assert (physics.noise_kind, physics.std) == (kind, std)


@pytest.mark.parametrize(("seed", "J_start"), [(1, 285), (4, 58)])
def test_J_of_start_and_true_model_are_the_known_ones(seed, J_start):
    """J depends only on the paper's random draws, starts and rollout."""
    cfg = runs.make_config(f"seed={seed}", "solver=daqp")
    physics = runs.linear_system(cfg)
    assert round(evaluate(cfg, tasks.make_mpc(cfg, physics).policy, physics).J) == J_start
    assert round(evaluate(cfg, runs.true_mpc(cfg, physics).policy, physics).J) == 47


def test_start_is_the_corrupted_model_and_a_random_cost():
    cfg, true = runs.make_config("seed=3", "constraint=free"), PointMass()
    mpc = tasks.make_mpc(cfg, tasks.make_physics(cfg))
    rng = np.random.default_rng(3)
    A = true.A + torch.as_tensor(rng.uniform(-0.05, 0.05, (4, 4)))
    B = true.B + torch.as_tensor(rng.uniform(-0.05, 0.05, (4, 2)))
    theta = rng.uniform(0.5, 5, 4)
    assert torch.equal(mpc.C_0, banded_matrix(A, B, 10))
    assert torch.equal(mpc.C, mpc.C_0)
    torch.testing.assert_close(mpc.H, torch.as_tensor([*theta, 0, 0]))
    qp = mpc.quadratic_program()
    expected = torch.cat([0.9**k * mpc.H for k in range(10)] + [0.9**10 * torch.ones(4)])
    torch.testing.assert_close(qp.H.diagonal(), expected)
    assert torch.equal(qp.G, torch.eye(64, dtype=torch.float64))
    stage = torch.tensor([2, 2, 10, 10, 1, 1], dtype=torch.float64)
    assert torch.equal(qp.ub[:12], stage.repeat(2))
    assert torch.equal(qp.lb[:12], -stage.repeat(2))
    assert qp.w[:6].tolist() == [100.0] * 4 + [math.inf] * 2
    assert mpc.on_failure == "mask", "training goes on where a QP is not solved"


def test_configuration_reaches_the_qp():
    cfg = runs.make_config(
        "solver=daqp",
        "task.horizon=4",
        "task.gamma=0.5",
        "task.hessian=block",
        "task.learn_cost=[H,H_f,q]",
        "task.state_slack=7",
        "task.action_slack=3",
        "task.discount_slack=true",
        "constraint=free",
        "constraint.learn=[C,ub]",
    )
    mpc = tasks.make_mpc(cfg, tasks.make_physics(cfg))
    assert (mpc.horizon, mpc.gamma, mpc.hessian, mpc.solver) == (4, 0.5, "block", "daqp")
    assert set(mpc.learned) == {"H", "H_f", "q", "C", "ub"}
    w = mpc.quadratic_program().w
    assert w[:12].tolist() == [7.0] * 4 + [3.0] * 2 + [3.5] * 4 + [1.5] * 2


# Gros and Zanon's system


def test_the_other_task_starts_from_the_original_wrong_model():
    cfg = runs.make_config("task=gros_zanon", "constraint=mpc", "task.learn_cost=[q,c]")
    physics = runs.linear_system(cfg)
    assert isinstance(physics, GrosZanonLTI)
    mpc = tasks.make_mpc(cfg, physics)
    A, B = physics.A.new_tensor([[1, 0.25], [0, 1]]), physics.A.new_tensor([[0.0312], [0.25]])
    assert torch.equal(mpc.C_0, banded_matrix(A, B, 10))
    assert mpc.learned == ("q", "c", "C", "b", "lb", "ub")
    learned = sum(part.numel() for part in mpc.readable().values())
    # V0, A, B, b, f (with its part for x_N), and the bounds, of which those of actions stay fixed.
    assert learned == 1 + 4 + 2 + 2 + (3 + 2) + (3 + 3)
    qp = mpc.quadratic_program()
    assert qp.ub[:6].tolist() == [2, 1, 1, 2, 1, 1]
    assert qp.lb[:6].tolist() == [0, -1, -1, 0, -1, -1]
    assert qp.w[:6].tolist() == [50, 50, math.inf, 45, 45, math.inf]
    stages = torch.tensor([1, 1, 0.5, 0.9, 0.9, 0.45]).double()
    torch.testing.assert_close(qp.H.diagonal()[:6], stages)


def test_the_true_scheme_has_the_mean_of_the_noise():
    cfg = runs.make_config("task=gros_zanon")
    physics = runs.linear_system(cfg)
    mpc = runs.true_mpc(cfg, physics)
    s, a = torch.tensor([[0.3, 0.2]]).double(), torch.tensor([[-0.4]]).double()
    states, _ = mpc.predicted(mpc.solve(s, a).z)
    mean = torch.tensor([[-0.05, 0.0]]).double()
    torch.testing.assert_close(states[:, 1], physics.step(s, a, mean))
    assert mpc.ub[:3].tolist() == [1, 1, 1]


# Gymnasium


@refused(
    (("task.A=null",), r"^task\.A: got null, expected the rows of a matrix \(3, 3\)"),
    (("task.id=MountainCarContinuous-v0",), r"A, B: got shapes \(3, 3\) and \(3, 1\), expected"),
    (
        ("start=data", "task.stage_weight=[[1]]", "task.A=null", "task.B=null"),
        r".*stage_weight: got shape \(1, 1\), expected shape \(4, 4\)",
    ),
)
def test_a_model_or_a_weight_of_other_dimensions_is_named(overrides):
    cfg = runs.make_config("task=pendulum", *overrides)
    tasks.make_mpc(cfg, tasks.make_physics(cfg))


def test_a_model_on_the_command_line_is_that_of_the_qp():
    model = ("task.A=[[1,1],[0,1]]", "task.B=[[0],[.1]]")
    model += ("task.stage_weight=[[2,0,0],[0,1,0],[0,0,1]]", "task.horizon=4")
    cfg = runs.make_config("task=gymnasium", "task.id=MountainCarContinuous-v0", *model)
    mpc = tasks.make_mpc(cfg, tasks.make_physics(cfg))
    A, B = torch.tensor([[1, 1], [0, 1]]).double(), torch.tensor([[0], [0.1]], dtype=torch.float64)
    assert torch.equal(mpc.C_0, banded_matrix(A, B, 4))
    assert mpc.ub[:3].tolist() == [torch.inf, torch.inf, 1], "of the actions only"
    cfg.task.observation_bounds = True
    bounded = tasks.make_mpc(cfg, tasks.make_physics(cfg))
    torch.testing.assert_close(bounded.ub[:3], torch.tensor([0.6, 0.07, 1]).double())


# Plants with previews


def test_a_scheme_passes_what_is_known_and_more(store_task):
    cfg = runs.make_config("task=store", "task.horizon=4", "constraint=free")
    plant: Any = tasks.make_physics(cfg)
    mpc = tasks.make_mpc(cfg, plant)
    assert (mpc.n_p, mpc.n_x, mpc.n_d, mpc.horizon) == (10 + 2, 2, 2, 4)
    assert mpc.quadratic_program().w[0] == 2, "the scheme's own price, not task.state_slack"
    assert (mpc.C[0, :2].tolist(), mpc.C[0, 10:12].tolist()) == ([0, -1], [1, 1])
    scheme = tasks.find_task(cfg.task).wrong_scheme(cfg, plant)
    for cost, message in (
        (dataclasses.replace(scheme.cost, c=7.0), None),
        (Cost(hessian="block"), r"task\.name: got 'store', whose scheme has no model or no stage "),
    ):
        changed = dataclasses.replace(scheme, cost=cost)
        task = dataclasses.replace(tasks.TASKS["store"], wrong_scheme=lambda *_, x=changed: x)
        tasks.register(task)
        if message is None:
            assert tasks.make_mpc(cfg, plant).c == 7
        else:
            with pytest.raises(QPError, match=message):
                tasks.make_mpc(cfg, plant)


# A user's task


TASK = """
from torch_qpmpc.envs import GrosZanonLTI
from torch_qpmpc.experiment.tasks import Task, register
from torch_qpmpc.experiment.tasks.gros_zanon import true_scheme

register(
    Task("mine", lambda cfg: GrosZanonLTI(w=7), true_scheme, {options})
)
"""


@pytest.fixture
def own_task(tmp_path, monkeypatch):
    """Return a function that writes and runs a task's file; unregister the task afterwards."""
    monkeypatch.delitem(tasks.TASKS, "mine", raising=False)

    def write(options: str) -> str:
        file = tmp_path / "mine.py"
        file.write_text(TASK.replace("{options}", options))
        runpy.run_path(str(file))
        runs.composed.cache_clear()
        return str(file)

    return write


def test_a_registered_task_inherits_the_defaults_of_the_point_mass(own_task):
    file = own_task('defaults={"num_envs": 3, "task": {"horizon": 4}}')
    cfg = runs.make_config("task=mine", "replay_capacity=300")
    own = {"name": "mine", "file": file, "horizon": 4, "terminal_weight": "default"}
    inherited = runs.make_config().task.model_dump() | own
    assert cfg.task.model_dump() == inherited, "all but the paper's terminal cost"
    assert (cfg.num_envs, cfg.noise.name) == (3, "none")
    assert runs.make_config("task=mine", "task.horizon=5", "num_envs=2").task.horizon == 5
    physics = runs.linear_system(cfg)
    assert isinstance(physics, GrosZanonLTI)
    assert physics.w == 7
    assert tasks.make_mpc(cfg, physics).horizon == 4
    assert tasks.make_true_mpc(cfg, physics) is None


def test_another_process_finds_a_task_by_its_file(own_task):
    file = own_task("")
    del tasks.TASKS["mine"]
    with pytest.raises(QPError, match=r"task\.name: got 'mine', expected one of .*point_mass"):
        runs.make_config("task=mine", "task.file=null")
    other = Path(file).with_suffix(".txt")
    other.write_text("")
    message = r"task\.file: got '.*mine.txt', which is no .py file, expected the Python file that"
    with pytest.raises(QPError, match=message):
        run_code(runs.compose_config("task=mine", f"task.file={other}"))
    assert tasks.find_task(run_code(runs.compose_config("task=mine")).task).name == "mine"


def test_the_command_line_may_name_a_script_alone(own_task, tmp_path):
    file = own_task('defaults={"defaults": [{"override /constraint": "mpc"}]}')
    alone = [f"task.file={file}", "seed=2"]
    assert named_task(alone) == ["task=mine", *alone]
    assert runs.make_config("task=mine").constraint.name == "mpc"
    for unchanged in (["seed=2"], [f"task.file={file}", "task=mine"]):
        assert named_task(unchanged) == unchanged
    empty = tmp_path / "empty.py"
    empty.write_text("")
    with pytest.raises(QPError, match=r"task\.file: got '.*empty\.py', which registers none, exp"):
        named_task([f"task.file={empty}"])
    with pytest.raises(QPError, match=r"task\.file: got 'gone\.py', which does not exist, exp"):
        named_task(["task.file=gone.py"])
    message = r"task\.file: got '.*mine\.py' with task=point_mass, which reads no file, exp"
    with pytest.raises(QPError, match=message):
        run_code(runs.compose_config(f"task.file={file}"))


def test_a_task_without_its_code_has_no_plant(own_task):
    own_task("")
    cfg = runs.make_config("task=mine")
    del tasks.TASKS["mine"]
    message = r"task\.file: got '.*mine\.py', which has not run, expected a script that has regis"
    with pytest.raises(QPError, match=message):
        tasks.make_physics(cfg)


def test_an_environment_of_a_module_needs_its_import():
    cfg = runs.make_config("task=pendulum", "task.id=antigravity:Id-v0")
    message = r"task\.id: got 'antigravity:Id-v0' with .* expected an environment whose module has "
    with pytest.raises(QPError, match=message):
        tasks.make_physics(cfg)
    assert "antigravity" not in sys.modules
    message = (
        r"task\.id: got 'greenhouse:Id-v0', and cannot import greenhouse \(No module .* Start "
    )
    with pytest.raises(QPError, match=message):
        run_code(runs.compose_config("task=pendulum", "task.id=greenhouse:Id-v0"))


def test_an_environment_may_be_in_the_current_folder(tmp_path, monkeypatch):
    """As with train.py in another one."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.delitem(sys.modules, "heated_tank", raising=False)
    (tmp_path / "heated_tank.py").touch()
    monkeypatch.chdir(tmp_path)
    run_code(runs.compose_config("task=pendulum", "task.id=heated_tank:Tank-v0"))
    assert sys.modules.pop("heated_tank").__file__ == str(tmp_path / "heated_tank.py")


def test_train_resumes_a_run_of_an_own_task(own_task, tmp_path, monkeypatch):
    """The command line names the script that registers it."""
    file = own_task('defaults={"task": {"horizon": 3}}')
    cfg, whole, cut = (
        runs.make_config("task=mine", *runs.SMALL),
        tmp_path / "whole",
        tmp_path / "cut",
    )
    train.train(cfg, str(whole), quiet=True)
    stop(monkeypatch, cfg, cut, 3)
    del tasks.TASKS["mine"]
    runs.run_command(f"task.file={file}", *runs.SMALL, f"hydra.run.dir={cut}")
    assert_same_numbers(cut, whole)


def test_a_task_has_noises_and_keys_of_its_own(own_task, tmp_path):
    own_task('noises=("brownian", "gaussian"), takes_noise_std=True')
    cfg = runs.make_config("task=mine", "noise.std=3")
    assert cfg.noise.name == "brownian"
    with pytest.raises(QPError, match=r"noise\.name: got 'uniform', expected a noise of task mine"):
        runs.make_config("task=mine", "noise=uniform")

    class Settings(tasks.TaskSettings):
        mass: float = Field(gt=0)
        colour: str

    tasks.register(dataclasses.replace(tasks.TASKS["mine"], settings=Settings))
    for overrides, message in (
        (["+task.mass=1"], "task.colour: got nothing, but field required"),
        (["+task.mass=0", "+task.colour=red"], "task.mass: got 0, but input should be greater"),
        (["+task.mas=1"], "task.mas: got an unknown key, .* Did you mean task.mass?"),
    ):
        with pytest.raises(QPError, match=message):
            runs.make_config("task=mine", *overrides)
    cfg = runs.make_config("task=mine", "+task.mass=1.5", "+task.colour=red")
    assert (cfg.settings["task.mass"], cfg.settings["task.colour"]) == (1.5, "red")


def test_invalid_registrations_are_refused(own_task):
    own_task("")
    tasks.register(tasks.TASKS["mine"])
    with pytest.raises(QPError, match=r"task\.name: got 'point_mass', which is built in, exp"):
        tasks.register(dataclasses.replace(tasks.TASKS["mine"], name="point_mass"))
    for names in (["start"], ["true model"], ["discounted"], ["a b", "a-b"]):
        rivals: Any = dict.fromkeys(names, lambda plant: plant)
        with pytest.raises(QPError, match=r"task\.rivals: .* expected names that differ as words"):
            tasks.register(dataclasses.replace(tasks.TASKS["mine"], rivals=rivals))
    with pytest.raises(QPError, match="task: got str, expected a Task"):
        tasks.register("mine")  # pyright: ignore[reportArgumentType] (the mistake)
