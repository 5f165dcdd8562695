"""The proof at a run's end, and its line in the report."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import torch

from tests.runs import SMALL, make_config
from torch_qpmpc.envs import PointMass
from torch_qpmpc.experiment.proving import prove_run
from torch_qpmpc.experiment.tasks import make_mpc
from torch_qpmpc.study import report


def test_the_report_has_a_line_for_each_proof():
    run = SimpleNamespace(cfg=SimpleNamespace(prove=0.02))
    rows = [(run, "free", 1, "at most 0.1"), (run, "free", 2, None)]
    frame = pd.DataFrame(rows, columns=["run", "label", "seed", "proof"])
    assert report.proofs(frame).splitlines()[2:] == ["- free, seed 1, |nu| <= 0.02: at most 0.1"]
    assert not report.proofs(frame.drop(columns="proof"))


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


def test_a_plant_without_a_linear_model_is_a_warning():
    mpc = make_mpc(make_config(*SMALL), PointMass())
    with pytest.warns(UserWarning, match="Nothing is proved. prove: got object, expected a linear"):
        assert prove_run(mpc, object(), 0.02, quiet=True) == {}
