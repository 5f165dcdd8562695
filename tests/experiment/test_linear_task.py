"""``task=linear``: matrices in place of a plant."""

from __future__ import annotations

import re

import pytest
import torch
from torch.testing import assert_close

import torch_qpmpc as qm
import train
from tests.logs import LINEAR
from tests.runs import SMALL, make_config
from torch_qpmpc import QPError
from torch_qpmpc.envs import LinearPlant
from torch_qpmpc.envs.past_window import first_window, next_window
from torch_qpmpc.experiment.config import check_config
from torch_qpmpc.experiment.tasks import make_mpc, make_physics

MEASURED = ("task.C_y=null", "task.outputs=[s, v]", "task.dR=null")


def made(*overrides: str) -> tuple[LinearPlant, qm.QPMPC]:
    cfg = make_config(*LINEAR, *overrides)
    plant = make_physics(cfg)
    assert isinstance(plant, LinearPlant)
    return plant, make_mpc(cfg, plant)


def test_the_cost_is_that_of_outputs_inputs_and_moves_without_a_half():
    plant, _ = made()
    x, u = torch.tensor([[3.0, 0.5, 0.7]]).double(), torch.tensor([[0.2]]).double()
    moves = 0.2 * (0.2 - 0.7) ** 2
    expected = (3 - 1) ** 2 + 0.1 * 0.2**2 + moves + 100 * 1.0
    assert plant.cost(x, u, torch.zeros(1, 5)).item() == pytest.approx(expected)
    assert_close(plant.step(x, u, torch.zeros(1, 5))[0, -1], u[0, 0])
    assert plant.labels == (("s", "last F"), ("F",), ())


@pytest.mark.parametrize("more", [(), MEASURED, ("task.past=6",)])
def test_the_window_predicts_the_plant_without_noise(more):
    plant, mpc = made(*more, "task.noise=null")
    random = torch.Generator().manual_seed(0)
    x = plant.starts(random, 1)
    silent = torch.zeros(1, len(plant.A) + plant.n_y).double()
    window, following = [], []
    for _ in range(plant.past + 3):
        u = torch.rand(1, plant.n_u, generator=random, dtype=torch.float64)
        window += [plant.output(x, silent), u]
        x = plant.step(x, u, silent)
        following.append(plant.output(x, silent))
    p = torch.cat(window[-2 * plant.past :], -1)  # and the action
    C = mpc.C_0[: plant.n_y, : p.shape[-1]]
    assert_close(C @ p[0], following[-1][0], rtol=0, atol=1e-6)


def test_the_policy_goes_to_the_set_point():
    plant, mpc = made("task.noise=null", "task.R=null", "task.past=null")
    x, silent = torch.zeros(1, 3).double(), torch.zeros(1, 5).double()
    window = first_window(plant.output(x, silent), plant.past, torch.zeros(1))
    for _ in range(80):
        u = mpc.policy(window).detach()
        x = plant.step(x, u, silent)
        window = next_window(window, u, plant.output(x, silent))
    assert abs(x[0, 0] - 1) < 1e-3


def test_a_run_ends_with_a_policy_and_its_c(tmp_path):
    cfg = make_config(*SMALL, *LINEAR, "task.horizon=3", "export=c", "gate=true")
    summary = train.train(cfg, str(tmp_path / "run"), quiet=True)
    assert summary["J_best"] <= summary["J_start"]
    assert (tmp_path / "run" / "c" / "policy.c").exists()
    policy = qm.load_run(tmp_path / "run").policy
    assert policy.predict(torch.zeros(policy.n_p)).shape == (1,)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("task.A=null", "task.A: got null, expected a matrix by its rows. As in: python train.py"),
        ("task.B=[[1]]", "task.B: got shape (1, 1), expected shape (2, 1), for 2 states."),
        ("task.A=[[1]]", "task.B: got shape (2, 1), expected shape (1, 1), for 1 states."),
        ("task.C_y=[[1]]", "task.C_y: got shape (1, 1), expected shape (1, 2), for 2 states."),
        ("task.outputs=[a, b]", "task.outputs: got ['a', 'b'], expected 1 different names."),
        ("task.inputs=[s]", "task.inputs: got 's', an output, expected names of their own."),
        ("task.Q=null", "task.Q: got none, expected weights of outputs, such as 'task.Q={s: 1.0}'"),
        ("task.noise={v: 1}", "task.noise: got 'v', expected one of s, F."),
        ("task.starts={s: [1, 0]}", "task.starts: got {s: [1, 0]}, expected the lower number"),
    ],
)
def test_a_mistake_is_named(override, message):
    with pytest.raises(QPError, match=f"^{re.escape(message)}"):
        made(override)


@pytest.mark.parametrize("A", ["[]", "[[1, 2], [3]]"])
def test_a_matrix_has_rows_of_one_length(A):
    message = r"^task\.A: got .*, expected a list of equally long rows of finite numbers"
    with pytest.raises(QPError, match=message):
        check_config(make_config(*LINEAR, f"task.A={A}"))
