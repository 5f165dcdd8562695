"""``task=log``: learning from a file, without a plant."""

from __future__ import annotations

import re

import pytest
import torch
from torch.testing import assert_close

import torch_qpmpc as qm
import train
from tests.logs import log_overrides
from tests.runs import SMALL, make_config, run_command
from torch_qpmpc import QPError
from torch_qpmpc.envs import ARXPlant
from torch_qpmpc.experiment.announcement import announcement
from torch_qpmpc.experiment.tasks import make_mpc, make_physics
from torch_qpmpc.experiment.tasks.log import read, scheme


@pytest.fixture
def overrides(tmp_path):
    return log_overrides(tmp_path)


def plant_of(*overrides: str) -> ARXPlant:
    plant = make_physics(make_config(*overrides))
    assert isinstance(plant, ARXPlant)
    return plant


def test_the_plant_has_the_model_the_names_and_the_bounds(overrides):
    plant = plant_of(*overrides, "task.past=1")
    assert_close(plant.A, torch.tensor([[0.9]]).double(), rtol=0, atol=0.02)
    assert_close(plant.B, torch.tensor([[0.5]]).double(), rtol=0, atol=0.05)
    assert plant.errors.std() == pytest.approx(0.05, rel=0.5)
    assert plant.labels == (["T [degC]"], ["q"], ["T_out", "price", "target"])
    assert [x.item() for x in (plant.lb_a, plant.ub_a, plant.lb_y, plant.ub_y)] == [-1, 3, 5, 12]
    seen = plant_of(*overrides, "task.u_bounds=null", "task.y_bounds=null")
    assert 0 <= seen.lb_a.item() < seen.ub_a.item() <= 1
    assert seen.ub_y.isinf().all()


def test_the_cost_is_the_sum_without_a_half(overrides):
    plant = plant_of(*overrides)
    x, u = torch.zeros(plant.past * 2 - 1).double(), torch.tensor([2.0]).double()
    x[-1] = 13.0
    w = torch.tensor([0.0, 0.3, 8.0, 0.0]).double()
    assert plant.cost(x, u, w).item() == pytest.approx(25 + 0.4 + 0.6 + 100)
    constant = plant_of(*overrides, "task.r={T: 10}", "task.y_bounds=null")
    assert constant.cost(x, u, w).item() == pytest.approx(9 + 0.4 + 0.6)


def test_the_scheme_minimises_the_plants_cost(overrides):
    cfg = make_config(*overrides, "task.gamma=1", "task.horizon=1", "task.y_bounds=null")
    plant = plant_of(*overrides, "task.horizon=1", "task.y_bounds=null")
    mpc = qm.QPMPC(scheme(cfg, plant))
    d = torch.tensor([[6.0, 0.2, 8.0], [7.0, -0.1, 8.5]]).double()
    x = torch.rand(1, 2 * plant.past - 1).double()
    u = torch.tensor([[0.7]]).double()
    first, second = torch.cat((d, torch.zeros(2, 1).double()), -1).unsqueeze(1)
    after = plant.step(x, u, first)
    expected = plant.cost(x, u, first) + plant.cost(after, 0 * u, second)
    p = torch.cat((d.flatten()[None], x), -1)
    assert_close(mpc.action_value(p, u), expected)


def test_it_starts_from_the_log_and_keeps_what_is_better(overrides, tmp_path):
    cfg = make_config(*SMALL, *overrides, "gate=true")
    summary = train.train(cfg, str(tmp_path / "run"), quiet=True)
    assert summary["J_best"] <= summary["J_start"]
    run = qm.load_run(tmp_path / "run")
    found = qm.identify(read(cfg), 3, past=4, structure="free")
    assert torch.equal(run.start.C, found.constraints.C)
    assert run.policy.predict(torch.zeros(run.policy.n_p)).shape == (1,)
    assert not (tmp_path / "run" / "log.pt").exists(), "the file is the log"
    assert "so that every J is a prediction." in announcement(cfg, "folder")


def test_a_model_start_is_the_arx_model(overrides):
    cfg = make_config(*overrides, "start=model")
    plant = plant_of(*overrides)
    assert torch.equal(make_mpc(cfg, plant).C_0, make_mpc(cfg, plant).C)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("task.file=null", "task.file: got null, expected the path of a CSV file, as in. python"),
        ("task.file=none.csv", "data: got none.csv, which cannot be read"),
        ("task.Q=null", "task.Q: got none, expected weights of outputs, such as 'task.Q={T: 1.0}'"),
        ("task.Q={q: 1}", "task.Q: got 'q', expected one of T."),
        ("task.R={T: 1}", "task.R: got 'T', expected one of q."),
        ("task.r={T: set}", "task.r: got 'set', expected one of T_out, price, target."),
        ("task.linear={q: cost}", "task.linear: got 'cost', expected one of T_out, price, target."),
        ("task.u_bounds={v: [0, 1]}", "task.u_bounds: got 'v', expected one of q."),
        ("task.y_bounds={v: [0, 1]}", "task.y_bounds: got 'v', expected one of T."),
    ],
)
def test_a_mistake_is_named(overrides, override, message):
    cfg = make_config(*overrides, override)
    with pytest.raises(QPError, match=f"^{re.escape(message)}"):
        make_physics(cfg)


def test_a_file_alone_does_not_train_the_point_mass(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    message = (
        "task.file: got 'reactor.csv' with task=point_mass, which reads no file, expected a task "
        "with a file. To learn from a log: python train.py task=log task.file=reactor.csv "
    )
    with pytest.raises(SystemExit, match=f"^{re.escape(message)}"):
        run_command("task.file=reactor.csv", "hydra.run.dir=run")
