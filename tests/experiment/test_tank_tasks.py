"""The tasks of the tanks: their wrong and true schemes."""

from __future__ import annotations

import pytest
import torch

from tests.runs import make_config
from torch_qpmpc.envs import FourTanks, TankReferences
from torch_qpmpc.envs.closed_loop import plant_loop
from torch_qpmpc.experiment.rivals.tanks import reference_mpc
from torch_qpmpc.experiment.start import collect_log
from torch_qpmpc.experiment.tasks import make_mpc, make_physics, make_true_mpc
from torch_qpmpc.experiment.tasks.identified import identified_start
from torch_qpmpc.mpc.module import QPMPC


def J(mpc: QPMPC | None, plant: FourTanks | TankReferences, steps: int) -> float:
    assert mpc is not None
    return plant_loop(mpc.policy, plant, steps=steps, starts=8, seed=3).J


@pytest.fixture(params=["four_tanks", "tank_references"])
def task(request) -> str:
    return f"task={request.param}"


def test_the_wrong_model_depends_on_the_seed_and_is_worse_than_the_true_one(task):
    cfg = make_config(task, "start=model", "seed=1")
    plant = make_physics(cfg)
    assert isinstance(plant, FourTanks | TankReferences)
    wrong, true = make_mpc(cfg, plant), make_true_mpc(cfg, plant)
    assert true is not None
    again, other = (make_mpc(make_config(task, f"seed={s}"), plant) for s in (1, 4))
    assert torch.equal(wrong.C, again.C)
    assert not torch.allclose(wrong.C, other.C)
    assert wrong.n_p == true.n_p == plant.n_p
    assert J(true, plant, 60) < 0.98 * J(wrong, plant, 60)


def test_four_tanks_start_from_a_log_of_a_thousand_steps():
    cfg = make_config("task=four_tanks")
    plant = make_physics(cfg)
    assert isinstance(plant, FourTanks)
    log = collect_log(cfg, plant)
    assert log["action"].shape == (4, 250, 2)
    mpc = make_mpc(cfg, plant, identified_start(cfg, plant, log))
    assert mpc.structure == "free"
    assert J(mpc, plant, 100) == pytest.approx(226, abs=8)  # 35.5 of them for x_0


def test_the_true_scheme_of_references_is_the_exact_mpc():
    cfg = make_config("task=tank_references")
    plant, mpc = make_physics(cfg), None
    assert isinstance(plant, TankReferences)
    mpc = make_true_mpc(cfg, plant)
    assert mpc is not None
    p = 20 * torch.rand(10, plant.n_p, generator=torch.Generator().manual_seed(0)).double()
    exact = reference_mpc(plant, plant.A, plant.B)
    torch.testing.assert_close(mpc.policy(p), exact(p), atol=1e-6, rtol=0)


def test_disturbed_tanks_and_offset_free_schemes_are_choices():
    cfg = make_config("task=tank_references", "task.disturbed=true", "task.memory=2")
    plant = make_physics(cfg)
    assert isinstance(plant, TankReferences)
    assert (plant.noise_std, plant.mismatch, plant.past) == (0.1, 1.0, 3)
    mpc = make_mpc(cfg, plant)
    assert mpc.past == 3
    A, B = mpc.model()[:2]
    # What stays the same is predicted to stay.
    torch.testing.assert_close(A.unflatten(-1, (3, 4)).sum(-2), torch.eye(4).double())
    torch.testing.assert_close(B.unflatten(-1, (3, 2)).sum(-2), torch.zeros(4, 2).double())
