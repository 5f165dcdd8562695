"""The proof at a run's end; tests/export/test_command.py has the export."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import train
from tests.runs import SMALL, make_config
from torch_qpmpc import QPMPC, QPError
from torch_qpmpc.envs import GrosZanonLTI, PointMass
from torch_qpmpc.experiment.outcome import check_provable, prove_run
from torch_qpmpc.experiment.tasks import make_mpc


def test_no_sampled_start_exceeds_the_bound():
    physics = PointMass()
    mpc = make_mpc(make_config(*SMALL), physics)
    entries = prove_run(mpc, physics, 0.02, quiet=True)
    s = physics.starts(np.random.default_rng(0), 1000)
    with torch.no_grad():
        after = s @ physics.A.mT + mpc.policy(s) @ physics.B.mT
    sampled = float((torch.maximum(after - physics.ub_s, physics.lb_s - after)).max()) + 0.02
    assert sampled <= entries["proof_bound"] + 1e-6
    assert sampled > entries["proof_bound"] - 0.1


def test_a_plant_without_a_box_of_starts_is_refused_before_the_first_update(
    tmp_path, monkeypatch, store_task
):
    cfg = make_config("task=store", "prove=0.1")
    match = "prove: got a Store, expected a LinearSystem with a start_box. Use task=poin"
    with pytest.raises(QPError, match=match):
        train.train(cfg, str(tmp_path), quiet=True)
    assert not list(tmp_path.iterdir())
    monkeypatch.setattr(PointMass, "start_box", lambda self: None)
    with pytest.raises(QPError, match="got a PointMass, expected a LinearSystem with a start_box"):
        check_provable(PointMass())


def test_a_qp_of_other_states_is_a_warning():
    mpc = QPMPC.of(2, 1, 2, stage_weight=[1.0] * 3)
    with pytest.warns(UserWarning, match="Nothing is proved. states: got 4 dimensions, expected n"):
        assert prove_run(mpc, PointMass(), 0.02, quiet=True) == {}


@pytest.mark.parametrize("physics", [PointMass(start_velocity=0.2), GrosZanonLTI()])
def test_all_starts_are_in_their_box_and_near_its_faces(physics):
    lower, upper = physics.start_box()
    for rng in (np.random.default_rng(0), torch.Generator().manual_seed(0)):
        s = physics.starts(rng, 1000)
        assert ((lower <= s) & (s <= upper)).all()
        assert torch.allclose(s.amin(0), lower, atol=0.02)
        assert torch.allclose(s.amax(0), upper, atol=0.02)
